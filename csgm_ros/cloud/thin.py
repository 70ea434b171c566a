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
FIRST = 2.0  # voxels on the side of the first part, relative to the root of how many there may be
SHARE = 0.05  # of its points that may lie beyond that side, at either end
FIXED_BITS = 18  # of a first voxel's edge
FARTHEST = 2.0**60  # voxels from the origin
BLOCK = 16  # points whose voxels are looked up side by side
COUNT, FIELDS = 3, 8  # of a voxel: three coordinates, a number, three sums, filled up to a cache line
FREE = -1  # place in the table


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
        Voxels at most. A thread takes 80 bytes for each.
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
    edge, lock = _first_edge(first, most), threading.Lock()
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
    """Occupied voxels side by side, as they are met, and an open-addressing table of their places."""

    def __init__(self, edge: float, most: int):
        self._edge, self._most, self._level, self._used = edge, most, 0, 0
        self._rows = np.empty((most + 1, FIELDS), np.int64)
        self._table = _table(most)

    def add(self, points: np.ndarray) -> None:
        """Take in (N, 3) float64 points."""
        done = 0
        while done < len(points):
            scale = 1.0 / (self._edge * 2.0**self._level)
            done, self._used, far = _absorb(points, done, scale, self._level, self._table, self._rows, self._used)
            if far:
                raise InputError(f'point {points[done]} is far from all others; remove it or choose a larger unit')
            while self._used > self._most:
                self._coarsen()

    def merge(self, other: _Voxels) -> None:
        """Take in the voxels of another of the same lattice."""
        while self._level != other._level:
            (self if self._level < other._level else other)._coarsen()
        self._rows = np.concatenate((self._rows[: self._used], other._rows[: other._used]))
        self._table = _table(len(self._rows))
        self._used = _collect(self._rows, len(self._rows), self._table, 0, 0)
        while self._used > self._most:
            self._coarsen()

    def means(self) -> np.ndarray:
        """Return the mean of each voxel, (M, 3), by coordinates."""
        rows = self._rows[: self._used]
        return _means(rows, _order(rows[:, :COUNT]), self._edge, self._edge * 2.0**self._level)

    def _coarsen(self) -> None:
        self._table[:] = FREE
        self._used = _collect(self._rows, self._used, self._table, 1, FIXED_BITS + self._level)
        self._level += 1


def _table(most: int) -> np.ndarray:
    return np.full(1 << int(2 * most).bit_length(), FREE, np.int32)


def _order(keys: np.ndarray) -> np.ndarray:
    """Return the order of (M, 3) integers, row by row."""
    low, high = keys.min(axis=0), keys.max(axis=0)
    bits = [int(extent).bit_length() for extent in high - low]
    if sum(bits) > 62:
        return np.lexsort(keys.T[::-1])
    x, y, z = (keys - low).T
    return np.argsort((x << bits[1] | y) << bits[2] | z)


def _floats(part: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(part, dtype=np.float64)


def _first_edge(points: np.ndarray, most: int) -> float:
    """Return a power of two so small that a surface across the bulk of a part fills more voxels than there may be."""
    sample = points[:: -(-len(points) // 10_000)]
    sample = sample[np.isfinite(sample).all(1)]
    sample = sample if len(sample) else points[np.isfinite(points).all(1)][:1]
    low, high = np.quantile(sample, (SHARE, 1.0 - SHARE), axis=0)
    extent = max(float((high - low).max()), 1e-9 * float(np.abs([low, high]).max()), 1e-290)
    return float(2.0 ** np.floor(np.log2(extent / (FIRST * np.sqrt(most)))))


@kernel(inline=True)
def _home(table, x, y, z):
    """Return where a voxel would like to be."""
    mixed = (x * np.int64(73856093)) ^ (y * np.int64(19349669)) ^ (z * np.int64(83492791))
    # Fibonacci hashing: the high half of the product depends on every bit
    return (mixed * np.int64(-7046029254386353131)) >> 32 & (len(table) - 1)


@kernel(inline=True)
def _slot(table, rows, home, x, y, z):
    """Return where the place of a voxel is, or belongs."""
    slot = home
    while table[slot] >= 0:
        row = table[slot]
        if rows[row, 0] == x and rows[row, 1] == y and rows[row, 2] == z:
            break
        slot = (slot + 1) & (len(table) - 1)
    return slot


@kernel
def _absorb(points, first, scale, level, table, rows, used):
    """Add points until there are too many voxels; return the next point, the voxels, and whether it lies too far.

    What a block of points needs of the table and of the rows is touched before, so that the processor fetches it side
    by side.
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
            if good[j] and table[homes[j]] >= 0:
                touched[0] += rows[table[homes[j]], 3]
        for j in range(count):
            i = start + j
            if not good[j]:
                if np.isfinite(points[i, 0]) and np.isfinite(points[i, 1]) and np.isfinite(points[i, 2]):
                    return i, used, True
                continue
            x, y, z = np.int64(cells[j, 0]), np.int64(cells[j, 1]), np.int64(cells[j, 2])
            slot = _slot(table, rows, homes[j], x, y, z)
            row = table[slot]
            if row < 0:
                row = table[slot] = used
                rows[row, 0], rows[row, 1], rows[row, 2] = x, y, z
                rows[row, 3:7] = 0
                used += 1
            rows[row, 3] += 1
            for k in range(3):
                rows[row, 4 + k] += np.int64((points[i, k] * scale - cells[j, k]) * unit)
            if used == len(rows):
                return i + 1, used, False
    return len(points), used, False


@kernel
def _collect(rows, count, table, shift, bits):
    """Make voxels ``shift`` levels coarser in place, a voxel's edge being 2**bits; return how many are left."""
    used = 0
    homes, sums, touched = np.empty(BLOCK, np.int64), np.empty(3, np.int64), np.zeros(1, np.int64)
    for start in range(0, count, BLOCK):
        end = min(start + BLOCK, count)
        for i in range(start, end):
            homes[i - start] = _home(table, rows[i, 0] >> shift, rows[i, 1] >> shift, rows[i, 2] >> shift)
        for i in range(start, end):
            if table[homes[i - start]] >= 0:
                touched[0] += rows[table[homes[i - start]], 3]
        for i in range(start, end):
            number = rows[i, 3]
            for k in range(3):
                aside = (rows[i, k] & 1) << bits if shift else 0
                sums[k] = rows[i, 4 + k] + number * aside
            x, y, z = rows[i, 0] >> shift, rows[i, 1] >> shift, rows[i, 2] >> shift
            slot = _slot(table, rows, homes[i - start], x, y, z)
            row = table[slot]
            if row < 0:
                row = table[slot] = used  # at most i, so nothing is overwritten that is still to be read
                rows[row, 0], rows[row, 1], rows[row, 2] = x, y, z
                rows[row, 3:7] = 0
                used += 1
            rows[row, 3] += number
            for k in range(3):
                rows[row, 4 + k] += sums[k]
    return used


@kernel
def _means(rows, order, edge, voxel):
    """Return the mean of each voxel, ``edge`` being that of a first one."""
    means = np.empty((len(order), 3))
    for j in range(len(order)):
        i = order[j]
        for k in range(3):
            within = rows[i, 4 + k] / (rows[i, 3] * 2.0**FIXED_BITS)
            means[j, k] = rows[i, k] * voxel + within * edge
    return means
