"""At which scale what was seen lies best on the map.

Each is laid and scored on the other: points scattered about a surface fit what is larger better, whichever of the two
they belong to, so that the two scores err in opposite directions. Both are flat about their best and a little rough,
so that many scales are tried and the middle of the good ones counts, not the best.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from csgm_ros.tracking.alignment import align_through
from csgm_ros.tracking.evidence import meet
from csgm_ros.tracking.frames import Frame
from csgm_ros.tracking.localization import MANY, Submap, joined, scale_of, scaling
from csgm_ros.tracking.maps import PreparedMap

GROWTHS = 0.02 * np.arange(-10, 11)  # logarithms of the scales that are tried, over that of the place
NEARLY = 0.95  # of the best score: scales that reach it may be right
TRIES = 3  # each about the best of the last
GRIDS = 0.9, 0.95, 1.0, 1.05, 1.1  # edges of the voxels that the map is averaged in: each errs a little
FRAMES, LEAST_FRAMES = 20, 3  # that are asked
WHOLLY = 0.8  # of the share on the map of the frame that lies most on it: what a frame must have to tell the scale
SAMPLES = 500  # points of a frame that tell its share


def best_scale(
    seen: Sequence[tuple[Frame, np.ndarray]],
    voxel: float,
    prepared: PreparedMap,
    place: np.ndarray,
    rng: np.random.Generator,
) -> float | None:
    """Return the scale, map units a metre, about that of a place at which frames lie best on the map.

    Parameters
    ----------
    seen : sequence of (Frame, (4, 4) ndarray)
        Frames and their rigid poses in one frame.
    voxel : float
        Of the frames, metres.
    prepared : PreparedMap
    place : (4, 4) ndarray
        From the frame of the poses to the map.

    Returns
    -------
    float or None
        None where the frames do not tell it, as those of a single wall.
    """
    told = on_map(seen[:: -(-len(seen) // FRAMES)], voxel, prepared, place, WHOLLY)
    if len(told) < LEAST_FRAMES:
        return None
    chosen = np.sort(rng.permutation(len(prepared.points))[:MANY])
    sample = prepared.points[chosen], prepared.normals[chosen]
    submap = joined(told, voxel)
    for _ in range(TRIES):
        scores = _scores(submap, sample, prepared, place)
        growth = middle(GROWTHS, scores)
        if growth is not None:
            return scale_of(place) * float(np.exp(growth))
        place = place @ scaling(np.exp(GROWTHS[np.argmax(scores)]), submap.center)
    return None


def on_map(
    seen: Sequence[tuple[Frame, np.ndarray]], voxel: float, prepared: PreparedMap, place: np.ndarray, least: float
) -> list[tuple[Frame, np.ndarray]]:
    """Return the frames whose share on the map is ``least`` of the largest: others tell more of what is not mapped."""
    near = prepared.near(voxel * scale_of(place))
    shares = np.array([meet(*frame.sample(SAMPLES), near, place @ matrix)[1] for frame, matrix in seen])
    return [part for part, share in zip(seen, shares, strict=True) if share >= least * shares.max()]


def _scores(
    submap: Submap, sample: tuple[np.ndarray, np.ndarray], prepared: PreparedMap, place: np.ndarray
) -> np.ndarray:
    """Return how well (G,) submap and map lie on each other after each of :data:`GROWTHS`."""
    center, unit = submap.center, submap.voxel * scale_of(place)
    grids = [prepared.near(unit * factor) for factor in GRIDS]
    scores = np.empty(len(GROWTHS))
    for k, growth in enumerate(GROWTHS):
        start = np.linalg.inv(place @ scaling(np.exp(growth), center))
        fit = align_through(*sample, submap.levels[2:0:-1], start, iterations=10)
        grown = np.linalg.inv(fit.matrix)
        met = np.mean([meet(submap.points, submap.normals, near, grown)[0] for near in grids])
        scores[k] = np.sqrt(fit.score * met)
    return scores


def middle(steps: np.ndarray, scores: np.ndarray) -> float | None:
    """Return the middle of those (S,) steps whose scores (S,) are nearly the best; None where an end is among them."""
    weights = np.maximum(scores - NEARLY * scores.max(), 0.0)
    if weights[0] > 0.0 or weights[-1] > 0.0 or not weights.any():
        return None
    return float(weights @ steps / weights.sum())
