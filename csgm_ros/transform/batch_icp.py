"""Short ICP with scale, on look-up tables, for the hundreds of transforms that verification looks at.

Point to plane, because smooth surfaces slide; with a little point to point, because planes and spheres leave
directions open; correspondences of both directions, because those of one direction with a wide distance shrink the
source.
"""

from __future__ import annotations

import numpy as np

from csgm_ros.cloud.kernels import kernel
from csgm_ros.cloud.nearest_grid import lookup
from csgm_ros.types import NearestGrid

POINT_WEIGHT = 0.05  # of point-to-point beside point-to-plane
MIN_CORRESPONDENCES = 10
COLUMNS = 15  # numbers that a correspondence gives, see :func:`_agree`


def refine_all(
    transforms: np.ndarray,
    source: NearestGrid,
    target: NearestGrid,
    samples: tuple[np.ndarray, np.ndarray],
    distances: tuple[float, ...],
    min_cosine: float,
    *,
    iterations: int = 8,
    estimate_scale: bool = True,
) -> np.ndarray:
    """Refine each of (H, 4, 4) transforms by a short ICP.

    Parameters
    ----------
    transforms : (H, 4, 4) ndarray
        Similarity matrices, source to target.
    samples : pair of index arrays
        Points of source and target that seek a correspondence.
    distances : tuple of float
        Largest distance of a correspondence, target units; one run after the other, wide to narrow.
    min_cosine : float
        Smallest cosine between the normals of a correspondence, up to their sign.
    iterations : int, optional
        At most, per distance.
    estimate_scale : bool, optional
        False keeps the scale of each transform.

    Returns
    -------
    (H, 4, 4) ndarray
    """
    refined = np.array(transforms, float).reshape(-1, 4, 4)
    ordered = np.sort(samples[0]), np.sort(samples[1])  # as they lie in memory: voxel by voxel
    _refine_all(refined, source, target, *ordered, np.array(distances), min_cosine, iterations, estimate_scale)
    return refined


@kernel
def _refine_all(
    transforms, source, target, from_source, from_target, distances, min_cosine, iterations, estimate_scale
):
    most = len(from_source) + len(from_target)
    pairs, columns = np.empty((2, most), np.int64), np.empty((COLUMNS, most))
    for h in range(len(transforms)):
        for distance in distances:
            for _ in range(iterations):
                scale = np.sqrt(transforms[h, 0, 0] ** 2 + transforms[h, 1, 0] ** 2 + transforms[h, 2, 0] ** 2)
                count = _pair(transforms[h], scale, source, target, from_source, from_target, pairs)
                count = _agree(transforms[h], source, target, pairs[:, :count], distance, min_cosine * scale, columns)
                if _step(transforms[h], columns, count, estimate_scale) < 0.02 * distance:
                    break


@kernel
def _pair(m, scale, source, target, from_source, from_target, pairs):
    """Write which points of source and target are nearest, of both directions, and return how many.

    Neither here nor in what follows is there a branch that depends on a point: it would be guessed wrong half the time.
    """
    count = 0
    for i in from_source:
        a, b, c = source.points[i, 0], source.points[i, 1], source.points[i, 2]
        x = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c + m[0, 3]
        y = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c + m[1, 3]
        z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c + m[2, 3]
        j = lookup(target.index, target.origin, target.cell, x, y, z)
        pairs[0, count], pairs[1, count] = i, j
        count += j >= 0
    squared = scale * scale
    for j in from_target:
        x = target.points[j, 0] - m[0, 3]
        y = target.points[j, 1] - m[1, 3]
        z = target.points[j, 2] - m[2, 3]
        a = (m[0, 0] * x + m[1, 0] * y + m[2, 0] * z) / squared
        b = (m[0, 1] * x + m[1, 1] * y + m[2, 1] * z) / squared
        c = (m[0, 2] * x + m[1, 2] * y + m[2, 2] * z) / squared
        i = lookup(source.index, source.origin, source.cell, a, b, c)
        pairs[0, count], pairs[1, count] = i, j
        count += i >= 0
    return count


@kernel
def _agree(m, source, target, pairs, distance, min_product, columns):
    """Write the columns of the pairs that are near and whose normals agree, and return how many.

    A source point is moved to (x, y, z), and from its target point, of normal (u, v, w), by (dx, dy, dz). Columns 0 to
    6 are the derivatives of (u, v, w) . (x, y, z) by rotation about the origin, log scale and translation, column 7 is
    the error (u, v, w) . (dx, dy, dz); then come x, y, z, 1, dx, dy, dz.
    """
    count = 0
    for n in range(pairs.shape[1]):
        i, j = pairs[0, n], pairs[1, n]
        a, b, c = source.points[i, 0], source.points[i, 1], source.points[i, 2]
        x = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c + m[0, 3]
        y = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c + m[1, 3]
        z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c + m[2, 3]
        dx, dy, dz = x - target.points[j, 0], y - target.points[j, 1], z - target.points[j, 2]
        u, v, w = target.normals[j, 0], target.normals[j, 1], target.normals[j, 2]
        d, e, f = source.normals[i, 0], source.normals[i, 1], source.normals[i, 2]
        product = (
            (m[0, 0] * d + m[0, 1] * e + m[0, 2] * f) * u
            + (m[1, 0] * d + m[1, 1] * e + m[1, 2] * f) * v
            + (m[2, 0] * d + m[2, 1] * e + m[2, 2] * f) * w
        )
        columns[0, count], columns[1, count], columns[2, count] = y * w - z * v, z * u - x * w, x * v - y * u
        columns[3, count] = x * u + y * v + z * w
        columns[4, count], columns[5, count], columns[6, count] = u, v, w
        columns[7, count] = dx * u + dy * v + dz * w
        columns[8, count], columns[9, count], columns[10, count], columns[11, count] = x, y, z, 1.0
        columns[12, count], columns[13, count], columns[14, count] = dx, dy, dz
        near = dx * dx + dy * dy + dz * dz <= distance * distance
        count += np.int64(near) & np.int64(abs(product) >= min_product)
    return count


@kernel
def _step(matrix, columns, count, estimate_scale):
    """Do one Gauss-Newton step in place and return about how far it moved the cloud; 0 when it cannot."""
    if count < MIN_CORRESPONDENCES:
        return 0.0
    planes = _products(columns[:8], 7, count)
    normal_matrix, gradient = planes[:, :7].copy(), planes[:, 7].copy()
    _add_points(POINT_WEIGHT * _products(columns[8:], 4, count), normal_matrix, gradient)
    if not estimate_scale:
        normal_matrix[3, :] = 0.0
        normal_matrix[:, 3] = 0.0
        gradient[3] = 0.0
    for k in range(7):
        normal_matrix[k, k] += 1e-6 * count
    step = -np.linalg.solve(normal_matrix, gradient)
    _compose(matrix, step)
    return np.abs(step).max()


@kernel(fastmath=True)
def _products(columns, first, count):
    """Return the scalar products of the ``first`` columns with all, over ``count`` pairs."""
    products = np.zeros((first, len(columns)))
    for a in range(first):
        for b in range(a, len(columns)):
            total = 0.0
            for n in range(count):
                total += columns[a, n] * columns[b, n]
            products[a, b] = total
            if b < first:
                products[b, a] = total
    return products


@kernel
def _add_points(p, normal_matrix, gradient):
    """Add point to point, the three axes at once, of the products of x, y, z, 1 with these and dx, dy, dz."""
    squares = p[0, 0] + p[1, 1] + p[2, 2]
    normal_matrix[:3, :3] -= p[:3, :3]
    normal_matrix[3, 3] += squares
    gradient[3] += p[0, 4] + p[1, 5] + p[2, 6]
    for k in range(3):
        after, last = (k + 1) % 3, (k + 2) % 3
        gradient[k] += p[after, 4 + last] - p[last, 4 + after]
        gradient[4 + k] += p[3, 4 + k]
        normal_matrix[k, k] += squares
        normal_matrix[4 + k, 4 + k] += p[3, 3]
        for row, column, value in ((3, 4 + k, p[k, 3]), (after, 4 + last, -p[k, 3]), (last, 4 + after, p[k, 3])):
            normal_matrix[row, column] += value
            normal_matrix[column, row] += value


@kernel
def _compose(matrix, step):
    # matrix <- exp(step) matrix, rotation by Rodrigues
    angle = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    k = np.zeros((3, 3))
    k[0, 1], k[0, 2], k[1, 2] = -step[2], step[1], -step[0]
    k[1, 0], k[2, 0], k[2, 1] = step[2], -step[1], step[0]
    first = np.sin(angle) / angle if angle > 1e-12 else 1.0
    second = (1.0 - np.cos(angle)) / angle**2 if angle > 1e-6 else 0.5
    growth = np.exp(min(max(step[3], -0.2), 0.2))
    old = matrix.copy()
    for r in range(3):
        for c in range(4):
            value = old[r, c]
            for n in range(3):
                square = 0.0
                for q in range(3):
                    square += k[r, q] * k[q, n]
                value += (first * k[r, n] + second * square) * old[n, c]
            matrix[r, c] = growth * value
        matrix[r, 3] += step[4 + r]
