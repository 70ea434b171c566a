"""Two clouds in cells whose edges fit each other at any scale, and how far they agree under a transform there.

Where one cloud is much larger than the other, lengths relative to their radii mean nothing. Here they come from the
structure of the source: the edge of the cells that a few thousand of it occupy. The target is looked at on a ladder of
such cells, on the rung that fits the scale in question.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property

import numpy as np

from csgm_ros.cloud.agreement import Comparison
from csgm_ros.cloud.cells import Cells, cells, working_size
from csgm_ros.cloud.witnesses import Witnesses, asked, robust_radius
from csgm_ros.progress import Look, unhurried
from csgm_ros.transform import batch_icp

WORKING = 4000  # cells of the source
MOST = 40000  # cells of the target, of 2 * WORKING of the source
RUNG = 1.6  # between the edges of the target's cells on two rungs
COMPARED = 2.0  # cells: at which length of structure the clouds are compared; photographs are bent at finer ones
ASKED, MOST_ASKED = 1500, 6000  # cells
NEIGHBORS = 12
LEAST = 30  # cells with a normal, below which a cloud shows nothing
SAME = 2.0  # cells of mean displacement up to which two transforms are one
APART = 6.0  # nearer to a better one, a finalist is the same but for bent clouds and noise
FINALISTS = 6
ROUNDS = (((4.0, 3.0), 300, False, 40), ((2.0, 1.5), 500, False, 16), ((2.0, 1.2, 0.8), 2000, True, 16))
"""Of the refinement: gates of the ICP in cells, points of the source, on the finer tables, and how many are left."""
COLLAPSED = 2.0  # change of the scale from which an ICP has shrunk the source onto a few points
SCALES = 1e-4, 1e4  # between the normalised clouds, beyond which nothing is compared
MIN_INLIERS = 20  # points that must agree, for shares to mean anything
PROBES = 60
ITERATIONS = 5  # of ICP, per gate
TARGET_SAMPLES = 4  # times as many points of the target as of the source: most of them are not on the source


class Ladder:
    """Source and target in cells, made when they are asked for.

    Parameters
    ----------
    source, target : (N, 3), (M, 3) ndarray
        Finite points.
    seed : int
    look : callable, optional
        Asked between the steps of a search.

    Attributes
    ----------
    finalists : dict of str to (F, 4, 4) ndarray
        What each search in these cells has found, by the name of the source, best first.
    """

    def __init__(self, source: np.ndarray, target: np.ndarray, seed: int, look: Look = unhurried):
        self._clouds, self._seed, self.look = (source, target), seed, look
        self._rungs: dict[int, Cells] = {}
        self._comparisons: dict[int, Comparison | None] = {}
        self.finalists: dict[str, np.ndarray] = {}

    @cached_property
    def source(self) -> Cells:
        """The source in its working cells."""
        points = self._clouds[0]
        return cells(points, working_size(points, WORKING), 2 * WORKING, np.random.default_rng(self._seed))

    def rung(self, scale: float) -> Cells:
        """Return the target in cells about as large as the source's under a scale."""
        number = _number(scale)
        if number not in self._rungs:
            size = self.source.size * RUNG**number
            self._rungs[number] = cells(self._clouds[1], size, MOST, np.random.default_rng(self._seed))
        return self._rungs[number]

    def best(self, starts: np.ndarray, *, estimate_scale: bool) -> np.ndarray:
        """Return the best different ones (F, 4, 4) of (H, 4, 4) transforms, best first, refined round by round."""
        scores = np.zeros(len(starts))
        for gates, samples, fine, count in ROUNDS:
            refined = self.refine(starts, gates, samples, fine=fine, estimate_scale=estimate_scale)
            again = self.scores(refined)
            better = again >= scores
            starts, scores = np.where(better[:, None, None], refined, starts), np.maximum(scores, again)
            kept = self.distinct(starts, np.argsort(-scores, kind='stable'), count)
            starts, scores = starts[kept], scores[kept]
        return starts

    def scores(self, transforms: Iterable[np.ndarray]) -> np.ndarray:
        """Return how far the clouds agree (H,) under (H, 4, 4) transforms, see :class:`Comparison`."""
        return np.array([self._score(transform) for transform in transforms])

    def _score(self, transform: np.ndarray) -> float:
        scale = scale_of(transform)
        if not comparable(scale):
            return 0.0
        number = _number(scale)
        comparison, back = self.comparison(number), RUNG**-number
        if comparison is None:
            return 0.0
        agreement = comparison.agreement(transform @ np.diag([back, back, back, 1.0]))
        return agreement.evidence if agreement.inliers >= MIN_INLIERS else 0.0

    def comparison(self, number: int) -> Comparison | None:
        """Return the clouds on a rung, the source enlarged to it; None where one of them shows nothing there."""
        if number not in self._comparisons:
            self._comparisons[number] = self._compared(RUNG**number)
        return self._comparisons[number]

    def _compared(self, factor: float) -> Comparison | None:
        rung = self.rung(factor)
        sides = [_known(factor * self.source.points, self.source.normals), _known(rung.points, rung.normals)]
        if min(len(points) for points, _ in sides) < LEAST:
            return None
        cell = COMPARED * factor * self.source.size
        reach = 2.0 * min(robust_radius(points) for points, _ in sides)
        first, second = (self._asked(*side, cell, reach) for side in sides)
        return Comparison(first, second, cell)

    def _asked(self, points: np.ndarray, normals: np.ndarray, cell: float, reach: float) -> Witnesses:
        count = int(np.clip(ASKED * len(points) / len(self.source.points), ASKED, MOST_ASKED))
        return asked(points, normals, cell, reach, np.random.default_rng(self._seed), NEIGHBORS, count)

    def refine(
        self, transforms: np.ndarray, gates: tuple[float, ...], samples: int, *, fine: bool, estimate_scale: bool
    ) -> np.ndarray:
        """Refine (H, 4, 4) transforms by a short ICP.

        Parameters
        ----------
        gates : tuple of float
            Largest distances of correspondences, cells.
        samples : int
            Points of the source that seek a partner.
        fine : bool
            On the finer, narrower tables of nearest points.
        """
        out = np.empty_like(transforms)
        source = self.source.near(fine=fine)
        chosen = np.random.default_rng(self._seed).permutation(len(source.points))[:samples]
        for h, transform in enumerate(transforms):
            self.look()
            scale = scale_of(transform)
            target = self.rung(scale).near(fine=fine)
            others = np.arange(0, len(target.points), max(1, len(target.points) // (TARGET_SAMPLES * samples)))
            lengths = tuple(gate * scale * self.source.size for gate in gates)
            refined = batch_icp.refine_all(
                transform[None],
                source,
                target,
                (chosen, others),
                lengths,
                0.0,
                iterations=ITERATIONS,
                estimate_scale=estimate_scale,
            )[0]
            out[h] = transform if collapsed(scale_of(refined), scale) else refined
        return out

    def distinct(self, transforms: np.ndarray, order: Iterable[int], count: int, distance: float = SAME) -> list[int]:
        """Return the first ``count`` indices of an order whose (H, 4, 4) transforms differ by ``distance`` cells."""
        images = np.empty((count, *self._probe.shape))
        kept: list[int] = []
        for h in order:
            image = self._probe @ transforms[h, :3, :3].T + transforms[h, :3, 3]
            near = distance * self.source.size * scale_of(transforms[h])
            if kept and np.linalg.norm(images[: len(kept)] - image, axis=2).mean(1).min() < near:
                continue
            images[len(kept)] = image
            kept.append(h)
            if len(kept) == count:
                break
        return kept

    def places(self, transforms: np.ndarray) -> list[np.ndarray]:
        """Return (H, 4, 4) transforms by place, at most ``FINALISTS`` of those, in the order given."""
        found: list[np.ndarray] = []
        while len(transforms) and len(found) < FINALISTS:
            here = np.array([self.alike(transforms[0], transform, APART) for transform in transforms])
            found.append(transforms[here])
            transforms = transforms[~here]
        return found

    def news(self, transforms: np.ndarray, known: np.ndarray) -> np.ndarray:
        """Return those of (H, 4, 4) transforms that are not the same as one of (K, 4, 4) that fits as well."""
        others = self.scores(known)
        new = [
            not any(self.alike(other, transform, APART) for other in known[others >= score])
            for transform, score in zip(transforms, self.scores(transforms), strict=True)
        ]
        return transforms[np.array(new, bool)]

    def alike(self, first: np.ndarray, second: np.ndarray, distance: float = SAME) -> bool:
        """Return whether two (4, 4) transforms move the source to the same place, within ``distance`` cells."""
        return len(self.distinct(np.stack([first, second]), (0, 1), 2, distance)) == 1

    @cached_property
    def _probe(self) -> np.ndarray:
        return self.source.points[:: max(1, len(self.source.points) // PROBES)]


def collapsed(end: float, start: float) -> bool:
    """Return whether an ICP that took the scale from ``start`` to ``end`` has left what it started from."""
    return not 1.0 / COLLAPSED < end / start < COLLAPSED


def comparable(scale: float) -> bool:
    """Return whether clouds can be compared at a scale between their normalised frames."""
    return SCALES[0] < scale < SCALES[1]


def _number(scale: float) -> int:
    return round(np.log(scale) / np.log(RUNG))


def _known(points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    known = (normals != 0).any(1)
    return points[known], normals[known]


def scale_of(transform: np.ndarray) -> float:
    """Return the scale of a (4, 4) similarity matrix."""
    return float(np.cbrt(np.linalg.det(transform[:3, :3])))
