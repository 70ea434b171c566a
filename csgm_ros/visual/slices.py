"""Thin slices through two clouds laid on each other: where they belong together, one outline; elsewhere two."""

from __future__ import annotations

import numpy as np

from csgm_ros.io.results import SOURCE_TINT, TARGET_TINT
from csgm_ros.types import Similarity

HALF = 0.015  # half the thickness, in radii
AROUND = 0.5  # of the longest side of the box where both clouds are, shown around it
PLACES = np.linspace(0.1, 0.9, 17)  # quantiles of the overlap along an axis at which a slice is tried


def slices(source: np.ndarray, target: np.ndarray, size: tuple[int, int] = (430, 560)) -> list[tuple[str, np.ndarray]]:
    """Draw three slices, one across each principal axis of the target, each where both clouds show most outline.

    Parameters
    ----------
    source, target : (N, 3), (M, 3) ndarray
        Finite points, the source already moved.
    size : (int, int)
        Height and width in pixels.

    Returns
    -------
    list of (str, (H, W, 3) ndarray)
        Title and picture in [0, 1]: the target blue, the source orange, dark where they are in one place.
    """
    frame = frame_of(target)
    clouds = [frame.apply(cloud) for cloud in (source, target)]
    clouds = [cloud[(np.abs(cloud) < 1.6).all(axis=1)] for cloud in clouds]
    axes = principal_axes(clouds[1])
    made, place = [], common(*clouds)
    clouds = [cloud[((cloud > place[0]) & (cloud < place[1])).all(axis=1)] for cloud in clouds]
    for k in range(3):
        flat = [(axes[(k + 1) % 3], axes[(k + 2) % 3]), (axes[0], axes[2]), (axes[0], axes[1])][k]
        cuts = [_cut(clouds, axes[k], flat, place) for place in _places(clouds, axes[k])]
        made.append((f'slice across axis {k + 1}', _drawn(_most_outline(cuts), size)))
    return made


def common(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the box where both of two clouds are, half as large again towards every side.

    What is looked at there shows how they lie on each other even where one is much larger. Where they do not meet, it
    is all of both.
    """
    corners = [np.quantile(cloud, (0.002, 0.998), axis=0) for cloud in (first, second) if len(cloud)]
    if not corners:
        return np.full(3, -np.inf), np.full(3, np.inf)
    low, high = np.max([c[0] for c in corners], axis=0), np.min([c[1] for c in corners], axis=0)
    if (low >= high).any():
        return np.min([c[0] for c in corners], axis=0), np.max([c[1] for c in corners], axis=0)
    margin = AROUND * (high - low).max()
    return low - margin, high + margin


def frame_of(points: np.ndarray) -> Similarity:
    """Return the similarity from (N, 3) points to centre 0 and radius 1, blind to a few far outliers."""
    middle = np.median(points, axis=0)
    radius = float(np.quantile(np.linalg.norm(points - middle, axis=1), 0.98)) or 1.0
    return Similarity(1.0 / radius, np.eye(3), -middle / radius)


def principal_axes(points: np.ndarray) -> np.ndarray:
    """Return the principal axes of (N, 3) points as rows, the longest first."""
    return np.linalg.eigh(np.cov(points.T))[1].T[::-1].copy()


def _places(clouds: list[np.ndarray], axis: np.ndarray) -> np.ndarray:
    heights = [cloud @ axis for cloud in clouds if len(cloud)]
    low, high = (pick([np.quantile(h, q) for h in heights]) for pick, q in ((max, 0.05), (min, 0.95)))
    return low + PLACES * (high - low)


def _cut(clouds, axis: np.ndarray, flat: tuple[np.ndarray, np.ndarray], place: float) -> list[np.ndarray]:
    return [cloud[np.abs(cloud @ axis - place) < HALF] @ np.transpose(flat) for cloud in clouds]


def _most_outline(cuts: list[list[np.ndarray]]) -> list[np.ndarray]:
    """Return the cut of which the barer cloud shows most, leaving out those that lie in a plane and are filled."""
    cells = np.array([min(len(np.unique((cut * 40).astype(int), axis=0)) for cut in both) for both in cuts])
    filled = cells > 2.5 * max(np.median(cells), 1)
    return cuts[int(np.argmax(np.where(filled, -1, cells)))]


def _drawn(cut: list[np.ndarray], size: tuple[int, int]) -> np.ndarray:
    height, width = size
    both = np.concatenate(cut) if sum(map(len, cut)) else np.zeros((1, 2))
    low, high = np.quantile(both, (0.002, 0.998), axis=0)
    step = max((high[0] - low[0]) / (width - 30), (high[1] - low[1]) / (height - 30), 1e-12)
    image = np.ones((height, width, 3))
    for points, tint in zip(cut, (SOURCE_TINT, TARGET_TINT), strict=True):
        pixel = np.round((points - (low + high) / 2) / step + (width / 2, height / 2)).astype(int)
        mask = np.zeros((height + 4, width + 4), bool)
        for dy in range(3):
            for dx in range(3):
                v, u = height - pixel[:, 1] + dy, pixel[:, 0] + dx
                inside = (u >= 0) & (u < width + 4) & (v >= 0) & (v < height + 4)
                mask[v[inside], u[inside]] = True
        image[mask[2:-2, 2:-2]] *= np.array(tint)
    return image
