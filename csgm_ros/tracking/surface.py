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
    keys : (N,) int64 ndarray
        Packed voxel coordinates.
    table : (T,) int32 ndarray
        Open-addressing table of indices into ``keys``, -1 where free; T a power of two.
    origin : (3,) ndarray
    voxel : float
        Edge of a voxel.
    """

    points: np.ndarray
    normals: np.ndarray
    keys: np.ndarray
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
    table = np.full(1 << int(2 * len(keys) + 2).bit_length(), -1, np.int32)
    _index(keys, table)
    return Surface(means, sums, keys, table, origin, voxel)


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


@kernel
def _index(keys, table):
    mask = len(table) - 1
    for k in range(len(keys)):
        slot = _home(keys[k], mask)
        while table[slot] >= 0:
            slot = (slot + 1) & mask
        table[slot] = k


@kernel
def nearest(surface, x, y, z):
    """Return the index of the surface's point nearest to (x, y, z) in the 8 voxels around it, -1 for none.

    Whatever lies within half a voxel is found, and nothing from two voxels on.
    """
    points, keys, table, voxel = surface.points, surface.keys, surface.table, surface.voxel
    x0, y0, z0 = (
        (x - surface.origin[0]) / voxel - 0.5,
        (y - surface.origin[1]) / voxel - 0.5,
        (z - surface.origin[2]) / voxel - 0.5,
    )
    if x0 < 0.0 or y0 < 0.0 or z0 < 0.0 or x0 >= LIMIT or y0 >= LIMIT or z0 >= LIMIT:
        return -1
    corner = np.int64(x0) << 2 * BITS | np.int64(y0) << BITS | np.int64(z0)
    mask = len(table) - 1
    best, least = -1, np.inf
    for n in range(8):
        key = corner + (np.int64(n >> 2) << 2 * BITS) + (np.int64(n >> 1 & 1) << BITS) + np.int64(n & 1)
        slot = _home(key, mask)
        while table[slot] >= 0:
            q = table[slot]
            if keys[q] == key:
                dx, dy, dz = x - points[q, 0], y - points[q, 1], z - points[q, 2]
                squared = dx * dx + dy * dy + dz * dz
                if squared < least:
                    best, least = q, squared
                break
            slot = (slot + 1) & mask
    return best
