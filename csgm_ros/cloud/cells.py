"""A cloud in working cells: the length that its structure has, whatever its extent."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from csgm_ros.cloud import nearest_grid
from csgm_ros.cloud.normals import plane_normals
from csgm_ros.cloud.planes import Plane, dominant_planes
from csgm_ros.cloud.voxels import lattice_origin, occupied, voxel_means, voxelize
from csgm_ros.types import NearestGrid

BLOCK = 4  # cells; a block of so many on a side ...
MIN_IN_BLOCK = 4  # ... with fewer occupied ones holds strays
NORMAL_VOXEL = 2.0  # cells: normals are those of voxels with their neighbours' neighbours, so within 5 cells
TOLERANCE = 0.05  # of the number of cells
FACES, FACE_SHARE = 8, 0.01  # planes at most, and the share of the cells that each has at least


@dataclass(frozen=True, eq=False)
class Cells:
    """The occupied cells of a cloud, strays left out.

    Attributes
    ----------
    points : (n, 3) ndarray
        Mean point of each.
    size : float
        Edge of a cell.
    filling : float
        Points of the cloud in each, strays among them, on average.
    """

    points: np.ndarray
    size: float
    filling: float

    @cached_property
    def normals(self) -> np.ndarray:
        """Unsigned unit normals (n, 3); zeros where the neighbourhood is a line."""
        return self.voxel_normals(NORMAL_VOXEL)

    def voxel_normals(self, edge: float) -> np.ndarray:
        """Return unsigned unit normals (n, 3) of voxels of some cells with their neighbours' neighbours."""
        grid = voxelize(self.points, edge * self.size)
        return plane_normals(grid, np.zeros(len(grid.keys), np.int64))[grid.point_voxels]

    @cached_property
    def planes(self) -> list[Plane]:
        """The dominant planes, largest first."""
        return dominant_planes(self.points, self.normals, self.size)

    @cached_property
    def faces(self) -> list[Plane]:
        """The dominant planes and smaller ones, largest first: those that a part of the cloud may show."""
        return dominant_planes(self.points, self.normals, self.size, FACES, FACE_SHARE)

    def near(self, *, fine: bool) -> NearestGrid:
        """Return the look-up table of the nearest cell, coarse and wide, or fine and narrow."""
        return self._fine if fine else self._wide

    @cached_property
    def _wide(self) -> NearestGrid:
        return nearest_grid.build(self.points, self.normals, 2.0 * self.size, 4.5 * self.size)

    @cached_property
    def _fine(self) -> NearestGrid:
        return nearest_grid.build(self.points, self.normals, self.size, 2.5 * self.size)


def cells(points: np.ndarray, size: float, most: int, rng: np.random.Generator) -> Cells:
    """Return the cells with edge ``size`` that (N, 3) points occupy, at most ``most`` drawn ones of them."""
    means = voxel_means(points, size)
    kept = means[_in_company(means, size)]
    if len(kept) < len(means) / 20:  # no surface is sampled so finely
        kept = means
    if len(kept) > most:
        kept = kept[np.sort(rng.choice(len(kept), most, replace=False))]
    return Cells(kept, size, len(points) / len(means))


def working_size(points: np.ndarray, count: int) -> float:
    """Return the edge of the cells of which (N, 3) points occupy about ``count``, at most half as many as points."""
    count = min(count, len(points) // 2)
    size = np.ptp(points, axis=0).max() / np.sqrt(count)
    low, high = 0.0, np.inf
    for _ in range(20):
        found = _count(points, size)
        if abs(found / count - 1) < TOLERANCE:
            break
        low, high = (size, high) if found > count else (low, size)
        guess = size * np.sqrt(found / count)  # as for a surface
        size = guess if low < guess < high else (low + high) / 2 if np.isfinite(high) else 2 * size
    return float(size)


def _count(points: np.ndarray, size: float) -> int:
    return len(occupied(points, lattice_origin(points, size), size)[0])


def _in_company(means: np.ndarray, size: float) -> np.ndarray:
    block = BLOCK * size
    keys, block_of = occupied(means, lattice_origin(means, block), block)
    return np.bincount(block_of, minlength=len(keys))[block_of] >= MIN_IN_BLOCK
