"""Unsigned normals: of voxels from the voxels around them, means of axes without a sign, angles between them."""

from __future__ import annotations

import numpy as np

from csgm_ros.cloud.kernels import kernel
from csgm_ros.cloud.voxels import VoxelGrid


def cosine(degrees: float) -> float:
    """Return the cosine of an angle in degrees."""
    return float(np.cos(np.radians(degrees)))


def plane_normals(grid: VoxelGrid, labels: np.ndarray) -> np.ndarray:
    """Return the (v, 3) unsigned unit normal of each voxel; zeros where its support is on a line.

    The support is the voxel, its neighbours and their neighbours, with repetitions that weight the middle, as
    in PCL. Only voxels with the same of the (v,) ``labels`` support each other.
    """
    offsets = grid.centroids - grid.centroids.mean(0)
    own = np.column_stack((np.ones(len(offsets)), offsets, products(offsets)))
    ring = _with_neighbors(own, grid.starts, grid.neighbors, labels)
    total = own + ring + _with_neighbors(ring, grid.starts, grid.neighbors, labels)
    mean = total[:, 1:4] / total[:, :1]
    covariance = total[:, 4:] / total[:, :1] - products(mean)
    covariance[covariance[:, [0, 3, 5]].sum(1) < 1e-6] = 0  # a support of one voxel leaves rounding noise
    return axes_of(covariance, False)


def products(vectors: np.ndarray) -> np.ndarray:
    """Return xx, xy, xz, yy, yz, zz of (k, 3) vectors: their outer products' upper halves, (k, 6)."""
    x, y, z = vectors.T
    return np.column_stack((x * x, x * y, x * z, y * y, y * z, z * z))


@kernel
def _with_neighbors(values, starts, neighbors, labels):
    """Return each voxel's row of ``values`` plus those of its neighbours with the same label."""
    sums = values.copy()
    for v in range(len(values)):
        for e in range(starts[v], starts[v + 1]):
            u = neighbors[e]
            if labels[u] == labels[v]:
                for k in range(values.shape[1]):
                    sums[v, k] += values[u, k]
    return sums


@kernel
def axes_of(matrices, largest):
    """Return :func:`axis_of` for each row (xx, xy, xz, yy, yz, zz) of a (k, 6) array."""
    axes = np.empty((len(matrices), 3))
    for k in range(len(matrices)):
        m = matrices[k]
        axes[k, 0], axes[k, 1], axes[k, 2] = axis_of(m[0], m[1], m[2], m[3], m[4], m[5], largest)
    return axes


@kernel
def axis_of(xx, xy, xz, yy, yz, zz, largest):
    """Return the unit eigenvector of a symmetric 3x3 matrix's largest or smallest eigenvalue.

    Closed form; the eigenvalue that is asked for is accurate wherever it is isolated. Zeros where it is not: the
    direction is undefined then (for a normal: all points on a line).
    """
    mean = (xx + yy + zz) / 3
    a, b, c = xx - mean, yy - mean, zz - mean
    spread = np.sqrt((a * a + b * b + c * c + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    if not spread > 1e-100:  # below, its cube vanishes
        return 0.0, 0.0, 0.0
    determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    angle = np.arccos(min(1.0, max(-1.0, determinant / (2 * spread**3)))) / 3
    value = 2 * spread * np.cos(angle if largest else angle + 2 * np.pi / 3)
    a, b, c = a - value, b - value, c - value
    # The eigenvector is orthogonal to every row of the shifted matrix; take the best conditioned cross product.
    x0, y0, z0 = xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy
    x1, y1, z1 = xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz
    x2, y2, z2 = b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz
    s0, s1, s2 = x0 * x0 + y0 * y0 + z0 * z0, x1 * x1 + y1 * y1 + z1 * z1, x2 * x2 + y2 * y2 + z2 * z2
    if s1 > s0:
        x0, y0, z0, s0 = x1, y1, z1, s1
    if s2 > s0:
        x0, y0, z0, s0 = x2, y2, z2, s2
    if not s0 > (1e-6 * spread * spread) ** 2:
        return 0.0, 0.0, 0.0
    length = np.sqrt(s0)
    return x0 / length, y0 / length, z0 / length
