"""Rigid point-to-plane alignment on surfaces, many starts at a time, with what covariance needs."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from csgm_ros.cloud.kernels import kernel
from csgm_ros.tracking.surface import Surface, nearest

MIN_CORRESPONDENCES = 12
DAMPING = 1e-3  # of the mean information: directions that nothing holds stay as predicted
CONVERGED = 0.02  # of the gate: a step that moves the points by less is the last
NO_NORMALS = np.zeros((0, 3))


class Fit(NamedTuple):
    """What an alignment found.

    Attributes
    ----------
    matrix : (4, 4) ndarray
        From the points' frame into the grid's.
    score : float
        Mean closeness of the points, 1 on the surface, 0 from the last gate on or where normals differ.
    inliers : float
        Share of the points within the last gate whose normals agree.
    rms : float
        Of the robustly weighted point-to-plane distances, grid units.
    information : (6, 6) ndarray
        Sum of J'wJ for a small rotation about ``pivot`` and a translation, in the grid's frame.
    pivot : (3,) ndarray
        Mean of the moved points.
    """

    matrix: np.ndarray
    score: float
    inliers: float
    rms: float
    information: np.ndarray
    pivot: np.ndarray


def align(
    points: np.ndarray,
    normals: np.ndarray | None,
    grid: Surface,
    start: np.ndarray,
    gates: tuple[float, ...],
    *,
    iterations: int = 10,
    min_cosine: float = 0.6,
) -> Fit:
    """Move points onto a surface without changing the scale of ``start``.

    Parameters
    ----------
    points : (N, 3) ndarray
    normals : (N, 3) ndarray or None
        Unit normals of any sign; None where they cannot be trusted.
    grid : Surface
        The surface, with unit normals of any sign.
    start : (4, 4) ndarray
        Similarity to start from.
    gates : tuple of float
        Largest distance of a correspondence, grid units, one run after the other.
    iterations : int, optional
        At most, per gate.
    min_cosine : float, optional
        Smallest cosine between the normals of a correspondence, up to the sign.
    """
    matrix = np.array(start, float)
    normals = NO_NORMALS if normals is None else normals
    widths = np.array(gates, float)
    information, pivot = np.zeros((6, 6)), np.zeros(3)
    score, inliers, rms = _align(points, normals, grid, matrix, widths, iterations, min_cosine, information, pivot)
    return Fit(matrix, score, inliers, rms, information, pivot)


def align_through(
    points: np.ndarray, normals: np.ndarray, grids: Iterable[Surface], start: np.ndarray, *, iterations: int
) -> Fit:
    """Run :func:`align` on one surface after the other, from a coarse one to a fine one, each as far as its voxel."""
    for grid in grids:
        fit = align(points, normals, grid, start, (grid.voxel,), iterations=iterations, min_cosine=0.5)
        start = fit.matrix
    return fit


def align_each(
    points: np.ndarray,
    normals: np.ndarray | None,
    grid: Surface,
    starts: np.ndarray,
    gates: tuple[float, ...],
    *,
    iterations: int = 10,
    min_cosine: float = 0.6,
) -> tuple[np.ndarray, np.ndarray]:
    """Run :func:`align` from each of (K, 4, 4) starts; return the refined (K, 4, 4) and their (K,) scores."""
    refined = np.array(starts, float)
    scores = np.empty(len(refined))
    normals = NO_NORMALS if normals is None else normals
    _align_each(points, normals, grid, refined, np.array(gates, float), iterations, min_cosine, scores)
    return refined, scores


@kernel
def _align_each(points, normals, grid, matrices, gates, iterations, min_cosine, scores):
    information, pivot = np.zeros((6, 6)), np.zeros(3)
    for k in range(len(matrices)):
        scores[k] = _align(points, normals, grid, matrices[k], gates, iterations, min_cosine, information, pivot)[0]


@kernel
def _align(points, normals, grid, matrix, gates, iterations, min_cosine, information, pivot):
    gradient = np.zeros(6)
    for gate in gates:
        for _ in range(iterations):
            _pivot(points, matrix, pivot)
            count = _sums(points, normals, grid, matrix, gate, min_cosine, pivot, information, gradient)[0]
            if count < MIN_CORRESPONDENCES or _step(matrix, information, gradient, pivot) < CONVERGED * gate:
                break
    gate = gates[-1]
    _pivot(points, matrix, pivot)
    count, close, squares, weights = _sums(
        points, normals, grid, matrix, gate, min_cosine, pivot, information, gradient
    )
    n = max(len(points), 1)
    return close / n, count / n, np.sqrt(squares / max(weights, 1e-12))


@kernel
def _pivot(points, m, pivot):
    mean = np.zeros(3)
    for p in range(len(points)):
        for k in range(3):
            mean[k] += points[p, k]
    mean /= max(len(points), 1)
    for k in range(3):
        pivot[k] = m[k, 0] * mean[0] + m[k, 1] * mean[1] + m[k, 2] * mean[2] + m[k, 3]


@kernel
def _sums(points, normals, grid, m, gate, min_cosine, pivot, information, gradient):
    """Fill J'wJ and J'we; return correspondences, summed closeness, weighted squares and weights."""
    information[:] = 0.0
    gradient[:] = 0.0
    scale = np.sqrt(m[0, 0] ** 2 + m[1, 0] ** 2 + m[2, 0] ** 2)
    kernel = (gate / 3.0) ** 2  # Geman-McClure: a residual of a third of the gate counts a quarter
    row = np.empty(6)
    count, close, squares, weights = 0, 0.0, 0.0, 0.0
    still, still_normals, keys, first, around, table, origin, voxel = grid
    for p in range(len(points)):
        a, b, c = points[p, 0], points[p, 1], points[p, 2]
        x = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c + m[0, 3]
        y = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c + m[1, 3]
        z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c + m[2, 3]
        q = nearest(still, keys, first, around, table, origin, voxel, x, y, z)
        if q < 0:
            continue
        dx, dy, dz = x - still[q, 0], y - still[q, 1], z - still[q, 2]
        squared = dx * dx + dy * dy + dz * dz
        if squared >= gate * gate:
            continue
        u, v, w = still_normals[q, 0], still_normals[q, 1], still_normals[q, 2]
        if len(normals):
            a, b, c = normals[p, 0], normals[p, 1], normals[p, 2]
            product = (
                (m[0, 0] * a + m[0, 1] * b + m[0, 2] * c) * u
                + (m[1, 0] * a + m[1, 1] * b + m[1, 2] * c) * v
                + (m[2, 0] * a + m[2, 1] * b + m[2, 2] * c) * w
            )
            if abs(product) < min_cosine * scale:
                continue
        error = dx * u + dy * v + dz * w
        weight = (kernel / (kernel + error * error)) ** 2
        x, y, z = x - pivot[0], y - pivot[1], z - pivot[2]
        row[0], row[1], row[2] = y * w - z * v, z * u - x * w, x * v - y * u
        row[3], row[4], row[5] = u, v, w
        for k in range(6):
            gradient[k] += weight * row[k] * error
            for n in range(k + 1):
                information[k, n] += weight * row[k] * row[n]
        count += 1
        close += 1.0 - np.sqrt(squared) / gate
        squares += weight * error * error
        weights += weight
    for k in range(6):
        for n in range(k):
            information[n, k] = information[k, n]
    return count, close, squares, weights


@kernel
def _step(matrix, information, gradient, pivot):
    """Do one damped Gauss-Newton step in place; return about how far it moved the points."""
    damped = information.copy()
    turn = (information[0, 0] + information[1, 1] + information[2, 2]) / 3.0
    shift = (information[3, 3] + information[4, 4] + information[5, 5]) / 3.0
    for k in range(3):
        damped[k, k] += DAMPING * turn + 1e-12
        damped[3 + k, 3 + k] += DAMPING * shift + 1e-12
    step = -np.linalg.solve(damped, gradient)
    move(matrix, step, pivot)
    arm = np.sqrt(turn / max(shift, 1e-12))
    return np.sqrt((step[:3] ** 2).sum()) * arm + np.sqrt((step[3:] ** 2).sum())


@kernel
def move(matrix, step, pivot):
    """Turn a (4, 4) matrix in place by a rotation vector about ``pivot``, then shift it: ``step`` is (6,)."""
    angle = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    k = np.zeros((3, 3))
    k[0, 1], k[0, 2], k[1, 2] = -step[2], step[1], -step[0]
    k[1, 0], k[2, 0], k[2, 1] = step[2], -step[1], step[0]
    first = np.sin(angle) / angle if angle > 1e-12 else 1.0
    second = (1.0 - np.cos(angle)) / angle**2 if angle > 1e-6 else 0.5
    rotation = np.eye(3) + first * k + second * (k @ k)
    matrix[:3, 3] -= pivot
    matrix[:3] = rotation @ matrix[:3]
    matrix[:3, 3] += pivot + step[3:]
