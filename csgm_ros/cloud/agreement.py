"""How far two clouds agree under a transform: where they meet, and how much of what they show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from csgm_ros.cloud.kernels import kernel
from csgm_ros.cloud.nearest_grid import lookup
from csgm_ros.cloud.normals import cosine
from csgm_ros.cloud.witnesses import NEAR, Witnesses

INLIER = 0.5  # cells
MIN_ANGLE, MAX_ANGLE, BENDS = 15.0, 40.0, 1.5  # degrees that normals may differ by; or medians across a neighbourhood
FAR, MEETS, CROSSES, AGREES = 0, 1, 2, 3


@dataclass(frozen=True)
class Agreement:
    """What the witnesses of both sides say of one transform; every plane counts once, and the side that says less.

    Attributes
    ----------
    precision : float
        Share of those that agree among those that meet the other cloud: contradiction lowers it, little
        overlap does not.
    coverage : float
        Share of those that agree in all that the smaller cloud has: little overlap lowers it.
    planes : float
        Independent planes (or pieces of curved surface) that agree.
    inliers : int
        Points that agree, of the side that has fewer.
    """

    precision: float
    coverage: float
    planes: float
    inliers: int

    @property
    def score(self) -> float:
        """Precision times coverage."""
        return self.precision * self.coverage

    @property
    def evidence(self) -> float:
        """Precision times planes: unlike shares, it does not prefer the scale at which there is least to agree."""
        return self.precision * self.planes


class Comparison:
    """Two clouds in one unit, at one cell, ready to be compared under transforms.

    Parameters
    ----------
    source, target : Witnesses
        In one unit: a transform's scale is about 1.
    cell : float
    """

    def __init__(self, source: Witnesses, target: Witnesses, cell: float):
        self.sides, self.cell = (source, target), cell
        self._weights = tuple(1.0 / side.coplanar for side in self.sides)
        self._least = min(weights.sum() for weights in self._weights)
        bend = max(side.bend for side in self.sides)
        self._min_cosine = cosine(min(MAX_ANGLE, max(MIN_ANGLE, BENDS * bend)))
        self._sorted: dict[tuple[int, int | None], tuple[np.ndarray, np.ndarray, np.ndarray]] = {}

    def agreement(self, transform: np.ndarray, most: int | None = None) -> Agreement:
        """Measure one (4, 4) transform, on ``most`` points of each side."""
        precision, planes, inliers = (values[0] for values in self.measured(transform[None], most))
        return Agreement(float(precision), float(min(1.0, planes / self._least)), float(planes), int(inliers))

    def scores(self, transforms: np.ndarray, most: int | None = None) -> np.ndarray:
        """Return the scores (H,) of (H, 4, 4) transforms on ``most`` points of each side."""
        precision, planes, _ = self.measured(transforms, most)
        return precision * np.minimum(1.0, planes / self._least)

    def measured(self, transforms: np.ndarray, most: int | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return ``precision``, ``planes`` and ``inliers`` (H,) of :class:`Agreement` of (H, 4, 4) transforms."""
        transforms = np.ascontiguousarray(transforms, float).reshape(-1, 4, 4)
        sides = enumerate((transforms, _inverses(transforms)))
        meets, agrees, inliers = np.stack([self._meet(side, matrices, most)[0] for side, matrices in sides], axis=1)
        return (agrees / np.maximum(meets, 1e-12)).min(0), agrees.min(0), inliers.min(0)

    def _meet(
        self, side: int, matrices: np.ndarray, most: int | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what a side meets under (H, 4, 4) matrices, as ``most`` of its points tell.

        These are (3, H): weights that meet and that agree, points that agree; then the states of its points, and which
        of the other side's are nearest, under the last of the matrices.
        """
        points, normals, weights = self._asked(side, most)
        found = np.empty((3, len(matrices)))
        states, near = np.empty(len(points), np.int8), np.empty(len(points), np.int64)
        _meet_all(matrices, points, normals, *self._other(side), weights, states, near, *found)
        return found, states, near

    def _asked(self, side: int, most: int | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return points, normals and weights of a side that are asked, as they lie in memory: voxel by voxel."""
        if (side, most) not in self._sorted:
            seen = self.sides[side]
            order = np.argsort(seen.sample[:most])
            sample = seen.sample[order]
            self._sorted[side, most] = seen.points[sample], seen.normals[sample], self._weights[side][order]
        return self._sorted[side, most]

    def _other(self, side: int) -> tuple[tuple, tuple]:
        """Return where a side is looked for, and the lengths and the cosine by which it is found."""
        still = self.sides[1 - side]
        grid = still.grid
        return (
            (grid.index, grid.origin, grid.cell, grid.points, grid.normals),
            (INLIER * self.cell, NEAR * self.cell, still.gap, self._min_cosine),
        )

    def overlap(self, transform: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the moved source points (I, 3) that agree, the target's normals there, and their weights."""
        points, _, weights = self._asked(0, None)
        _, states, near = self._meet(0, np.ascontiguousarray(transform[None], float))
        agree = states == AGREES
        there = self.sides[1].normals[near[agree]]
        return points[agree] @ transform[:3, :3].T + transform[:3, 3], there, weights[agree]


def _inverses(transforms: np.ndarray) -> np.ndarray:
    """Return the inverses of (H, 4, 4) similarities."""
    back = np.zeros_like(transforms)
    back[:, 3, 3] = 1.0
    back[:, :3, :3] = transforms[:, :3, :3].transpose(0, 2, 1) / (transforms[:, :3, 0] ** 2).sum(1)[:, None, None]
    back[:, :3, 3] = -(back[:, :3, :3] @ transforms[:, :3, 3:])[:, :, 0]
    return back


@kernel
def _meet_all(matrices, points, normals, grid, lengths, weights, states, near, meets, agrees, inliers):
    for h in range(len(matrices)):
        _meet(matrices[h], points, normals, grid, lengths, states, near)
        meets[h], agrees[h], inliers[h] = 0.0, 0.0, 0.0
        for k in range(len(points)):
            meets[h] += weights[k] * (states[k] > FAR)
            agrees[h] += weights[k] * (states[k] == AGREES)
            inliers[h] += states[k] == AGREES


@kernel
def _meet(m, points, normals, grid, lengths, states, near):
    index, origin, cell, still, still_normals = grid
    scale = np.sqrt(m[0, 0] ** 2 + m[1, 0] ** 2 + m[2, 0] ** 2)
    unit = np.sqrt(scale)  # neither cloud's cell counts more than the other's
    inlier, reach, gap, min_product = lengths[0] * unit, lengths[1] * unit, lengths[2] * unit, lengths[3] * scale
    for k in range(len(points)):
        a, b, c = points[k, 0], points[k, 1], points[k, 2]
        x = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c + m[0, 3]
        y = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c + m[1, 3]
        z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c + m[2, 3]
        q = lookup(index, origin, cell, x, y, z)
        near[k], states[k] = q, FAR
        if q < 0:
            continue
        dx, dy, dz = x - still[q, 0], y - still[q, 1], z - still[q, 2]
        squared = dx * dx + dy * dy + dz * dz
        if squared >= reach * reach:
            continue
        states[k] = MEETS
        u, v, w = still_normals[q, 0], still_normals[q, 1], still_normals[q, 2]
        height = dx * u + dy * v + dz * w
        aside = max(np.sqrt(max(squared - height * height, 0.0)) - gap, 0.0)
        if height * height + aside * aside >= inlier * inlier:
            continue
        a, b, c = normals[k, 0], normals[k, 1], normals[k, 2]
        product = (
            (m[0, 0] * a + m[0, 1] * b + m[0, 2] * c) * u
            + (m[1, 0] * a + m[1, 1] * b + m[1, 2] * c) * v
            + (m[2, 0] * a + m[2, 1] * b + m[2, 2] * c) * w
        )
        states[k] = AGREES if abs(product) >= min_product else CROSSES
