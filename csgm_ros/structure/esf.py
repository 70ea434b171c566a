"""Ensemble of shape functions (ESF): 640 bins of distances, areas and angles of random point triples.

Wohlkinger and Vincze 2011, in the form that PCL gave it. The shape is scaled into a grid of 64^3 cells; every
triple's three lines are traced through it and are IN the shape, OUT of it, or MIXED.
"""

from __future__ import annotations

import numpy as np

from csgm_ros.cloud.kernels import kernel, random_bits

GRID = 64
HALF = GRID // 2
BINS = 64
WIDTH = 640
# A cell's three indices in one word, each with a fraction below it: a line through the grid is then one addition
# a cell. Every axis has FIELD bits, FRACTION of them for the fraction.
FIELD, FRACTION = 21, 15
CENTER = (1 << 2 * FIELD | 1 << FIELD | 1) << FRACTION - 1
# Rows of the histogram, times 64 bins: angles, areas, distances by class; share inside of MIXED lines. Two more
# rows take the shares inside of OUT and IN lines, which do not count: no branch is cheaper than a mispredicted one.
IN, OUT, MIXED = 0, 1, 2
A3, D3, D2, RATIO = 0, 3, 6, 9
ROWS = 12
WEIGHTS = np.array([0.5, 0.5, 0.5, 0.5, 0.5, 1.0, 0.5, 2.0, 2.0, 1.0])
# Triples of a smaller squared area (in cells^4) are drawn again.
AREA2_MIN = 1e-3
# Draws at most per wanted triple: a thin shape makes do with those it has.
DRAWS = 20


@kernel
def fill(points, starts, members, states, samples, first, last, rows):
    """Fill ``rows[first:last]`` with the ESF of the groups ``members[starts[g]:starts[g + 1]]`` of (N, 3) points."""
    for group in range(first, last):
        _describe(points, members[starts[group] : starts[group + 1]], states[group], samples, rows[group])


@kernel
def _describe(points, members, state, samples, row):
    """Write the 640 bins of the shape that the members make; zeros if they span no triangle."""
    row[:] = 0
    scaled = _scaled(points, members)
    if len(scaled) < 3:
        return
    cells = _cells(scaled)
    grid = _occupancy(cells)
    histogram = np.zeros((ROWS, BINS))
    lengths = np.empty((samples, 4), np.float32)  # three D2 and one D3 a triple
    kinds = np.empty((samples, 4), np.uint8)
    found = 0
    for _ in range(DRAWS * samples):
        if found == samples:
            break
        state, i, j, k = _three(state, len(scaled))
        area2 = _area2(scaled, i, j, k)
        if area2 > AREA2_MIN:  # not for two equal points, either
            _measure(scaled, cells, grid, i, j, k, area2, lengths, kinds, found, histogram)
            found += 1
    _bin_lengths(lengths[:found], kinds[:found], histogram)
    total = 0.0
    for r in range(len(WEIGHTS)):
        for b in range(BINS):
            row[r * BINS + b] = WEIGHTS[r] * histogram[r, b]
            total += row[r * BINS + b]
    if total > 0:
        row /= total


@kernel
def _scaled(points, members):
    """Return the members about their mean, the farthest one at half a grid; none if all are in one place."""
    scaled = np.empty((len(members), 3))
    mean = np.zeros(3)
    for m in range(len(members)):
        for k in range(3):
            scaled[m, k] = points[members[m], k]
            mean[k] += scaled[m, k] / len(members)
    farthest = 0.0
    for m in range(len(members)):
        squared = 0.0
        for k in range(3):
            scaled[m, k] -= mean[k]
            squared += scaled[m, k] ** 2
        farthest = max(farthest, squared)
    if not farthest > 0:
        return scaled[:0]
    return scaled * (HALF / np.sqrt(farthest))


@kernel
def _cells(scaled):
    """Return the packed centre of each point's cell; clipped, as rounding may put the farthest one beyond the grid."""
    cells = np.empty(len(scaled), np.int64)
    for m in range(len(scaled)):
        packed = 0
        for k in range(3):
            x = scaled[m, k]
            cell = int(np.floor(x)) + HALF if x < 0 else int(np.ceil(x)) + HALF - 1
            packed = packed << FIELD | min(max(cell, 0), GRID - 1) << FRACTION
        cells[m] = packed + CENTER
    return cells


@kernel
def _unpacked(cell):
    """Return the three indices of a packed cell."""
    return cell >> 2 * FIELD + FRACTION, cell >> FIELD + FRACTION & GRID - 1, cell >> FRACTION & GRID - 1


@kernel
def _occupancy(cells):
    """Return the points' cells and their 26 neighbours as bits z of words [x, y]: 32 kB, which stay in cache."""
    grid = np.zeros(GRID * GRID, np.uint64)
    for m in range(len(cells)):
        x, y, z = _unpacked(cells[m])
        bits = np.uint64(7) << np.uint64(z - 1) if z else np.uint64(3)
        for u in range(max(x - 1, 0), min(x + 2, GRID)):
            for v in range(max(y - 1, 0), min(y + 2, GRID)):
                grid[u * GRID + v] |= bits
    return grid


@kernel(inline=True)
def _trace(grid, start, end):
    """Return how many cells of the digital line from start to end are occupied, and how many it has.

    The end's own cell does not count, unless it is the start's.
    """
    x0, y0, z0 = _unpacked(start)
    x1, y1, z1 = _unpacked(end)
    count = max(abs(x1 - x0), abs(y1 - y0), abs(z1 - z0), 1)
    scale = (1 << FRACTION) / count
    dx, dy, dz = int((x1 - x0) * scale), int((y1 - y0) * scale), int((z1 - z0) * scale)
    step = np.uint64((dx << 2 * FIELD) + (dy << FIELD) + dz)
    cell = np.uint64(start)  # unsigned: without numba's test for negative indices the loop becomes vector code
    low, rows, inside = np.uint64(GRID - 1), np.uint64(6), np.uint64(0)
    x_at, y_at, z_at = np.uint64(2 * FIELD + FRACTION), np.uint64(FIELD + FRACTION), np.uint64(FRACTION)
    for _ in range(count):
        word = grid[cell >> x_at << rows | cell >> y_at & low]
        inside += word >> (cell >> z_at & low) & np.uint64(1)
        cell += step
    return np.int64(inside), count


@kernel
def _three(state, count):
    """Return the generator's next state and three indices below ``count`` (SplitMix64)."""
    state, first = random_bits(state)
    state, second = random_bits(state)
    n, low = np.uint64(count), np.uint64(0xFFFFFFFF)
    half = np.uint64(32)
    i, j, k = ((first & low) * n) >> half, ((first >> half) * n) >> half, ((second & low) * n) >> half
    return state, np.int64(i), np.int64(j), np.int64(k)


@kernel
def _area2(scaled, i, j, k):
    """Return the squared area of a triangle."""
    ax, ay, az = scaled[j, 0] - scaled[i, 0], scaled[j, 1] - scaled[i, 1], scaled[j, 2] - scaled[i, 2]
    bx, by, bz = scaled[k, 0] - scaled[i, 0], scaled[k, 1] - scaled[i, 1], scaled[k, 2] - scaled[i, 2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    return (nx * nx + ny * ny + nz * nz) / 4


@kernel(inline=True)
def _measure(scaled, cells, grid, i, j, k, area2, lengths, kinds, s, histogram):
    """Measure one triple as sample s."""
    ax, ay, az = scaled[j, 0] - scaled[i, 0], scaled[j, 1] - scaled[i, 1], scaled[j, 2] - scaled[i, 2]
    bx, by, bz = scaled[k, 0] - scaled[i, 0], scaled[k, 1] - scaled[i, 1], scaled[k, 2] - scaled[i, 2]
    cx, cy, cz = bx - ax, by - ay, bz - az
    a = np.sqrt(ax * ax + ay * ay + az * az)
    b = np.sqrt(bx * bx + by * by + bz * bz)
    c = np.sqrt(cx * cx + cy * cy + cz * cz)
    in_a, count_a = _trace(grid, cells[i], cells[j])
    in_b, count_b = _trace(grid, cells[i], cells[k])
    in_c, count_c = _trace(grid, cells[j], cells[k])
    _note_line(a, in_a, count_a, lengths, kinds, s, 0, histogram)
    _note_line(b, in_b, count_b, lengths, kinds, s, 1, histogram)
    _note_line(c, in_c, count_c, lengths, kinds, s, 2, histogram)
    inside, count = in_a + in_b + in_c, count_a + count_b + count_c
    kind = OUT if inside <= 21 else (IN if count - inside < 4 else MIXED)
    lengths[s, 3] = np.sqrt(np.sqrt(area2))
    kinds[s, 3] = kind
    # Each angle weighs as much as the side opposite is long.
    histogram[A3 + kind, _angle_bin((ax * bx + ay * by + az * bz) / (a * b))] += count_c / HALF
    histogram[A3 + kind, _angle_bin((ax * cx + ay * cy + az * cz) / (a * c))] += count_b / HALF
    histogram[A3 + kind, _angle_bin((bx * cx + by * cy + bz * cz) / (b * c))] += count_a / HALF


@kernel
def _note_line(length, inside, count, lengths, kinds, s, side, histogram):
    """Note a side's length, its class, and its share inside the shape."""
    kind = IN if inside >= count - 1 else (OUT if inside <= 7 else MIXED)
    lengths[s, side] = length
    kinds[s, side] = kind
    histogram[RATIO + MIXED - kind, int(inside / count * (BINS - 1) + 0.5)] += 1


@kernel
def _angle_bin(cosine):
    """Return the bin of an angle folded to a right angle; arccos by Abramowitz and Stegun 4.4.46, error 2e-8."""
    x = min(abs(cosine), 1.0)
    p = -0.0170881256 + x * (0.0066700901 - x * 0.0012624911)
    p = 1.5707963050 + x * (-0.2145988016 + x * (0.0889789874 + x * (-0.0501743046 + x * (0.0308918810 + x * p))))
    return int(np.sqrt(1 - x) * p * ((BINS - 1) / (np.pi / 2)) + 0.5)


@kernel
def _bin_lengths(lengths, kinds, histogram):
    """Bin D2 and D3, each relative to the largest one measured."""
    longest, largest = np.float32(0), np.float32(0)
    for s in range(len(lengths)):
        longest = max(longest, lengths[s, 0], lengths[s, 1], lengths[s, 2])
        largest = max(largest, lengths[s, 3])
    for s in range(len(lengths)):
        for side in range(3):
            histogram[D2 + kinds[s, side], int(lengths[s, side] / longest * (BINS - 1) + 0.5)] += 1
        histogram[D3 + kinds[s, 3], int(lengths[s, 3] / largest * (BINS - 1) + 0.5)] += 1
