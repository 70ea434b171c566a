"""Step 2a, macro structure: supervoxels by VCCS on geometry alone, and their directed adjacency (Sec. III-B)."""

from __future__ import annotations

import numpy as np

from csgm_ros.cloud.kernels import kernel
from csgm_ros.cloud.normals import axes_of, plane_normals, products
from csgm_ros.cloud.voxels import FIXED, VoxelGrid, first_in_morton_order, occupied, unpacked, voxelize
from csgm_ros.errors import DegenerateCloudError, InputError
from csgm_ros.structure.region_growing import flow, nearest_to_centers
from csgm_ros.types import Supervoxels

# A seed needs this share of the voxels that a plane through it would fill, within half a seed spacing.
SEED_SUPPORT = 0.05


def segment(
    points: np.ndarray,
    voxel_size: float,
    seed_size: float,
    *,
    spatial_weight: float = 0.4,
    normal_weight: float = 1.0,
    normals: np.ndarray | None = None,
    refinements: int = 0,
) -> Supervoxels:
    """Cut a cloud into supervoxels: voxel cloud connectivity segmentation (VCCS) by geometry alone.

    Seeds on a lattice grow ring by ring over the 26-neighbourhood of the occupied voxels. In each ring a supervoxel
    takes the voxels that it touches and for which its
    ``D = normal_weight (1 - |n_c . n_v|) + spatial_weight |x_c - x_v| / seed_size``
    is smaller than the D with which they were last taken; then its centre x_c and normal n_c are averaged anew.

    Parameters
    ----------
    points : (N, 3) array_like
        Finite coordinates.
    voxel_size, seed_size : float
        Edge of a voxel and spacing of the seeds, in the cloud's unit; the seeds' is the larger one.
    spatial_weight, normal_weight : float
        Weights of the distance and of the angle.
    normals : (N, 3) array_like, optional
        Unit normals of the points, of any sign; estimated from the voxels when left out. Rows that are not finite
        count for nothing.
    refinements : int
        Rounds of seeding anew at the centres and flowing again.

    Returns
    -------
    Supervoxels
        Normals point away from the cloud's centre. Labels are numbered by the seeds' place on their lattice.

    Raises
    ------
    InputError
        If the points are not finite (N, 3), or the sizes do not fit them or each other.
    DegenerateCloudError
        If the points lie in one place or on one line, or no seed has enough voxels around it.

    Notes
    -----
    Source: Sec. III-B of the paper, after Papon et al. 2013 in the form that PCL gave it (a plain weighted sum, seeds
    that are not moved to a smooth place, no colour). The result follows the cloud through translation, scale and
    any order of the points; a rotation turns the lattices, hence moves the seeds. What is not as in PCL, and why:

    - Normals have no sign in the averages. PCL's depend on where the coordinates have their origin.
    - The first ring uses the seeds as centres. PCL's are still zero then, so that distances to the origin decide.
    - All supervoxels grow a ring at once, where PCL's take turns: their order does not matter.
    - Two seeds never share a voxel, and a seed's voxel stays its own: no supervoxel vanishes.
    - A voxel whose normal is undefined (its support is a line or less) has the largest angle to all, where PCL's
      NaN keeps it out of every supervoxel.
    - The voxels' lattice is moved by a thousandth of a voxel, see :data:`csgm_ros.cloud.voxels.PHASE`.
    """
    points = _checked(points, voxel_size, seed_size)
    grid = voxelize(points, voxel_size)
    _check_spread(grid, len(points))
    spacing = seed_size / voxel_size
    weights = (normal_weight, spatial_weight / spacing)
    if normals is None:
        axes = plane_normals(grid, np.zeros(len(grid.keys), np.int32))
    else:
        axes = _voxel_axes(_checked_normals(normals, len(points)), grid)
    seeds = _seeds(grid, spacing)
    labels, centers, center_axes = flow(grid, axes, seeds, (grid.centroids[seeds], axes[seeds]), spacing, weights)
    for _ in range(refinements):
        if normals is None:
            axes = plane_normals(grid, labels)
        seeds = nearest_to_centers(grid.centroids, labels, centers)
        labels, centers, center_axes = flow(grid, axes, seeds, (centers, center_axes), spacing, weights)
    middle = grid.centroids.mean(0)
    return Supervoxels(
        labels=labels[grid.point_voxels],
        centroids=grid.world(centers),
        normals=_outward(center_axes, centers - middle),
        sizes=np.bincount(labels[labels >= 0], minlength=len(seeds)),
        adjacency=_directed(_touching(labels, grid.starts, grid.neighbors), centers - middle),
        voxel_points=grid.world(grid.centroids),
        voxel_normals=_outward(axes, grid.centroids - middle),
        voxel_labels=labels,
        point_voxels=grid.point_voxels,
    )


def _checked(points: np.ndarray, voxel_size: float, seed_size: float) -> np.ndarray:
    """Return the points as contiguous float64, or raise."""
    points = np.ascontiguousarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f'points must be an (N, 3) array, not {points.shape}')
    if len(points) < 3:
        raise DegenerateCloudError(f'a cloud of {len(points)} points has no structure: give at least three')
    if not np.isfinite(points).all():
        raise InputError('points must be finite: drop rows with NaN or infinity before')
    if not 0 < voxel_size < seed_size < np.inf:
        raise InputError(
            f'sizes must be finite with 0 < voxel_size < seed_size, not voxel_size {voxel_size:g}, '
            f'seed_size {seed_size:g}: supervoxels are made of several voxels'
        )
    return points


def _checked_normals(normals: np.ndarray, count: int) -> np.ndarray:
    """Return the points' normals as float64 with zeros for rows that are not finite, or raise."""
    normals = np.asarray(normals, np.float64)
    if normals.shape != (count, 3):
        raise InputError(f'normals must have one row a point, ({count}, 3), not {normals.shape}')
    return np.where(np.isfinite(normals).all(1, keepdims=True), normals, 0.0)


def _check_spread(grid: VoxelGrid, count: int) -> None:
    """Raise if the voxels lie in one place or on one line."""
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(grid.centroids.T, bias=True)), 0))
    if np.ptp(grid.centroids, axis=0).max() < 1 or not spread[1] > 1e-6 * spread[2]:
        raise DegenerateCloudError(
            f'the {count} points fill {len(grid.keys)} voxels of {grid.size:g}, in one place or on one line: '
            'supervoxels need a surface; check the cloud and its unit, or choose a smaller voxel_size'
        )


def _voxel_axes(normals: np.ndarray, grid: VoxelGrid) -> np.ndarray:
    """Return the mean unsigned normal of each voxel's points."""
    moments = np.round(products(normals) * FIXED)
    sums = [np.bincount(grid.point_voxels, column, len(grid.keys)) for column in moments.T]
    return axes_of(np.stack(sums, axis=1) / FIXED, True)


def _seeds(grid: VoxelGrid, spacing: float) -> np.ndarray:
    """Return the distinct voxels nearest to the centres of occupied lattice cells and well enough supported.

    A corner of the lattice is at the first voxel in Morton order, as in PCL.
    """
    from scipy.spatial import cKDTree

    corner = grid.centroids[first_in_morton_order(grid.keys)]
    # That voxel belongs above the corner, whatever the rounding.
    origin = corner - spacing * (np.ceil((corner - grid.centroids.min(0)) / spacing) + 1 + 1e-6)
    cells, _ = occupied(grid.centroids, origin, spacing)
    tree = cKDTree(grid.centroids, balanced_tree=False, compact_nodes=False)
    _, nearest = tree.query(origin + spacing * (unpacked(cells) + 0.5))
    seeds, first = np.unique(nearest, return_index=True)
    seeds = seeds[np.argsort(first)]
    support = tree.query_ball_point(grid.centroids[seeds], spacing / 2, return_length=True)
    seeds = seeds[support > SEED_SUPPORT * np.pi * (spacing / 2) ** 2]
    if not len(seeds):
        raise DegenerateCloudError(
            f'no seed has enough voxels within {spacing / 2:.3g} voxels of it: the cloud is too sparse '
            'for these sizes; choose a larger voxel_size'
        )
    return seeds


@kernel
def _touching(labels, starts, neighbors):
    """Return a (k, 2) row (smaller, larger label) for each pair of neighbouring voxels of two supervoxels."""
    pairs = np.empty((0, 2), np.int64)
    for fill in range(2):
        found = 0
        for v in range(len(labels)):
            if labels[v] < 0:
                continue
            for e in range(starts[v], starts[v + 1]):
                if labels[neighbors[e]] > labels[v]:
                    if fill:
                        pairs[found, 0], pairs[found, 1] = labels[v], labels[neighbors[e]]
                    found += 1
        if not fill:
            pairs = np.empty((found, 2), np.int64)
    return pairs


def _directed(pairs: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Return each adjacent pair of supervoxels once, from the one nearer to the cloud's middle to the farther.

    The flow leads outwards and never back (Sec. III-B). The paper does not say which of the two directions an edge
    gets; this one is the same in every frame and unit.
    """
    codes = np.unique(pairs[:, 0] * len(offsets) + pairs[:, 1])
    start, end = np.divmod(codes, len(offsets))
    distance = np.linalg.norm(offsets, axis=1)
    inward = distance[start] > distance[end]
    edges = np.where(inward, (end, start), (start, end)).T
    return np.ascontiguousarray(edges, np.int32)


def _outward(axes: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Return axes with the sign that points away from the cloud's middle; NaN where undefined."""
    sign = np.where((axes * offsets).sum(1) < 0, -1.0, 1.0)
    sign[~axes.any(1)] = np.nan
    return axes * sign[:, None]
