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
from csgm_ros.tracking.alignment import align_each, align_through
from csgm_ros.tracking.evidence import Evidence, meet, weigh
from csgm_ros.tracking.maps import PreparedMap
from csgm_ros.tracking.surface import Surface
from csgm_ros.tracking.views import View

LEVELS = (1.5, 3.0, 6.0, 12.0)  # edges of a submap's voxels, frame voxels
SCALES = (0.85, 0.92, 1.08, 1.17)  # tried around the scale of a hypothesis
APART = np.array((-0.06, 0.0, 0.06))  # logarithms of those that a parabola is laid through
HELD = 0.01  # share of the best score that the outermost of them must lose, for the scale to be seen
VIEWS = 6
FEW, MANY = 1200, 4000
GLANCE, LIKELY = 300, 0.4  # points at a glance; share of the hypotheses that get a second one
OWN = 1500
RIVAL = 0.5  # of the best score that a place must have, to be tried at other scales
SAME, DIFFERENT = 6.0, 12.0  # voxels of mean displacement up to which two places are one, and from which they compete
OTHER_SCALE = 0.3  # |log ratio| from which they compete, too


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

    @property
    def center(self) -> np.ndarray:
        """Mean (3,) of what the frames returned."""
        return self.points.mean(axis=0)

    def within(self, reach: float) -> np.ndarray:
        """Return the (N, 3) points no farther from where they were seen than ``reach`` times the median range.

        What is farther is seen and mapped with errors that grow with its range, and covers much of the surface.
        """
        centers = np.stack([view.matrix[:3, 3] for view in self.views])
        points = self.levels[0].points
        return points[_ranges(points, centers) <= reach * np.median(_ranges(self.points, centers))]


class Place(NamedTuple):
    """A hypothesis where the submap lies.

    Attributes
    ----------
    matrix : (4, 4) ndarray
        Leads to the map.
    evidence : Evidence
        Of a sample of what the frames returned, comparable to that of a single frame.
    cover : float
        ``on_map`` of a sample that is even over the surface, as that tells places of one size apart.
    """

    matrix: np.ndarray
    evidence: Evidence
    cover: float

    @property
    def score(self) -> float:
        """All in one number, for ranking: a place must explain near, dense returns as well as wide, sparse ones."""
        return float(np.sqrt(self.evidence.on_map * self.cover)) * self.evidence.agreement


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
    return Submap(voxel, tuple(levels), views, *sampled(parts, OWN))


def sampled(parts: Sequence[tuple], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return about (count, 3) points and normals that stand for what (Frame, rigid (4, 4) pose) pairs returned."""
    samples = [(*frame.sample(count // len(parts)), matrix) for frame, matrix in parts]
    points = np.concatenate([moved(matrix, points) for points, _, matrix in samples])
    return points, np.concatenate([normals @ matrix[:3, :3].T for _, normals, matrix in samples])


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
        self._near: dict[int, Surface] = {}
        order = nested(rng.permutation(len(prepared.points)), (GLANCE, FEW, MANY))
        self._points, self._normals = prepared.points[order], prepared.normals[order]
        fine = submap.levels[1]
        order = nested(rng.permutation(len(fine.points)), (GLANCE, OWN))
        self._own = fine.points[order], fine.normals[order]  # evenly over the surface, as that tells places apart

    def best(self, hypotheses: np.ndarray, count: int = 8, *, fixed_scale: bool = False) -> list[Place]:
        """Refine (H, 4, 4) hypotheses (submap to map), likely ones first; return the best different places, best first.

        It ends with the first ``count`` different places.
        """
        places: list[Place] = []
        for matrix in hypotheses:
            places = self.distinct([*places, self.weighed(self.refined(matrix, FEW, coarse=True))])
            if len(places) == count:
                break
        if not fixed_scale:
            rivals = [place for place in places if place.score >= RIVAL * places[0].score]
            others = places[len(rivals) :]
            places = [self._between_scales(self._best_scale(place, (1.0, *SCALES))) for place in rivals] + others
        return self.distinct([self.weighed(self.refined(place.matrix, MANY)) for place in places])

    def promising(self, hypotheses: np.ndarray, count: int = 12) -> np.ndarray:
        """Return the best different ones of many (H, 4, 4) hypotheses after a look at few points."""
        few, own = self._points[:GLANCE], (self._own[0][:GLANCE], self._own[1][:GLANCE])
        coarse, middle = self._submap.levels[3], self._submap.levels[2]
        starts, scores = align_each(few, None, coarse, np.linalg.inv(hypotheses), (coarse.voxel,), iterations=5)
        likely = np.argsort(-scores, kind='stable')[: max(count, round(len(starts) * LIKELY))]
        starts, _ = align_each(few, None, middle, starts[likely], (middle.voxel,), iterations=5)
        found = np.linalg.inv(starts)
        scores = np.empty(len(found))
        for k, matrix in enumerate(found):
            near = self._near_at(scale_of(matrix))
            scores[k] = weigh(*own, near, few, matrix, self._submap.views[-2:]).score
        kept: list[np.ndarray] = []
        for matrix in found[np.argsort(-scores, kind='stable')]:
            if len(kept) < count and not any(self.alike(matrix, other) for other in kept):
                kept.append(matrix)
        return np.array(kept).reshape(-1, 4, 4)

    def _best_scale(self, place: Place, factors: Sequence[float]) -> Place:
        center = self._own[0].mean(0)
        found = [self._at_scale(place, np.log(factor), center) for factor in factors]
        return max(found, key=lambda place: place.score)

    def _between_scales(self, place: Place) -> Place:
        """Return the place at the scale at which a parabola through its scores is highest: noise hides the best."""
        center = self._own[0].mean(0)
        found = [self._at_scale(place, step, center) for step in APART]
        growth = vertex(APART, np.array([each.score for each in found]))
        return place if growth is None else self._at_scale(place, growth, center)

    def _at_scale(self, place: Place, growth: float, center: np.ndarray) -> Place:
        return self.weighed(self.refined(place.matrix @ scaling(np.exp(growth), center), FEW, coarse=True))

    def refined(self, matrix: np.ndarray, count: int, *, coarse: bool = False) -> np.ndarray:
        """Lay the map on the submap, the scale kept; return the pose of the submap in the map."""
        start = np.linalg.inv(matrix)
        points, normals = self._points[:count], self._normals[:count]
        levels = [self._submap.levels[level] for level in ((3, 2, 1) if coarse else (2, 1, 0))]
        return np.linalg.inv(align_through(points, normals, levels, start, iterations=8).matrix)

    def rescaled(self, matrix: np.ndarray, scale: float) -> np.ndarray:
        """Return a pose (4, 4) at another scale, map units a metre, about what was seen."""
        return self.refined(matrix @ scaling(scale / scale_of(matrix), self._submap.center), MANY)

    def weighed(self, matrix: np.ndarray) -> Place:
        """Return a place with what speaks for it."""
        near, submap = self._near_at(scale_of(matrix)), self._submap
        evidence = weigh(submap.points, submap.normals, near, self._points, matrix, submap.views)
        return Place(matrix, evidence, meet(*self._own, near, matrix)[0])

    def alike(self, first: np.ndarray, second: np.ndarray) -> bool:
        """Return whether two poses (4, 4) put the submap in the same place."""
        return self._apart(first, second) <= SAME

    def rivals(self, places: Sequence[Place]) -> np.ndarray:
        """Return which places exclude each other, (P, P) bool.

        Tracking settles a place that is a little beside the right one, and a scale that is a little off: what leads to
        the other place at that one's scale is no rival.
        """
        out = np.zeros((len(places), len(places)), bool)
        for k, place in enumerate(places):
            for n, other in enumerate(places[:k]):
                out[k, n] = out[n, k] = self._exclude(other.matrix, place.matrix)
        return out

    def _exclude(self, better: np.ndarray, worse: np.ndarray) -> bool:
        growth = scale_of(better) / scale_of(worse)
        if abs(np.log(growth)) > OTHER_SCALE:
            return True
        center = np.mean([view.matrix[:3, 3] for view in self._submap.views], axis=0)
        resized = worse @ scaling(growth, center)
        if self._apart(better, resized) <= DIFFERENT:
            return False
        return self._apart(better, self.refined(resized, FEW, coarse=True)) > DIFFERENT

    def _apart(self, first: np.ndarray, second: np.ndarray) -> float:
        """Return the mean displacement between two poses (4, 4) of the submap, its voxels."""
        probe = self._own[0][:60]
        shift = np.linalg.norm(moved(first, probe) - moved(second, probe), axis=1).mean()
        return float(shift / (self._submap.voxel * scale_of(first)))

    def _near_at(self, scale: float) -> Surface:
        """Return what finds the map's points at about a scale, map units a metre."""
        step = round(np.log(scale) / 0.05)
        if step not in self._near:
            self._near[step] = self._map.near(self._submap.voxel * np.exp(0.05 * step))
        return self._near[step]

    def distinct(self, places: list[Place]) -> list[Place]:
        """Sort by score; drop what moves the submap to where a better place has it."""
        kept: list[Place] = []
        for place in sorted(places, key=lambda place: -place.score):
            if not any(self.alike(place.matrix, other.matrix) for other in kept):
                kept.append(place)
        return kept


def nested(order: np.ndarray, counts: Sequence[int]) -> np.ndarray:
    """Return the first of an index array, sorted from each of the ascending ``counts`` to the next."""
    return np.concatenate([np.sort(part) for part in np.split(order[: counts[-1]], counts[:-1])])


def _ranges(points: np.ndarray, centers: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - centers, axis=2).min(axis=1)


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


def vertex(steps: np.ndarray, scores: np.ndarray) -> float | None:
    """Return where a parabola through (S,) scores at (S,) logarithms, even about 0, is highest, within them.

    None where the scores say nothing of the scale, as of a single wall.
    """
    bend, slope, _ = np.polyfit(steps, scores, 2)
    if -bend * steps[-1] ** 2 <= HELD * np.max(scores):  # also where nothing fits
        return None
    return float(np.clip(-0.5 * slope / bend, steps[0], steps[-1]))
