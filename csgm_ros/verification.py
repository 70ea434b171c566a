"""Which of several candidate transforms is right (Sec. III-E, extended).

The paper trusts one transform from RANSAC and ICP. Here every hypothesis is scored by how much of the source
lies on the target *and* of the target on the source, and the smaller share counts: a one-sided score or the
sum prefers shrunken solutions.
"""

from __future__ import annotations

import numba
import numpy as np

from csgm_ros.nearest import NearestGrid, lookup


@numba.njit(cache=True, nogil=True)
def _coverage(points, normals, transforms, grid, gate, min_cosine, out):
    """Write the share of points that each (4, 4) transform of (H, 4, 4) lays on the grid's cloud, normals agreeing.

    ``gate`` is in the grid's unit. Normals count up to their sign.
    """
    for h in range(len(transforms)):
        matrix = transforms[h]
        scale = np.sqrt(matrix[0, 0] ** 2 + matrix[1, 0] ** 2 + matrix[2, 0] ** 2)
        hits = 0
        for p in range(len(points)):
            a, b, c = points[p]
            x = matrix[0, 0] * a + matrix[0, 1] * b + matrix[0, 2] * c + matrix[0, 3]
            y = matrix[1, 0] * a + matrix[1, 1] * b + matrix[1, 2] * c + matrix[1, 3]
            z = matrix[2, 0] * a + matrix[2, 1] * b + matrix[2, 2] * c + matrix[2, 3]
            q = lookup(grid.index, grid.origin, grid.cell, x, y, z)
            if q < 0:
                continue
            near = grid.points[q]
            if (x - near[0]) ** 2 + (y - near[1]) ** 2 + (z - near[2]) ** 2 > gate * gate:
                continue
            a, b, c = normals[p]
            u, v, w = grid.normals[q]
            cosine = (
                (matrix[0, 0] * a + matrix[0, 1] * b + matrix[0, 2] * c) * u
                + (matrix[1, 0] * a + matrix[1, 1] * b + matrix[1, 2] * c) * v
                + (matrix[2, 0] * a + matrix[2, 1] * b + matrix[2, 2] * c) * w
            ) / scale
            if abs(cosine) >= min_cosine:
                hits += 1
        out[h] = hits / len(points)


@numba.njit(cache=True, nogil=True)
def inverses(transforms):
    """Return the inverses of (H, 4, 4) similarity matrices."""
    out = np.zeros_like(transforms)
    for h in range(len(transforms)):
        m = transforms[h]
        squared = m[0, 0] ** 2 + m[1, 0] ** 2 + m[2, 0] ** 2
        for i in range(3):
            for j in range(3):
                out[h, i, j] = m[j, i] / squared
        for i in range(3):
            out[h, i, 3] = -(out[h, i, 0] * m[0, 3] + out[h, i, 1] * m[1, 3] + out[h, i, 2] * m[2, 3])
        out[h, 3, 3] = 1.0
    return out


def both_coverages(
    transforms: np.ndarray,
    source: NearestGrid,
    target: NearestGrid,
    gate: float,
    min_cosine: float,
    samples: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """Return how much of each cloud every transform lays on the other.

    Parameters
    ----------
    transforms : (H, 4, 4) ndarray
        Similarity matrices, source to target.
    gate : float
        Largest distance, target units.
    min_cosine : float
        Smallest cosine between the normals, up to their sign.
    samples : pair of index arrays, optional
        Points of source and target that are looked at; all by default.

    Returns
    -------
    (H, 2) ndarray
        Share of the source on the target, share of the target on the source.
    """
    chosen = samples or (slice(None), slice(None))
    forth, back = np.empty(len(transforms)), np.empty(len(transforms))
    gates = np.full(len(transforms), gate)
    scales = np.linalg.norm(transforms[:, :3, 0], axis=1)
    _coverages(source.points[chosen[0]], source.normals[chosen[0]], transforms, target, gates, min_cosine, forth)
    backward = inverses(transforms)
    _coverages(target.points[chosen[1]], target.normals[chosen[1]], backward, source, gates / scales, min_cosine, back)
    return np.column_stack([forth, back])


@numba.njit(cache=True, nogil=True)
def _coverages(points, normals, transforms, grid, gates, min_cosine, out):
    for h in range(len(transforms)):
        _coverage(points, normals, transforms[h : h + 1], grid, gates[h], min_cosine, out[h : h + 1])


@numba.njit(cache=True, nogil=True)
def refine(matrix, source, target, gates, iterations, min_cosine, estimate_scale):
    """Scaled ICP with shrinking gates on look-up tables; correspondences of both directions count.

    One-sided correspondences with wide gates shrink the source; those of the other direction pull it apart
    again.
    """
    for gate in gates:
        for _ in range(iterations):
            moments = _correspondence_moments(matrix, source, target, gate, min_cosine)
            if moments[0] < 10:
                return matrix
            new = _fit(moments, matrix, estimate_scale)
            change = np.abs(new - matrix).max()
            matrix = new
            if change < 1e-4:
                break
    return matrix


@numba.njit(cache=True, nogil=True)
def _correspondence_moments(matrix, source, target, gate, min_cosine):
    # count, sum p, sum q, sum q p^T, sum |p|^2 over correspondences (p in source, q in target)
    moments = np.zeros(17)
    scale = np.sqrt(matrix[0, 0] ** 2 + matrix[1, 0] ** 2 + matrix[2, 0] ** 2)
    back = inverses(matrix.reshape(1, 4, 4))[0]
    _collect(moments, matrix, source, target, gate, min_cosine * scale, False)
    _collect(moments, back, target, source, gate / scale, min_cosine / scale, True)
    return moments


@numba.njit(cache=True, nogil=True)
def _collect(moments, m, moving, fixed, gate, min_product, swapped):
    for i in range(len(moving.points)):
        a, b, c = moving.points[i, 0], moving.points[i, 1], moving.points[i, 2]
        x = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c + m[0, 3]
        y = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c + m[1, 3]
        z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c + m[2, 3]
        j = lookup(fixed.index, fixed.origin, fixed.cell, x, y, z)
        if j < 0:
            continue
        u, v, w = fixed.points[j, 0], fixed.points[j, 1], fixed.points[j, 2]
        if (x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2 > gate * gate:
            continue
        d, e, f = moving.normals[i, 0], moving.normals[i, 1], moving.normals[i, 2]
        product = (
            (m[0, 0] * d + m[0, 1] * e + m[0, 2] * f) * fixed.normals[j, 0]
            + (m[1, 0] * d + m[1, 1] * e + m[1, 2] * f) * fixed.normals[j, 1]
            + (m[2, 0] * d + m[2, 1] * e + m[2, 2] * f) * fixed.normals[j, 2]
        )
        if abs(product) < min_product:
            continue
        if swapped:
            _add(moments, u, v, w, a, b, c)
        else:
            _add(moments, a, b, c, u, v, w)


@numba.njit(cache=True, nogil=True, inline='always')
def _add(moments, a, b, c, u, v, w):
    moments[0] += 1.0
    moments[1] += a
    moments[2] += b
    moments[3] += c
    moments[4] += u
    moments[5] += v
    moments[6] += w
    moments[7] += u * a
    moments[8] += u * b
    moments[9] += u * c
    moments[10] += v * a
    moments[11] += v * b
    moments[12] += v * c
    moments[13] += w * a
    moments[14] += w * b
    moments[15] += w * c
    moments[16] += a * a + b * b + c * c


@numba.njit(cache=True, nogil=True)
def _fit(moments, matrix, estimate_scale):
    count = moments[0]
    mean_p, mean_q = moments[1:4] / count, moments[4:7] / count
    covariance = moments[7:16].copy().reshape(3, 3) / count - np.outer(mean_q, mean_p)
    u, singular, vt = np.linalg.svd(covariance)
    sign = 1.0 if np.linalg.det(u) * np.linalg.det(vt) > 0.0 else -1.0
    u[:, 2] *= sign
    rotation = u @ vt
    spread = moments[16] / count - (mean_p**2).sum()
    scale = np.sqrt((matrix[:3, 0] ** 2).sum())
    if estimate_scale and spread > 0.0:
        scale = (singular[0] + singular[1] + sign * singular[2]) / spread
    new = np.eye(4)
    new[:3, :3] = scale * rotation
    new[:3, 3] = mean_q - scale * (rotation @ mean_p)
    return new


def best_distinct(
    transforms: np.ndarray, scores: np.ndarray, probe: np.ndarray, distance: float, count: int
) -> np.ndarray:
    """Return the indices of the ``count`` best transforms no two of which move ``probe`` alike.

    Parameters
    ----------
    transforms : (H, 4, 4) ndarray
    scores : (H,) ndarray
        Larger is better; ties keep the given order.
    probe : (P, 3) ndarray
        Source points.
    distance : float
        RMS displacement of the probe below which two transforms are the same.
    """
    kept, images = [], []
    for h in np.argsort(-scores, kind='stable'):
        image = probe @ transforms[h, :3, :3].T + transforms[h, :3, 3]
        if images and ((np.array(images) - image) ** 2).sum(2).mean(1).min() < distance**2:
            continue
        kept.append(h)
        images.append(image)
        if len(kept) == count:
            break
    return np.array(kept, int)


def refine_all(
    transforms: np.ndarray,
    source: NearestGrid,
    target: NearestGrid,
    gates: tuple[float, ...],
    min_cosine: float,
    *,
    iterations: int = 8,
    estimate_scale: bool = True,
) -> np.ndarray:
    """Return (H, 4, 4) transforms after a short scaled ICP each."""
    widths = np.array(gates)
    refined = [refine(m, source, target, widths, iterations, min_cosine, estimate_scale) for m in transforms]
    return np.array(refined).reshape(-1, 4, 4)
