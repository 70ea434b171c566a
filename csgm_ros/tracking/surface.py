"""A surface as one point and one normal a voxel, found again through a hash table.

A table over all space, as :mod:`csgm_ros.cloud.nearest_grid` has, answers faster but takes the memory of the air
between the points; this one is rebuilt several times a second, whatever the extent of what the sensor sees.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from csgm_ros.cloud.kernels import kernel
from csgm_ros.cloud.voxels import BITS, lattice_origin, occupied

LIMIT = (1 << BITS) - 1


class Surface(NamedTuple):
    """Voxel means with normals.

    Attributes
    ----------
    points, normals : (N, 3) ndarray
        Means of the points and of their normals in each voxel.
    keys : (C,) int64 ndarray
        Packed coordinates of the corners at which eight voxels meet, one of them occupied at least.
    first : (C + 1,) int32 ndarray
        Where the occupied ones around each corner begin in ``around``.
    around : (8 N,) int32 ndarray
        Their numbers, corner by corner.
    table : (T,) int32 ndarray
        Open-addressing table of indices into ``keys``, -1 where free; T a power of two.
    origin : (3,) ndarray
    voxel : float
        Edge of a voxel.
    """

    points: np.ndarray
    normals: np.ndarray
    keys: np.ndarray
    first: np.ndarray
    around: np.ndarray
    table: np.ndarray
    origin: np.ndarray
    voxel: float


def build(points: np.ndarray, normals: np.ndarray, voxel: float, *, oriented: bool = True) -> Surface:
    """Average (N, 3) points and unit normals in voxels; the sign of a normal counts where ``oriented``."""
    origin = lattice_origin(points, voxel)
    keys, owner = occupied(points, origin, voxel)
    means, sums = _averaged(points, normals, owner, len(keys), oriented)
    length = np.linalg.norm(sums, axis=1)
    kept = length > 0.3  # where normals of both signs, or of all directions, cancel there is no surface
    keys, means, sums = keys[kept], means[kept], sums[kept] / length[kept, None]
    corners, first, around, table = _corners(keys)
    return Surface(means, sums, corners, first, around, table, origin, voxel)


@kernel
def _averaged(points, normals, owner, count, oriented):
    means, sums, counts = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count)
    for p in range(len(points)):
        v = owner[p]
        counts[v] += 1.0
        sign = 1.0
        if not oriented:
            product = sums[v, 0] * normals[p, 0] + sums[v, 1] * normals[p, 1] + sums[v, 2] * normals[p, 2]
            sign = -1.0 if product < 0.0 else 1.0
        for k in range(3):
            means[v, k] += points[p, k]
            sums[v, k] += sign * normals[p, k]
    for v in range(count):
        for k in range(3):
            means[v, k] /= counts[v]
            sums[v, k] /= counts[v]
    return means, sums


@kernel(inline=True)
def _home(key, mask):
    return (key * np.int64(-7046029254386353131)) >> 32 & mask  # Fibonacci hashing


@kernel(inline=True)
def _corner(n):
    return np.int64(n >> 2) << 2 * BITS | np.int64(n >> 1 & 1) << BITS | np.int64(n & 1)


@kernel
def _corners(voxels):
    """Return keys, first, around and table of :class:`Surface` for ascending keys (N,) of voxels."""
    table = np.full(1 << int(np.ceil(np.log2(12.0 * len(voxels) + 2.0))), np.int32(-1), np.int32)
    mask = len(table) - 1
    keys, counts = np.empty(8 * len(voxels), np.int64), np.zeros(8 * len(voxels) + 1, np.int32)
    of = np.empty((len(voxels), 8), np.int32)
    count = 0
    for q in range(len(voxels)):
        for n in range(8):
            key = voxels[q] - _corner(n)
            slot = _home(key, mask)
            while table[slot] >= 0 and keys[table[slot]] != key:
                slot = (slot + 1) & mask
            if table[slot] < 0:
                table[slot] = count
                keys[count] = key
                count += 1
            of[q, n] = table[slot]
            counts[table[slot] + 1] += 1
    first = np.cumsum(counts[: count + 1]).astype(np.int32)
    around, filled = np.empty(8 * len(voxels), np.int32), first[:-1].copy()
    for q in range(len(voxels)):
        for n in range(8):
            around[filled[of[q, n]]] = q
            filled[of[q, n]] += 1
    return keys[:count].copy(), first, around, table


@kernel(inline=True)
def nearest(points, keys, first, around, table, origin, voxel, x, y, z):
    """Return the index of a surface's point nearest to (x, y, z) in the 8 voxels around it, -1 for none.

    Whatever lies within half a voxel is found, and nothing from three voxels on. What a :class:`Surface` holds is asked
    for one by one: taken out of it at every point, it would be counted at every point who holds it, for twice the time.
    """
    x0, y0, z0 = (x - origin[0]) / voxel - 0.5, (y - origin[1]) / voxel - 0.5, (z - origin[2]) / voxel - 0.5
    if x0 < 0.0 or y0 < 0.0 or z0 < 0.0 or x0 >= LIMIT or y0 >= LIMIT or z0 >= LIMIT:
        return -1
    key = np.int64(x0) << 2 * BITS | np.int64(y0) << BITS | np.int64(z0)
    mask = len(table) - 1
    slot = _home(key, mask)
    while table[slot] >= 0 and keys[table[slot]] != key:
        slot = (slot + 1) & mask
    corner = table[slot]
    if corner < 0:
        return -1
    best, least = -1, np.inf
    for k in range(first[corner], first[corner + 1]):
        q = around[k]
        dx, dy, dz = x - points[q, 0], y - points[q, 1], z - points[q, 2]
        squared = dx * dx + dy * dy + dz * dz
        if squared < least:
            best, least = q, squared
    return best
