"""A cloud as a sparse voxel grid: occupied voxels and their 26-neighbourhood.

Lengths inside are in voxels and relative to the grid's origin, which is tied to the cloud's bounding box: where
the coordinates have their origin, in which unit they are and in which order the points come does not matter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from csgm_ros.cloud.kernels import kernel
from csgm_ros.errors import InputError

# The centre of the bounding box lies this share of a voxel above a corner. PCL puts it on the corner; but then a
# symmetric cloud's middle plane, or a fused cloud that is itself a lattice, lies on voxel faces, and rounding decides.
PHASE = 1e-3
BITS = 21
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
    return voxelized(points, size)[0]


def voxelized(points: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the means of :func:`voxel_means` and the voxel of every point, (N,)."""
    origin = lattice_origin(points, size, PHASE)
    keys, point_voxels = occupied(points, origin, size)
    return origin + size * _centroids(points, origin, 1 / size, unpacked(keys), point_voxels), point_voxels


def lattice_origin(points: np.ndarray, size: float, phase: float = PHASE) -> np.ndarray:
    """Return the lower corner of a lattice of cells with edge ``size`` around (N, 3) points.

    Raises
    ------
    InputError
        If the points would need more cells on a side than a key can number.
    """
    low, high = _bounds(points)
    extent = (high - low).max()
    # A margin of one cell: the key of a neighbour never runs into the next bit field. A power of two: the Morton
    # order of the keys does not depend on it.
    half = 2.0 ** np.ceil(np.log2(extent / (2 * size) + 2))
    if not half < 2**BITS / 2:
        raise InputError(
            f'a voxel of {size:g} is too small for a cloud {extent:g} long: '
            'choose a larger voxel_size or remove outliers far away'
        )
    return low / 2 + high / 2 - (half + phase) * size


def occupied(points: np.ndarray, origin: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the occupied cells' keys, ascending, and the cell of each of (N, 3) points."""
    met, numbers = _number_cells(points, origin, 1 / size)
    order = np.argsort(met)
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    return met[order], rank[numbers]


def first_in_morton_order(keys: np.ndarray) -> int:
    """Return the index of the key that comes first when octants are visited depth first, x the slowest."""
    cells = unpacked(keys)
    left = np.arange(len(keys))
    for bit in reversed(range(int(cells.max()).bit_length())):
        for axis in range(3):
            lower = left[cells[left, axis] >> bit & 1 == 0]
            left = lower if len(lower) else left
    return int(left[0])


def unpacked(keys: np.ndarray) -> np.ndarray:
    """Return the (k, 3) integer coordinates of (k,) keys."""
    return np.stack((keys >> 2 * BITS, keys >> BITS, keys), axis=1) & (1 << BITS) - 1


@kernel
def _bounds(points):
    """Return the corners of the bounding box; numpy takes ten times as long on rows of three."""
    low, high = points[0].copy(), points[0].copy()
    for i in range(len(points)):
        for k in range(3):
            low[k] = min(low[k], points[i, k])
            high[k] = max(high[k], points[i, k])
    return low, high


@kernel
def _key(points, i, origin, scale):
    """Return the packed integer coordinates of a point."""
    x = np.int64(np.floor((points[i, 0] - origin[0]) * scale))
    y = np.int64(np.floor((points[i, 1] - origin[1]) * scale))
    z = np.int64(np.floor((points[i, 2] - origin[2]) * scale))
    return x << 2 * BITS | y << BITS | z


@kernel
def _slot(table, keys, key):
    """Return where a key is, or belongs, in an open-addressing table of indices into ``keys`` (-1 is free)."""
    mask = len(table) - 1
    # Fibonacci hashing: the high half of the product depends on every bit of the key.
    slot = (key * np.int64(-7046029254386353131)) >> 32 & mask
    while table[slot] >= 0 and keys[table[slot]] != key:
        slot = (slot + 1) & mask
    return slot


@kernel
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


@kernel
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


@kernel
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
