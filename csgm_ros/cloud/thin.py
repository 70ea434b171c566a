"""A cloud of any size thinned to one point a voxel, part by part: what does not fit into memory, or only costs time.

Voxels double their edge whenever there are too many of them. Sums are integers, so neither the order of the points
nor the number of threads changes a bit, and a file read in parts gives what the whole cloud in memory gives.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from csgm_ros.cloud.kernels import kernel
from csgm_ros.errors import DegenerateCloudError, InputError

PART = 1_000_000  # rows: the first part sets the lattice, so files and arrays are cut alike
FIRST = 2.0**12  # voxels on the side of the first part
SHARE = 0.05  # of its points that may lie beyond that side, at either end
FIXED_BITS = 18  # of a first voxel's edge
FARTHEST = 2.0**60  # voxels from the origin
BLOCK = 64  # points whose voxels are looked up side by side
KEY, COUNT, SUM, FIELDS = 0, 3, 4, 8  # of a row of the table: three coordinates, a number, three sums, one cache line


def parts_of(points: np.ndarray) -> Iterator[np.ndarray]:
    """Cut an (N, 3) array as files are read."""
    for first in range(0, len(points), PART):
        yield points[first : first + PART]


def thinned(parts: Iterable[np.ndarray], most: int, threads: int = 1) -> np.ndarray:
    """Return the means of the smallest voxels of which a cloud fills at most a given number.

    Parameters
    ----------
    parts : iterable of (N, 3) ndarray
        The cloud; rows that are not finite are left out. Held in memory one at a time and thread.
    most : int
        Voxels at most. A thread takes 128 bytes for each.
    threads : int, optional
        Parts worked on at a time; the result does not depend on it.

    Returns
    -------
    (M, 3) ndarray
        By voxel.

    Raises
    ------
    DegenerateCloudError
        When no row is finite.
    InputError
        For coordinates too far from all others.
    """
    parts = iter(parts)
    first = next((part for part in map(_floats, parts) if np.isfinite(part).all(1).any()), None)
    if first is None:
        raise DegenerateCloudError('no finite point; record the cloud again')
    edge, lock = _first_edge(first), threading.Lock()
    waiting = [first]

    def taken() -> np.ndarray | None:
        with lock:
            return waiting.pop() if waiting else next(parts, None)

    def work(_) -> _Voxels:
        voxels = _Voxels(edge, most)
        while (part := taken()) is not None:
            voxels.add(_floats(part))
        return voxels

    if threads <= 1:
        return work(0).means()
    with ThreadPoolExecutor(threads) as pool:
        whole, *others = pool.map(work, range(threads))
    for other in others:
        whole.merge(other)
    return whole.means()


class _Voxels:
    """Occupied voxels as an open-addressing hash table."""

    def __init__(self, edge: float, most: int):
        self._edge, self._most, self._level, self._used = edge, most, 0, 0
        self._table = np.zeros((1 << int(2 * most).bit_length(), FIELDS), np.int64)

    def add(self, points: np.ndarray) -> None:
        """Take in (N, 3) float64 points."""
        done = 0
        while done < len(points):
            scale = 1.0 / (self._edge * 2.0**self._level)
            done, self._used, far = _absorb(points, done, scale, self._level, self._table, self._used, self._most)
            if far:
                raise InputError(f'point {points[done]} is far from all others; remove it or choose a larger unit')
            if self._used > self._most:
                self._coarsen()

    def merge(self, other: _Voxels) -> None:
        """Take in the voxels of another of the same lattice."""
        while self._level != other._level:
            (self if self._level < other._level else other)._coarsen()
        rows = other._table[other._table[:, COUNT] > 0]
        table = np.zeros((1 << int(2 * (self._used + len(rows))).bit_length(), FIELDS), np.int64)
        used = _collect(self._table, table, 0, 0, 0)
        self._used, self._table = _collect(rows, table, 0, 0, used), table
        while self._used > self._most:
            self._coarsen()

    def means(self) -> np.ndarray:
        """Return the mean of each voxel, (M, 3), by coordinates."""
        rows = self._table[self._table[:, COUNT] > 0]
        rows = rows[np.lexsort(rows[:, KEY:COUNT].T[::-1])]
        within = rows[:, SUM : SUM + 3] / (rows[:, COUNT, None] * 2.0**FIXED_BITS)
        return rows[:, KEY:COUNT] * (self._edge * 2.0**self._level) + within * self._edge

    def _coarsen(self) -> None:
        table = np.zeros_like(self._table)
        self._used = _collect(self._table, table, 1, FIXED_BITS + self._level, 0)
        self._table, self._level = table, self._level + 1


def _floats(part: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(part, dtype=np.float64)


def _first_edge(points: np.ndarray) -> float:
    """Return a power of two of which some thousands span the bulk of a part."""
    sample = points[:: -(-len(points) // 10_000)]
    sample = sample[np.isfinite(sample).all(1)]
    sample = sample if len(sample) else points[np.isfinite(points).all(1)][:1]
    low, high = np.quantile(sample, (SHARE, 1.0 - SHARE), axis=0)
    extent = max(float((high - low).max()), 1e-9 * float(np.abs([low, high]).max()), 1e-290)
    return float(2.0 ** np.floor(np.log2(extent / FIRST)))


@kernel(inline=True)
def _home(table, x, y, z):
    """Return where a voxel would like to be."""
    mixed = (x * np.int64(73856093)) ^ (y * np.int64(19349669)) ^ (z * np.int64(83492791))
    # Fibonacci hashing: the high half of the product depends on every bit
    return (mixed * np.int64(-7046029254386353131)) >> 32 & (len(table) - 1)


@kernel(inline=True)
def _slot(table, home, x, y, z):
    """Return where a voxel is, or belongs."""
    slot = home
    while table[slot, 3] > 0 and (table[slot, 0] != x or table[slot, 1] != y or table[slot, 2] != z):
        slot = (slot + 1) & (len(table) - 1)
    return slot


@kernel
def _absorb(points, first, scale, level, table, used, most):
    """Add points until there are too many voxels; return the next point, the voxels, and whether it lies too far.

    The rows of a block of points are touched before they are needed, so that the processor fetches them side by side.
    """
    unit = 2.0 ** (FIXED_BITS + level)
    cells, homes, good = np.empty((BLOCK, 3)), np.empty(BLOCK, np.int64), np.empty(BLOCK, np.int64)
    touched = np.zeros(1, np.int64)
    for start in range(first, len(points), BLOCK):
        count = min(BLOCK, len(points) - start)
        for j in range(count):
            good[j] = 1
            for k in range(3):
                value = points[start + j, k] * scale
                if not abs(value) <= FARTHEST:
                    good[j] = 0
                cells[j, k] = np.floor(value)
            if good[j]:
                homes[j] = _home(table, np.int64(cells[j, 0]), np.int64(cells[j, 1]), np.int64(cells[j, 2]))
        for j in range(count):
            if good[j]:
                touched[0] += table[homes[j], 3]
        for j in range(count):
            i = start + j
            if not good[j]:
                if np.isfinite(points[i, 0]) and np.isfinite(points[i, 1]) and np.isfinite(points[i, 2]):
                    return i, used, True
                continue
            x, y, z = np.int64(cells[j, 0]), np.int64(cells[j, 1]), np.int64(cells[j, 2])
            slot = _slot(table, homes[j], x, y, z)
            if table[slot, 3] == 0:
                table[slot, 0], table[slot, 1], table[slot, 2] = x, y, z
                used += 1
            table[slot, 3] += 1
            for k in range(3):
                table[slot, 4 + k] += np.int64((points[i, k] * scale - cells[j, k]) * unit)
            if used > most:
                return i + 1, used, False
    return len(points), used, False


@kernel
def _collect(rows, table, shift, bits, used):
    """Add voxels to a table, ``shift`` levels coarser, a voxel's edge being 2**bits; return how many it then has."""
    for i in range(len(rows)):
        if rows[i, 3] == 0:
            continue
        x, y, z = rows[i, 0] >> shift, rows[i, 1] >> shift, rows[i, 2] >> shift
        slot = _slot(table, _home(table, x, y, z), x, y, z)
        if table[slot, 3] == 0:
            used += 1
        for k in range(3):
            table[slot, k] = rows[i, k] >> shift
            aside = (rows[i, k] & 1) << bits if shift else 0
            table[slot, 4 + k] += rows[i, 4 + k] + rows[i, 3] * aside
        table[slot, 3] += rows[i, 3]
    return used
