"""Nearest points by table look-up: a grid whose cells name the cloud's nearest point.

The search for the right transform asks for millions of nearest points; a gather answers in nanoseconds where
a tree needs a microsecond. The answer is the point nearest to the *cell's centre*, so distances are exact for
that point and too long by at most a cell's diagonal; the final ICP uses exact neighbours.
"""

from __future__ import annotations

import numpy as np

from csgm_ros.cloud.kernels import kernel
from csgm_ros.types import NearestGrid

MAX_CELLS = 5e7


def build(points: np.ndarray, normals: np.ndarray, cell: float, reach: float) -> NearestGrid:
    """Tabulate the nearest of (N, 3) points for every place within ``reach`` of one of them.

    ``cell`` is widened where the table would have more than ``MAX_CELLS`` cells.
    """
    # a point far from all others would take the memory of the whole space between them
    cell = max(cell, float(np.cbrt((np.ptp(points, axis=0) + 2 * reach).prod() / MAX_CELLS)))
    origin = points.min(0) - reach - cell
    sides = np.ceil((points.max(0) + reach + cell - origin) / cell).astype(np.int64)
    index = np.full(tuple(sides), -1, np.int32)
    _fill(points, index, origin, cell, reach)
    return NearestGrid(np.ascontiguousarray(points), np.ascontiguousarray(normals), index, origin, cell)


@kernel
def _fill(points, index, origin, cell, reach):
    steps = int(np.ceil(reach / cell))
    best = np.full(index.shape, np.float32(reach * reach), np.float32)
    home = np.empty(3, np.int64)
    for p in range(len(points)):
        for axis in range(3):
            home[axis] = int((points[p, axis] - origin[axis]) / cell)
        low = np.maximum(home - steps, 0)
        for i in range(low[0], min(home[0] + steps + 1, index.shape[0])):
            dx = origin[0] + (i + 0.5) * cell - points[p, 0]
            for j in range(low[1], min(home[1] + steps + 1, index.shape[1])):
                dy = origin[1] + (j + 0.5) * cell - points[p, 1]
                for k in range(low[2], min(home[2] + steps + 1, index.shape[2])):
                    dz = origin[2] + (k + 0.5) * cell - points[p, 2]
                    distance = np.float32(dx * dx + dy * dy + dz * dz)
                    if distance < best[i, j, k]:
                        best[i, j, k] = distance
                        index[i, j, k] = p


@kernel(inline=True)
def lookup(index, origin, cell, x, y, z):
    """Return the point named by the cell of (x, y, z), -1 outside the grid."""
    i = int(np.floor((x - origin[0]) / cell))
    j = int(np.floor((y - origin[1]) / cell))
    k = int(np.floor((z - origin[2]) / cell))
    if i < 0 or j < 0 or k < 0 or i >= index.shape[0] or j >= index.shape[1] or k >= index.shape[2]:
        return -1
    return index[i, j, k]
