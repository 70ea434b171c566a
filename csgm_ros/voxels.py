"""A cloud as a sparse voxel grid: occupied voxels, their 26-neighbourhood and their normals.

Lengths inside are in voxels and relative to the grid's origin, which is tied to the cloud's bounding box: where
the coordinates have their origin, in which unit they are and in which order the points come does not matter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from csgm_ros.errors import InputError

# The centre of the bounding box lies at this fraction of a voxel. An irrational one keeps a symmetric cloud's
# middle plane, and a lattice with any rational spacing, off the voxel faces, where rounding would decide.
PHASE = (3 - 5**0.5) / 2
BITS = 21
EXTENT_MAX = 2**BITS - 4
# Sums over a voxel are kept as integers of this resolution: exact, hence independent of the points' order.
FIXED = 2**30


@dataclass(frozen=True, eq=False)
class VoxelGrid:
    """The occupied voxels of a cloud, sorted by key.

    Attributes
    ----------
    centroids : (v, 3) ndarray
        Mean of the points in each voxel, in voxels from ``origin``.
    origin : (3,) ndarray
        Where the voxel coordinates have their zero, in the cloud's unit.
    size : float
        Edge of a voxel, in the cloud's unit.
    keys : (v,) int64 ndarray
        Integer coordinates packed as ``x << 42 | y << 21 | z``, ascending.
    point_voxels : (N,) int32 ndarray
        Voxel of each point.
    starts, neighbors : (v + 1,) int64, (e,) int32 ndarray
        Occupied neighbours (of the 26) of voxel v: ``neighbors[starts[v]:starts[v + 1]]``, without v, ascending.
    """

    centroids: np.ndarray
    origin: np.ndarray
    size: float
    keys: np.ndarray
    point_voxels: np.ndarray
    starts: np.ndarray
    neighbors: np.ndarray

    def world(self, coordinates: np.ndarray) -> np.ndarray:
        """Return (k, 3) voxel coordinates in the cloud's frame and unit."""
        return self.origin + self.size * coordinates


def voxelize(points: np.ndarray, size: float, phase: float = PHASE) -> VoxelGrid:
    """Sort finite (N, 3) float64 points into voxels of edge ``size`` (the cloud's unit).

    Raises
    ------
    InputError
        If the cloud is so much larger than a voxel that its coordinates do not fit.
    """
    origin = lattice_origin(points, size, phase)
    keys, point_voxels = occupied(points, origin, size)
    centroids = _centroids(points, origin, 1 / size, unpacked(keys), point_voxels)
    return VoxelGrid(centroids, origin, size, keys, point_voxels, *_adjacency(keys))


def voxel_means(points: np.ndarray, size: float) -> np.ndarray:
    """Return the mean point of every occupied voxel, (v, 3), whatever the order of the (N, 3) points."""
    origin = lattice_origin(points, size, PHASE)
    keys, point_voxels = occupied(points, origin, size)
    return origin + size * _centroids(points, origin, 1 / size, unpacked(keys), point_voxels)


def lattice_origin(points: np.ndarray, size: float, phase: float = PHASE) -> np.ndarray:
    """Return the lower corner of a lattice of cells with edge ``size`` around (N, 3) points.

    Raises
    ------
    InputError
        If the points would need more cells on a side than a key can number.
    """
    low, high = points.min(0), points.max(0)
    extent = (high - low).max()
    if not extent < EXTENT_MAX * size:
        raise InputError(
            f'a voxel of {size:g} is too small for a cloud {extent:g} long: '
            'choose a larger voxel_size or remove outliers far away'
        )
    # A margin of one cell: the key of a neighbour never runs into the next bit field.
    steps = np.ceil((high - low) / (2 * size)) + 1
    return low / 2 + high / 2 - (steps + phase) * size


def occupied(points: np.ndarray, origin: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the occupied cells' keys, ascending, and the cell of each of (N, 3) points."""
    met, numbers = _number_cells(points, origin, 1 / size)
    order = np.argsort(met)
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    return met[order], rank[numbers]


def unpacked(keys: np.ndarray) -> np.ndarray:
    """Return the (k, 3) integer coordinates of (k,) keys."""
    return np.stack((keys >> 2 * BITS, keys >> BITS, keys), axis=1) & (1 << BITS) - 1


@njit(cache=True, nogil=True)
def _key(points, i, origin, scale):
    """Return the packed integer coordinates of a point."""
    x = np.int64(np.floor((points[i, 0] - origin[0]) * scale))
    y = np.int64(np.floor((points[i, 1] - origin[1]) * scale))
    z = np.int64(np.floor((points[i, 2] - origin[2]) * scale))
    return x << 2 * BITS | y << BITS | z


@njit(cache=True, nogil=True)
def _slot(table, keys, key):
    """Return where a key is, or belongs, in an open-addressing table of indices into ``keys`` (-1 is free)."""
    mask = len(table) - 1
    # Fibonacci hashing: the high half of the product depends on every bit of the key.
    slot = (key * np.int64(-7046029254386353131)) >> 32 & mask
    while table[slot] >= 0 and keys[table[slot]] != key:
        slot = (slot + 1) & mask
    return slot


@njit(cache=True, nogil=True)
def _number_cells(points, origin, scale):
    """Return the occupied cells' keys in the order in which they are met, and the number of each point's cell."""
    table = np.full(1 << 12, -1, np.int32)
    keys = np.empty(len(table) // 2, np.int64)
    numbers = np.empty(len(points), np.int32)
    count = 0
    for i in range(len(points)):
        key = _key(points, i, origin, scale)
        slot = _slot(table, keys, key)
        if table[slot] < 0:
            table[slot] = count
            keys[count] = key
            count += 1
        numbers[i] = table[slot]
        if count == len(keys):
            table = np.full(2 * len(table), -1, np.int32)
            keys = np.concatenate((keys, np.empty(count, np.int64)))
            for k in range(count):
                table[_slot(table, keys, keys[k])] = k
    return keys[:count].copy(), numbers


@njit(cache=True, nogil=True)
def _centroids(points, origin, scale, cells, point_voxels):
    """Return the mean of the points of each voxel, in voxels from the origin."""
    sums = np.zeros((len(cells), 3), np.int64)
    counts = np.zeros(len(cells), np.int64)
    for i in range(len(points)):
        voxel = point_voxels[i]
        counts[voxel] += 1
        for k in range(3):
            offset = (points[i, k] - origin[k]) * scale - cells[voxel, k]
            sums[voxel, k] += np.int64(offset * FIXED)
    return cells + sums / (counts * float(FIXED)).reshape(-1, 1)


@njit(cache=True, nogil=True)
def _adjacency(keys):
    """Return the 26-neighbourhood of sorted keys as (starts, neighbors).

    The keys are sorted, and a neighbour's key differs by a constant: nine pointers, one for each (dx, dy), that
    only move forward find them all in one sweep, without a look-up.
    """
    count = len(keys)
    offsets = np.empty(9, np.int64)
    for row in range(9):
        offsets[row] = (row // 3 - 1) * (1 << 2 * BITS) + (row % 3 - 1) * (1 << BITS)
    starts = np.zeros(count + 1, np.int64)
    neighbors = np.empty(0, np.int32)
    for fill in range(2):
        if fill:
            neighbors = np.empty(starts[count], np.int32)
        pointers, found = np.zeros(9, np.int64), 0
        for v in range(count):
            for row in range(9):
                wanted = keys[v] + offsets[row]
                while pointers[row] < count and keys[pointers[row]] < wanted - 1:
                    pointers[row] += 1
                u = pointers[row]
                while u < count and keys[u] <= wanted + 1:
                    if u != v:
                        if fill:
                            neighbors[found] = u
                        found += 1
                    u += 1
            starts[v + 1] = found
    return starts, neighbors


@njit(cache=True, nogil=True)
def axis_of(xx, xy, xz, yy, yz, zz, largest):
    """Return the unit eigenvector of a symmetric 3x3 matrix's largest or smallest eigenvalue.

    Closed form; the eigenvalue that is asked for is accurate wherever it is isolated. Zeros where it is not: the
    direction is undefined then (for a normal: all points on a line).
    """
    mean = (xx + yy + zz) / 3
    a, b, c = xx - mean, yy - mean, zz - mean
    spread = np.sqrt((a * a + b * b + c * c + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    if not spread > 0:
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


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def axes_of(matrices, largest):
    """Return :func:`axis_of` for each row (xx, xy, xz, yy, yz, zz) of a (k, 6) array."""
    axes = np.empty((len(matrices), 3))
    for k in range(len(matrices)):
        m = matrices[k]
        axes[k, 0], axes[k, 1], axes[k, 2] = axis_of(m[0], m[1], m[2], m[3], m[4], m[5], largest)
    return axes
