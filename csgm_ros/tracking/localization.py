"""Find a local submap in the map: hypotheses from anywhere, refined by what the map says of the sensor's surface.

The map's points move onto the sensor's surfaces, not the other way round: a depth sensor's normals can be trusted,
those of a noisy reconstruction cannot, and only the map's points within view have a say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from csgm_ros.tracking import surface
from csgm_ros.tracking.alignment import align
from csgm_ros.tracking.evidence import Evidence, weigh
from csgm_ros.tracking.maps import Level, PreparedMap
from csgm_ros.tracking.surface import Surface
from csgm_ros.tracking.views import View

LEVELS = (1.5, 3.0, 6.0, 12.0)  # edges of a submap's voxels, frame voxels
SCALES = (0.85, 0.92, 1.08, 1.17)  # tried around the scale of a hypothesis
VIEWS = 6
FEW, MANY = 1200, 4000
GLANCE = 300
OWN = 1500


@dataclass(frozen=True, eq=False)
class Submap:
    """What the sensor saw lately, in one frame, metres.

    Attributes
    ----------
    voxel : float
        Of the frames, metres.
    levels : tuple of Surface
        Fine to coarse.
    views : tuple of View
    points, normals : (N, 3) ndarray
        Sample that stands for what the frames returned.
    """

    voxel: float
    levels: tuple[Surface, ...]
    views: tuple[View, ...]
    points: np.ndarray
    normals: np.ndarray


class Place(NamedTuple):
    """A hypothesis where the submap lies: its matrix leads to the map."""

    matrix: np.ndarray
    evidence: Evidence


def joined(parts: Sequence[tuple], voxel: float) -> Submap:
    """Join (Frame, rigid (4, 4) pose) pairs into one submap."""
    points = np.concatenate([frame.points @ m[:3, :3].T + m[:3, 3] for frame, m in parts])
    normals = np.concatenate([frame.normals @ m[:3, :3].T for frame, m in parts])
    levels = []
    for size in LEVELS:
        levels.append(surface.build(points, normals, size * voxel))
        points, normals = levels[-1].points, levels[-1].normals
    chosen = np.unique(np.linspace(0, len(parts) - 1, VIEWS).round().astype(int))
    views = tuple(parts[k][0].view._replace(matrix=parts[k][1]) for k in chosen)
    samples = [frame.sample(OWN // len(parts)) for frame, _ in parts]
    moves = [m for _, m in parts]
    own = np.concatenate([points @ m[:3, :3].T + m[:3, 3] for (points, _), m in zip(samples, moves, strict=True)])
    turned = np.concatenate([normals @ m[:3, :3].T for (_, normals), m in zip(samples, moves, strict=True)])
    return Submap(voxel, tuple(levels), views, own, turned)


class Localizer:
    """Ranks hypotheses for one submap in one map.

    Parameters
    ----------
    submap : Submap
    prepared : PreparedMap
    rng : numpy.random.Generator
    """

    def __init__(self, submap: Submap, prepared: PreparedMap, rng: np.random.Generator):
        self._submap, self._map = submap, prepared
        self._levels: dict[int, Level] = {}
        order = rng.permutation(len(prepared.points))[:MANY]
        self._points, self._normals = prepared.points[order], prepared.normals[order]
        fine = submap.levels[1]
        order = rng.permutation(len(fine.points))[:OWN]
        self._own = fine.points[order], fine.normals[order]  # evenly over the surface, as that tells places apart

    def best(self, hypotheses: np.ndarray, count: int = 8, *, fixed_scale: bool = False) -> list[Place]:
        """Refine (H, 4, 4) hypotheses (submap to map) and return the best different places, best first."""
        places = [self.weighed(self.refined(matrix, FEW, coarse=True)) for matrix in hypotheses]
        places = self._distinct(places)[:count]
        tried = (1.0,) if fixed_scale else (1.0, *SCALES)
        places = [self._best_scale(place, tried) for place in places]
        return self._distinct([self.weighed(self.refined(place.matrix, MANY)) for place in places])

    def promising(self, hypotheses: np.ndarray, count: int = 12) -> np.ndarray:
        """Return the best of many (H, 4, 4) hypotheses after a look at few points."""
        found, scores = [], []
        few, own = self._points[:GLANCE], (self._own[0][:GLANCE], self._own[1][:GLANCE])
        for matrix in hypotheses:
            start = np.linalg.inv(matrix)
            for level in (3, 2):
                surface_ = self._submap.levels[level]
                start = align(few, None, surface_, start, (surface_.voxel,), iterations=5).matrix
            matrix = np.linalg.inv(start)
            found.append(matrix)
            near = self.level(scale_of(matrix)).near
            scores.append(weigh(*own, near, few, matrix, self._submap.views[-2:]).score)
        return np.stack(found)[np.argsort(-np.array(scores), kind='stable')[:count]]

    def _best_scale(self, place: Place, factors: Sequence[float]) -> Place:
        center = self._own[0].mean(0)
        found = [
            self.weighed(self.refined(place.matrix @ scaling(factor, center), FEW, coarse=True)) for factor in factors
        ]
        return max(found, key=lambda place: place.evidence.score)

    def refined(self, matrix: np.ndarray, count: int, *, coarse: bool = False) -> np.ndarray:
        """Lay the map on the submap, the scale kept; return the pose of the submap in the map."""
        start = np.linalg.inv(matrix)
        points, normals = self._points[:count], self._normals[:count]
        for level in (3, 2, 1) if coarse else (2, 1, 0):
            own = self._submap.levels[level]
            start = align(points, normals, own, start, (own.voxel,), iterations=8, min_cosine=0.5).matrix
        return np.linalg.inv(start)

    def weighed(self, matrix: np.ndarray) -> Place:
        """Return a place with what speaks for it."""
        near = self.level(scale_of(matrix)).near
        return Place(matrix, weigh(*self._own, near, self._points, matrix, self._submap.views))

    def seen(self, matrix: np.ndarray) -> Evidence:
        """Return what the frames say of a place, comparable to what a single one says while tracking."""
        near, submap = self.level(scale_of(matrix)).near, self._submap
        return weigh(submap.points, submap.normals, near, self._points, matrix, submap.views)

    def level(self, scale: float) -> Level:
        """Return the map at about a scale, map units a metre."""
        step = round(np.log(scale) / 0.05)
        if step not in self._levels:
            self._levels[step] = self._map.level(self._submap.voxel * np.exp(0.05 * step))
        return self._levels[step]

    def _distinct(self, places: list[Place]) -> list[Place]:
        """Sort by score; drop what moves the submap to where a better place has it."""
        probe = self._own[0][:60]
        kept: list[Place] = []
        for place in sorted(places, key=lambda place: -place.evidence.score):
            image = moved(place.matrix, probe)
            limit = 6 * self._submap.voxel * scale_of(place.matrix)
            if all(np.linalg.norm(image - moved(other.matrix, probe), axis=1).mean() > limit for other in kept):
                kept.append(place)
        return kept


def moved(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return (N, 3) points moved by a (4, 4) matrix."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def scale_of(matrix: np.ndarray) -> float:
    """Return the scale of a (4, 4) similarity."""
    return float(np.cbrt(np.linalg.det(matrix[:3, :3])))


def scaling(factor: float, center: np.ndarray) -> np.ndarray:
    """Return the (4, 4) matrix that scales about a point."""
    matrix = np.diag((factor, factor, factor, 1.0))
    matrix[:3, 3] = (1.0 - factor) * center
    return matrix
