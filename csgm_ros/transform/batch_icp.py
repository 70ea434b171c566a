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
    for h in range(len(transforms)):
        for distance in distances:
            for _ in range(iterations):
                if (
                    _step(transforms[h], source, target, from_source, from_target, distance, min_cosine, estimate_scale)
                    < 0.02 * distance
                ):
                    break


@kernel
def _step(matrix, source, target, from_source, from_target, distance, min_cosine, estimate_scale):
    """Do one Gauss-Newton step in place and return about how far it moved the cloud; 0 when it cannot."""
    scale = np.sqrt(matrix[0, 0] ** 2 + matrix[1, 0] ** 2 + matrix[2, 0] ** 2)
    normal_matrix, gradient = np.zeros((7, 7)), np.zeros(7)
    count = _pull_source(matrix, source, target, from_source, distance, min_cosine * scale, normal_matrix, gradient)
    count += _pull_target(
        matrix, scale, source, target, from_target, distance, min_cosine * scale, normal_matrix, gradient
    )
    if count < MIN_CORRESPONDENCES:
        return 0.0
    for k in range(7):
        for n in range(k):
            normal_matrix[k, n] = normal_matrix[n, k]
    if not estimate_scale:
        normal_matrix[3, :] = 0.0
        normal_matrix[:, 3] = 0.0
        gradient[3] = 0.0
    for k in range(7):
        normal_matrix[k, k] += 1e-6 * count
    step = -np.linalg.solve(normal_matrix, gradient)
    _compose(matrix, step)
    return np.abs(step).max()


@kernel
def _pull_source(m, source, target, chosen, distance, min_product, normal_matrix, gradient):
    count = 0
    row = np.empty(7)
    for i in chosen:
        a, b, c = source.points[i, 0], source.points[i, 1], source.points[i, 2]
        x = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c + m[0, 3]
        y = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c + m[1, 3]
        z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c + m[2, 3]
        j = lookup(target.index, target.origin, target.cell, x, y, z)
        if j >= 0:
            count += _accumulate(m, source, target, i, j, x, y, z, distance, min_product, row, normal_matrix, gradient)
    return count


@kernel
def _pull_target(m, scale, source, target, chosen, distance, min_product, normal_matrix, gradient):
    count = 0
    row = np.empty(7)
    squared = scale * scale
    for j in chosen:
        x = target.points[j, 0] - m[0, 3]
        y = target.points[j, 1] - m[1, 3]
        z = target.points[j, 2] - m[2, 3]
        a = (m[0, 0] * x + m[1, 0] * y + m[2, 0] * z) / squared
        b = (m[0, 1] * x + m[1, 1] * y + m[2, 1] * z) / squared
        c = (m[0, 2] * x + m[1, 2] * y + m[2, 2] * z) / squared
        i = lookup(source.index, source.origin, source.cell, a, b, c)
        if i >= 0:
            a, b, c = source.points[i, 0], source.points[i, 1], source.points[i, 2]
            x = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c + m[0, 3]
            y = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c + m[1, 3]
            z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c + m[2, 3]
            count += _accumulate(m, source, target, i, j, x, y, z, distance, min_product, row, normal_matrix, gradient)
    return count


@kernel(inline=True)
def _accumulate(m, source, target, i, j, x, y, z, distance, min_product, row, normal_matrix, gradient):
    # source point i, moved to (x, y, z), corresponds to target point j: add J' W J (upper triangle) and J' W e of
    # e = moved - target
    dx, dy, dz = x - target.points[j, 0], y - target.points[j, 1], z - target.points[j, 2]
    if dx * dx + dy * dy + dz * dz > distance * distance:
        return 0
    u, v, w = target.normals[j, 0], target.normals[j, 1], target.normals[j, 2]
    d, e, f = source.normals[i, 0], source.normals[i, 1], source.normals[i, 2]
    product = (
        (m[0, 0] * d + m[0, 1] * e + m[0, 2] * f) * u
        + (m[1, 0] * d + m[1, 1] * e + m[1, 2] * f) * v
        + (m[2, 0] * d + m[2, 1] * e + m[2, 2] * f) * w
    )
    if abs(product) < min_product:
        return 0
    # derivative of (u, v, w) . point by rotation about the origin, log scale and translation
    row[0], row[1], row[2] = y * w - z * v, z * u - x * w, x * v - y * u
    row[3] = x * u + y * v + z * w
    row[4], row[5], row[6] = u, v, w
    error = dx * u + dy * v + dz * w
    for k in range(7):
        gradient[k] += row[k] * error
        for n in range(k, 7):
            normal_matrix[k, n] += row[k] * row[n]
    _accumulate_point(x, y, z, dx, dy, dz, normal_matrix, gradient)
    return 1


@kernel(inline=True)
def _accumulate_point(x, y, z, dx, dy, dz, normal_matrix, gradient):
    # the same for the three axes at once, upper triangle
    weight = POINT_WEIGHT
    gradient[0] += weight * (y * dz - z * dy)
    gradient[1] += weight * (z * dx - x * dz)
    gradient[2] += weight * (x * dy - y * dx)
    gradient[3] += weight * (x * dx + y * dy + z * dz)
    gradient[4] += weight * dx
    gradient[5] += weight * dy
    gradient[6] += weight * dz
    xx, yy, zz = weight * x * x, weight * y * y, weight * z * z
    normal_matrix[0, 0] += yy + zz
    normal_matrix[1, 1] += xx + zz
    normal_matrix[2, 2] += xx + yy
    normal_matrix[3, 3] += xx + yy + zz
    normal_matrix[0, 1] -= weight * x * y
    normal_matrix[0, 2] -= weight * x * z
    normal_matrix[1, 2] -= weight * y * z
    normal_matrix[0, 5] -= weight * z
    normal_matrix[0, 6] += weight * y
    normal_matrix[1, 4] += weight * z
    normal_matrix[1, 6] -= weight * x
    normal_matrix[2, 4] -= weight * y
    normal_matrix[2, 5] += weight * x
    normal_matrix[3, 4] += weight * x
    normal_matrix[3, 5] += weight * y
    normal_matrix[3, 6] += weight * z
    for k in range(4, 7):
        normal_matrix[k, k] += weight


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
