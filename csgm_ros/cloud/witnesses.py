"""The clouds at the length of their structure, and how much each point of them says.

Lengths are relative to a *cell*: the voxel of which the smaller cloud occupies some thousands, whatever its extent. A
floor of a thousand points is no more than one witness: they all say the same. So a point counts the less, the more
points lie in its plane.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from csgm_ros.cloud import nearest_grid
from csgm_ros.cloud.kernels import kernel
from csgm_ros.cloud.normals import cosine
from csgm_ros.cloud.outliers import distances_from
from csgm_ros.cloud.prepare import normals_of
from csgm_ros.cloud.voxels import lattice_origin, occupied, voxel_means
from csgm_ros.types import NearestGrid

CELLS = 4000  # of the smaller cloud
FINE = 2.5  # points a cell, along an edge
MOST_POINTS, SAMPLES = 25000, 2000
ASKED = 8000  # points, if there are so many: of 2000, the margin of a real pair is chance by a third
NEAR, WIDE = 1.5, 4.1  # cells: where a point must find the other surface, and where ICP may look for it
COPLANAR_ANGLE, COPLANAR_OFFSET = 15.0, 0.75  # degrees, cells
ROUGH = (7.5, 15.0)  # degrees between neighbouring normals: a surface; nothing but noise


@dataclass(frozen=True, eq=False)
class Witnesses:
    """A cloud at the length of its structure.

    Attributes
    ----------
    points, normals : (N, 3) ndarray
    cell : float
    grid : NearestGrid
        Of all points, as far as a point that agrees may be.
    order : (N,) index array
        A random one, that of the sample.
    sample : (S,) index array
        The points that are asked.
    coplanar : (S,) ndarray
        How many of the sample lie in the plane of each, itself included; told from some of them.
    gap : float
        How far aside of a point the surface still is, for sparse clouds.
    bend : float
        Median angle in degrees between the normals across a neighbourhood: curvature, and noise.
    """

    points: np.ndarray
    normals: np.ndarray
    cell: float
    grid: NearestGrid
    order: np.ndarray
    sample: np.ndarray
    coplanar: np.ndarray
    gap: float
    bend: float

    @cached_property
    def wide(self) -> NearestGrid:
        """Of some points, within reach of a wide correspondence distance."""
        some = np.sort(self.order[: max(3000, len(self.points) // 5)])
        return nearest_grid.build(self.points[some], self.normals[some], 0.75 * self.cell, WIDE * self.cell)

    def resized(self, factor: float) -> Witnesses:
        """Return the witnesses of the cloud that is so many times as large, at a cell that is too."""
        points, grid = self.points * factor, self.grid
        grid = grid._replace(points=points, origin=grid.origin * factor, cell=grid.cell * factor)
        return replace(self, points=points, cell=self.cell * factor, grid=grid, gap=self.gap * factor)


def working_cell(points: np.ndarray, count: int = CELLS) -> float:
    """Return the edge of the voxels of which (N, 3) points occupy ``count``, or a quarter of the points if fewer."""
    points = points[:: max(1, len(points) // 60000)]
    count = min(count, len(points) // 4)
    size, low, high = float(np.ptp(points, axis=0).max()) / np.sqrt(count), 0.0, np.inf
    for _ in range(20):
        found = len(occupied(points, lattice_origin(points, size), size)[0])
        if abs(found - count) <= 0.03 * count:
            break
        low, high = (size, high) if found > count else (low, size)
        size *= np.sqrt(found / count)
        if not low < size < high:
            size = (low + high) / 2 if np.isfinite(high) else 2 * low
    return float(size)


def robust_radius(points: np.ndarray) -> float:
    """Return the distance to their median within which nine of ten (N, 3) points lie."""
    return float(np.percentile(distances_from(np.median(points, axis=0), points), 90))


def witnesses(
    points: np.ndarray, cell: float, plane_reach: float, rng: np.random.Generator, neighbors: int
) -> Witnesses:
    """Look at (N, 3) points at a cell.

    Parameters
    ----------
    plane_reach : float
        Points farther apart than this are in different planes, so that a large cloud's witnesses count as a small
        one's.
    neighbors : int
        Points from which a normal is estimated.
    """
    means = voxel_means(points, cell / FINE)
    if len(means) > MOST_POINTS:
        means = means[np.sort(rng.permutation(len(means))[:MOST_POINTS])]
    normals = normals_of(means, min(neighbors, len(means)))
    extent = len(occupied(means, lattice_origin(means, cell), cell)[0]) / CELLS
    count = int(np.clip(SAMPLES * extent, SAMPLES, ASKED))
    return asked(means, normals, cell, plane_reach, rng, neighbors, count, ASKED)


def asked(
    points: np.ndarray,
    normals: np.ndarray,
    cell: float,
    plane_reach: float,
    rng: np.random.Generator,
    neighbors: int,
    count: int,
    least: int = 0,
) -> Witnesses:
    """Return the witnesses of a cloud that is evenly sampled, see :func:`witnesses`.

    ``count`` of its points say how many share a plane, so many or ``least`` are asked.
    """
    order = rng.permutation(len(points))
    sample = order[: max(count, least)]
    more = len(sample) / len(sample[:count])
    gap, bend = _spacing(points, normals, sample[:1000], neighbors, cell)
    return Witnesses(
        points,
        normals,
        cell,
        nearest_grid.build(points, normals, 0.4 * cell, (NEAR + 0.1) * cell),
        order,
        sample,
        more
        * coplanar(points[sample], normals[sample], count, cosine(COPLANAR_ANGLE), COPLANAR_OFFSET * cell, plane_reach),
        gap,
        bend,
    )


def _spacing(points, normals, some, neighbors: int, cell: float) -> tuple[float, float]:
    from scipy.spatial import cKDTree

    near = min(neighbors, len(points))
    distances, index = cKDTree(points).query(points[some], k=[2, min(5, near), near])
    angles = np.degrees(np.arccos(np.minimum(1.0, np.abs(np.einsum('sd,skd->sk', normals[some], normals[index])))))
    known = np.interp(np.median(angles[:, 0]), ROUGH, (1.0, 0.0))
    return float(np.clip(np.median(distances[:, 1]) - 0.5 * cell, 0.0, cell) * known), float(np.median(angles[:, 2]))


@kernel
def coplanar(points, normals, most, min_cosine, max_offset, reach):
    """Return how many of the first ``most`` of (S, 3) points lie in the plane of each, within reach, and itself."""
    # columns, and no branch: vector code
    x, y, z = points[:, 0].copy(), points[:, 1].copy(), points[:, 2].copy()
    u, v, w = normals[:, 0].copy(), normals[:, 1].copy(), normals[:, 2].copy()
    count = np.ones(len(points), np.int64)
    for i in range(len(points)):
        here, mutual = np.int64(0), np.int64(i < most)
        for j in range(min(i, most)):
            a, b, c = x[j] - x[i], y[j] - y[i], z[j] - z[i]
            near = a * a + b * b + c * c <= reach * reach
            parallel = abs(u[i] * u[j] + v[i] * v[j] + w[i] * w[j]) >= min_cosine
            on_first = abs(a * u[i] + b * v[i] + c * w[i]) < max_offset
            on_second = abs(a * u[j] + b * v[j] + c * w[j]) < max_offset
            both = np.int64(near) & np.int64(parallel) & np.int64(on_first) & np.int64(on_second)
            here += both
            count[j] += both & mutual
        count[i] += here
    return count
