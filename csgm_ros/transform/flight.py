"""A part in cells of its structure, a whole in cells that fit those at any scale, and how far the two agree there.

Where one cloud is much larger than the other, lengths relative to their radii mean nothing. Here they come from the
structure of the smaller one: the edge of the cells that a few thousand of it occupy. The other is looked at on a flight
of such cells, on the rung that fits the scale in question.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np

from csgm_ros.cloud.agreement import Comparison
from csgm_ros.cloud.cells import Cells, cells, working_size
from csgm_ros.cloud.prepare import normals_of
from csgm_ros.cloud.witnesses import Witnesses, asked, robust_radius
from csgm_ros.transform import batch_icp

WORKING = 4000  # cells of the part
MOST = 40000  # cells of the whole, of 2 * WORKING of the part
FINEST = 1e-5  # of the whole's extent: finer cells could not be numbered
RUNG = 1.6  # between the edges of the whole's cells on two rungs
NORMALS: tuple[Callable[[Cells], np.ndarray], ...] = (
    lambda seen: seen.normals,
    lambda seen: normals_of(seen.points, min(NEIGHBORS, len(seen.points))),
    lambda seen: seen.voxel_normals(1.0),
)
"""Normals by which clouds are compared: wide ones survive the rings of lidars, narrow ones show the edges of things."""
COMPARED = 2.0  # cells: at which length of structure the clouds are compared; photographs are bent at finer ones
ASKED, MOST_ASKED = 1500, 6000  # cells
NEIGHBORS = 12
LEAST = 30  # cells with a normal, below which a cloud shows nothing
COLLAPSED = 2.0  # change of the scale from which an ICP has shrunk the part onto a few points
SCALES = 1e-3, 1e3  # between the normalised clouds, beyond which nothing is compared
RESOLVED = 1.25  # points of the whole a cell, from which it shows surfaces; lidars have 1.5 where they see as much
MIN_INLIERS = 20  # points that must agree, for shares to mean anything
PROBES = 60
ITERATIONS = 5  # of ICP, per gate
OTHER_SAMPLES = 4  # times as many points of the whole as of the part: most of them are not on the part


class Flight:
    """Part and whole in cells, made when they are asked for; transforms go from the part to the whole.

    Parameters
    ----------
    part, whole : (N, 3), (M, 3) ndarray
        Finite points.
    seed : int
    """

    def __init__(self, part: np.ndarray, whole: np.ndarray, seed: int):
        self._clouds, self._seed = (part, whole), seed
        self._rungs: dict[int, Cells] = {}
        self._comparisons: dict[tuple[int, int], Comparison | None] = {}
        self._witnesses: dict[int, Witnesses | None] = {}

    @cached_property
    def part(self) -> Cells:
        """The part in its working cells."""
        points = self._clouds[0]
        return cells(points, working_size(points, WORKING), 2 * WORKING, np.random.default_rng(self._seed))

    @cached_property
    def _order(self) -> np.ndarray:
        return np.random.default_rng(self._seed).permutation(len(self.part.points))

    def rung(self, scale: float) -> Cells:
        """Return the whole in cells about as large as the part's under a scale."""
        number = _number(scale)
        if number not in self._rungs:
            whole = self._clouds[1]
            size = max(self.part.size * RUNG**number, FINEST * float(np.ptp(whole, axis=0).max()))
            self._rungs[number] = cells(whole, size, MOST, np.random.default_rng(self._seed))
        return self._rungs[number]

    def resolved(self, scale: float) -> bool:
        """Return whether the whole shows surfaces in cells about as large as the part's under a scale."""
        return self.rung(scale).filling >= RESOLVED

    def scores(self, transforms: np.ndarray, most: int | None = None, kind: int = 0) -> np.ndarray:
        """Return how far the clouds agree (H,) under (H, 4, 4) transforms, as ``most`` points of each tell.

        See :class:`csgm_ros.cloud.agreement.Comparison`; the scales are :func:`comparable` ones, the kind of normals
        one of ``NORMALS``.
        """
        scales = scales_of(transforms)
        numbers, scores = np.array([_number(scale) for scale in scales]), np.zeros(len(transforms))
        for number in np.unique(numbers):
            here = numbers == number
            comparison = self.comparison(scales[here][0], kind)
            if comparison is not None:
                shrunk = np.diag([*3 * [RUNG**-number], 1.0]) @ transforms[here]
                precision, planes, inliers = comparison.measured(shrunk, most)
                scores[here] = precision * planes * (inliers >= (0 if most else MIN_INLIERS))
        return scores

    def comparison(self, scale: float, kind: int = 0) -> Comparison | None:
        """Return the clouds on the rung of a scale, the whole shrunk to the part; None where one shows nothing."""
        number = _number(scale)
        if (number, kind) not in self._comparisons:
            if kind not in self._witnesses:
                self._witnesses[kind] = self._asked(self.part, 1.0, kind)
            part, whole = self._witnesses[kind], self._asked(self.rung(scale), RUNG**number, kind)
            self._comparisons[number, kind] = Comparison(part, whole, part.cell) if part and whole else None
        return self._comparisons[number, kind]

    def _asked(self, seen: Cells, factor: float, kind: int) -> Witnesses | None:
        points, normals = seen.points / factor, NORMALS[kind](seen)
        known = (normals != 0).any(1)
        if known.sum() < LEAST:
            return None
        count = int(np.clip(ASKED * known.sum() / len(self.part.points), ASKED, MOST_ASKED))
        cell, reach = COMPARED * self.part.size, 2.0 * robust_radius(self.part.points)
        rng = np.random.default_rng(self._seed)
        return asked(points[known], normals[known], cell, reach, rng, NEIGHBORS, count)

    def refined(
        self, transform: np.ndarray, gates: tuple[float, ...], samples: int, *, fine: bool, estimate_scale: bool
    ) -> np.ndarray:
        """Return a (4, 4) transform after a short ICP, or as it was where that has shrunk the part onto a few points.

        Parameters
        ----------
        gates : tuple of float
            Largest distances of correspondences, cells.
        samples : int
            Points of the part that seek a partner.
        fine : bool
            On the finer, narrower tables of nearest points.
        """
        scale, part = scale_of(transform), self.part.near(fine=fine)
        whole = self.rung(scale).near(fine=fine)
        chosen = self._order[:samples]
        others = np.arange(0, len(whole.points), max(1, len(whole.points) // (OTHER_SAMPLES * samples)))
        lengths = tuple(gate * scale * self.part.size for gate in gates)
        found = batch_icp.refine_all(
            transform[None],
            part,
            whole,
            (chosen, others),
            lengths,
            0.0,
            iterations=ITERATIONS,
            estimate_scale=estimate_scale,
        )[0]
        return transform if collapsed(scale_of(found), scale) else found

    def images(self, transforms: np.ndarray) -> np.ndarray:
        """Return where (H, 4, 4) transforms move some points of the part, (H, P, 3)."""
        some = self.part.points[:: max(1, len(self.part.points) // PROBES)]
        return some @ transforms[:, :3, :3].transpose(0, 2, 1) + transforms[:, None, :3, 3]


def collapsed(end: float, start: float) -> bool:
    """Return whether an ICP that took the scale from ``start`` to ``end`` has left what it started from."""
    return not 1.0 / COLLAPSED < end / start < COLLAPSED


def comparable(scale: float | np.ndarray) -> Any:
    """Return whether clouds can be compared at a scale, or which of several ones, between their normalised frames."""
    return (SCALES[0] < scale) & (scale < SCALES[1])


def _number(scale: float) -> int:
    return round(np.log(scale) / np.log(RUNG))


def scales_of(transforms: np.ndarray) -> np.ndarray:
    """Return the scales (H,) of (H, 4, 4) similarity matrices."""
    return np.cbrt(np.linalg.det(transforms[:, :3, :3]))


def scale_of(transform: np.ndarray) -> float:
    """Return the scale of a (4, 4) similarity matrix."""
    return float(np.cbrt(np.linalg.det(transform[:3, :3])))
