"""Layers of occupied cells above a plane, and how likely the same cells are occupied in another cloud (log ratio).

A cell that is occupied in one cloud is evidence for a transform where it is occupied in the other one too, and so
much more as few cells of its layer are: ground and walls, which lie on each other in many places, count next to
nothing, what stands alone counts much. A cell that the other cloud did not see hardly counts at all.
"""

from __future__ import annotations

import numpy as np

from csgm_ros.cloud.kernels import kernel

ALPHA = 0.7  # chance that what one sensor has seen, the other one has seen too, in the right place
UNSEEN = 0.1  # what a cell costs where the other cloud saw nothing
SEEN = 2  # cells around an occupied one that were seen too
RARE = 0.004  # least share of the seen cells that a layer has occupied
SIDE, CORNER = 0.65, 0.45  # how much of an occupied cell is in its neighbours


@kernel
def raster(points, into, edges, occupied, soft, seen):
    """Mark the cells of (n, 3) points, which the (3, 4) matrix ``into`` brings into cells, in three zeroed grids.

    ``occupied`` (L, N, N) uint8: the cells; ``soft`` (L, N, N) float32: with their neighbours; ``seen`` (N, N) uint8.
    Returns the number of seen columns and the sum of each layer of ``soft``.
    """
    layers, side = occupied.shape[0], occupied.shape[1]
    half = side // 2
    total = np.zeros(layers)
    columns = 0
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        u = into[0, 0] * x + into[0, 1] * y + into[0, 2] * z + into[0, 3] + half
        v = into[1, 0] * x + into[1, 1] * y + into[1, 2] * z + into[1, 3] + half
        if not (SEEN <= u < side - SEEN and SEEN <= v < side - SEEN):
            continue
        z = into[2, 0] * x + into[2, 1] * y + into[2, 2] * z + into[2, 3]
        if z < edges[0] or z >= edges[layers]:
            continue
        i, j = int(u), int(v)
        layer = 0
        while z >= edges[layer + 1]:
            layer += 1
        if occupied[layer, i, j]:
            continue
        occupied[layer, i, j] = 1
        for a in range(-1, 2):
            for b in range(-1, 2):
                weight = 1.0 if a == 0 and b == 0 else SIDE if a == 0 or b == 0 else CORNER
                before = soft[layer, i + a, j + b]
                if before < weight:
                    soft[layer, i + a, j + b] = weight
                    total[layer] += weight - before
        if seen[i, j] < 2:
            columns += seen[i, j] == 0
            seen[i, j] = 2
            for a in range(-SEEN, SEEN + 1):
                for b in range(-SEEN, SEEN + 1):
                    if seen[i + a, j + b] == 0:
                        seen[i + a, j + b] = 1
                        columns += 1
    return columns, total


@kernel
def ratios(columns, total):
    """Return the log ratio of a cell (L, 4): where the other cloud has it empty, in a corner, on a side, occupied."""
    out = np.empty((len(total), 4))
    for layer in range(len(total)):
        share = max(total[layer] / max(columns, 1), RARE)
        out[layer, 0] = np.log(1 - ALPHA)
        out[layer, 1] = np.log(1 - ALPHA + ALPHA * CORNER / share)
        out[layer, 2] = np.log(1 - ALPHA + ALPHA * SIDE / share)
        out[layer, 3] = np.log(1 - ALPHA + ALPHA / share)
    return out


@kernel(inline=True)
def grade(soft):
    """Return the column of :func:`ratios` for a value of ``soft``."""
    return 0 if soft == 0 else 1 if soft < 0.6 else 2 if soft < 0.9 else 3


@kernel
def fields(points, into, edges, out):
    """Write occupancy (L, N, N) and log ratio (L, N, N) of points, see :func:`raster`, into (2, L, N, N) float32."""
    _, layers, side, _ = out.shape
    occupied = np.zeros((layers, side, side), np.uint8)
    soft = np.zeros((layers, side, side), np.float32)
    seen = np.zeros((side, side), np.uint8)
    columns, total = raster(points, into, edges, occupied, soft, seen)
    table = ratios(columns, total)
    for layer in range(layers):
        for i in range(side):
            for j in range(side):
                out[0, layer, i, j] = occupied[layer, i, j]
                out[1, layer, i, j] = table[layer, grade(soft[layer, i, j])] if seen[i, j] else -UNSEEN
