"""Nearest points by table look-up: a grid whose cells name the cloud's nearest point.

The search for the right transform asks for millions of nearest points; a gather answers in nanoseconds where
a tree needs a microsecond. The answer is the point nearest to the *cell's centre*, so distances are exact for
that point and too long by at most a cell's diagonal; the final ICP uses exact neighbours. Only blocks of cells that a
point reaches are kept, and an empty one for all others: a street is mostly air. Points that are asked in the order of
their voxels find what they need where the one before them has been, in half the time of any other order.
"""

from __future__ import annotations

import numpy as np

from csgm_ros.cloud.kernels import kernel
from csgm_ros.types import NearestGrid

BITS = 3
BLOCK = 1 << BITS  # cells along the edge of a block
MAX_BLOCKS = 4e6  # of the space, of which ...
MAX_KEPT = 1e5  # ... so many are reached by a point


def build(points: np.ndarray, normals: np.ndarray, cell: float, reach: float) -> NearestGrid:
    """Tabulate the nearest of (N, 3) points for every place within ``reach`` of one of them.

    ``cell`` is widened where the table would have more than ``MAX_BLOCKS``, or keep more than ``MAX_KEPT``.
    """
    # a point far from all others would take the memory of the whole space between them
    space = (np.ptp(points, axis=0) + 2 * reach).prod()
    cell = max(cell, float(np.cbrt(space / MAX_BLOCKS)) / BLOCK)
    while True:
        origin = points.min(0) - reach - cell
        sides = np.ceil((points.max(0) + reach + cell - origin) / (BLOCK * cell)).astype(np.int64)
        blocks = np.zeros(tuple(sides), np.int32)
        kept = _reached(points, blocks, origin, cell, reach)
        if kept <= MAX_KEPT:
            break
        cell *= float(np.cbrt(kept / MAX_KEPT)) + 0.1
    nearest = np.full((kept, BLOCK**3), -1, np.int32)
    _fill(points, blocks, nearest, origin, cell, reach)
    return NearestGrid(np.ascontiguousarray(points), np.ascontiguousarray(normals), (blocks, nearest), origin, cell)


@kernel
def _reached(points, blocks, origin, cell, reach):
    """Number the blocks within reach of a point from 1 on, 0 being the empty one; return how many these are."""
    steps = int(np.ceil(reach / cell))
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    count = 1
    for p in range(len(points)):
        for axis in range(3):
            home = int((points[p, axis] - origin[axis]) / cell)
            low[axis] = max(home - steps, 0) >> BITS
            high[axis] = min(((home + steps) >> BITS) + 1, blocks.shape[axis])
        for i in range(low[0], high[0]):
            for j in range(low[1], high[1]):
                for k in range(low[2], high[2]):
                    if blocks[i, j, k] == 0:
                        blocks[i, j, k] = count
                        count += 1
    return count


@kernel(inline=True)
def _inside(i, j):
    return ((i & BLOCK - 1) << 2 * BITS) | ((j & BLOCK - 1) << BITS)


@kernel
def _fill(points, blocks, nearest, origin, cell, reach):
    steps, limit = int(np.ceil(reach / cell)), reach * reach
    best = np.full(nearest.shape, np.float32(limit), np.float32)
    home, above = np.empty(3, np.int64), np.empty(BLOCK * blocks.shape[2])
    for p in range(len(points)):
        for axis in range(3):
            home[axis] = int((points[p, axis] - origin[axis]) / cell)
        low = np.maximum(home - steps, 0)
        first = low[2] >> BITS
        last = (min(home[2] + steps, BLOCK * blocks.shape[2] - 1) >> BITS) + 1
        for k in range(first << BITS, last << BITS):
            dz = origin[2] + (k + 0.5) * cell - points[p, 2]
            above[k] = dz * dz
        for i in range(low[0], min(home[0] + steps + 1, BLOCK * blocks.shape[0])):
            dx = origin[0] + (i + 0.5) * cell - points[p, 0]
            for j in range(low[1], min(home[1] + steps + 1, BLOCK * blocks.shape[1])):
                dy = origin[1] + (j + 0.5) * cell - points[p, 1]
                aside = dx * dx + dy * dy
                if aside >= limit:
                    continue
                row, place = blocks[i >> BITS, j >> BITS], _inside(i, j)
                for b in range(first, last):
                    block = row[b]
                    for k in range(BLOCK):  # all of a row without a branch: vector code
                        distance, before = np.float32(aside + above[BLOCK * b + k]), best[block, place + k]
                        closer = distance < before
                        best[block, place + k] = distance if closer else before
                        nearest[block, place + k] = p if closer else nearest[block, place + k]


@kernel(inline=True)
def lookup(index, origin, cell, x, y, z):
    """Return the point named by the cell of (x, y, z), -1 outside the grid."""
    blocks, nearest = index
    per = 1.0 / cell
    # without a sign: what lies below the origin becomes too large, and no index is counted from the end
    i = np.uint64(np.int64((x - origin[0]) * per))
    j = np.uint64(np.int64((y - origin[1]) * per))
    k = np.uint64(np.int64((z - origin[2]) * per))
    bits = np.uint64(BITS)
    a, b, c = i >> bits, j >> bits, k >> bits
    if a >= np.uint64(blocks.shape[0]) or b >= np.uint64(blocks.shape[1]) or c >= np.uint64(blocks.shape[2]):
        return -1
    rest = np.uint64(BLOCK - 1)
    place = ((i & rest) << (bits + bits)) | ((j & rest) << bits) | (k & rest)
    return nearest[np.uint64(blocks[a, b, c]), place]
