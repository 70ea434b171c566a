"""How far an estimated similarity is from the truth, and what counts as right."""

from __future__ import annotations

import math

import numpy as np

from benchmarks.datasets import Pair, apply
from csgm_ros.types import rotation_angle

LOOSE, TIGHT = 0.05, 0.02
"""Bounds on :func:`rmse_over_radius` for Database C."""


def radius(points: np.ndarray) -> float:
    """Return the largest distance to the centroid (Sec. IV-A) of (N, 3) points."""
    return float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())


def robust_radius(points: np.ndarray) -> float:
    """Return the distance to the median within which 95 % of (N, 3) points lie."""
    return float(np.percentile(np.linalg.norm(points - np.median(points, axis=0), axis=1), 95))


def split(matrix: np.ndarray) -> tuple[float, np.ndarray]:
    """Return scale and rotation of a homogeneous similarity."""
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    return scale, matrix[:3, :3] / scale


def displacements(estimate: np.ndarray, pair: Pair) -> np.ndarray:
    """Distance of each clean source point under the estimated and the true transform, target units."""
    return np.linalg.norm(apply(estimate, pair.clean_source) - apply(pair.T_target_source, pair.clean_source), axis=1)


def rmse_over_radius(estimate: np.ndarray, pair: Pair) -> float:
    """Root mean square displacement over the target's radius."""
    return float(np.sqrt(np.mean(displacements(estimate, pair) ** 2))) / radius(pair.target)


def rotation_error_deg(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Angle of the rotation between two similarities, degrees, in [0, 180]."""
    return math.degrees(rotation_angle(split(estimate)[1].T @ split(truth)[1]))


def scale_error(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Return ``|log(s / s_true)|``: 0.06 is six per cent."""
    return abs(math.log(split(estimate)[0] / split(truth)[0]))


def rotation_f_norm(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Frobenius norm of the difference of the two rotations (the paper's same-source error), in [0, 2 sqrt(2)]."""
    return float(np.linalg.norm(split(estimate)[1] - split(truth)[1]))


def matrix_f_norm(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Frobenius norm of the difference of the two matrices (the paper's Databases B and C)."""
    return float(np.linalg.norm(estimate - truth))


def threedcsr_errors(estimate: np.ndarray, pair: Pair) -> tuple[float, float]:
    """Return translation and rotation error (degrees) as the 3DCSR benchmark measures them.

    It centres each cloud and divides it by its own radius before a *rigid* truth applies; so the translation
    error is how far the source's centroid ends up from where it belongs, over the target's radius.
    """
    centre = pair.source.mean(axis=0, keepdims=True)
    distance = np.linalg.norm(apply(estimate, centre) - apply(pair.T_target_source, centre))
    return float(distance) / radius(pair.target), rotation_error_deg(estimate, pair.T_target_source)


def threedcsr_success(estimate: np.ndarray, pair: Pair) -> bool:
    """Translation error below 0.3 and rotation error below 15 degrees, both strictly."""
    translation, rotation = threedcsr_errors(estimate, pair)
    return translation < 0.3 and rotation < 15.0


def right(estimate: np.ndarray, pair: Pair, bound: float = LOOSE) -> bool:
    """Whether an estimate counts as right.

    Synthetic pairs: RMSE over the radius below ``bound``. Real pairs, whose truth is known to 1-4 cm: mean
    displacement under 0.10 m, for places under 3 % of the source's robust radius where that is more, rotation under
    5 degrees, scale under 6 %. A pair without a truth is never right.
    """
    if pair.T_target_source is None or not np.all(np.isfinite(estimate)) or np.linalg.det(estimate[:3, :3]) <= 0:
        return False
    if pair.kind in ('real', 'place'):
        allowed = 0.10 * pair.metre
        if pair.kind == 'place':
            allowed = max(allowed, 0.03 * robust_radius(apply(pair.T_target_source, pair.clean_source)))
        return bool(
            displacements(estimate, pair).mean() < allowed
            and rotation_error_deg(estimate, pair.T_target_source) < 5.0
            and scale_error(estimate, pair.T_target_source) < 0.06
        )
    return rmse_over_radius(estimate, pair) < bound


def errors(estimate: np.ndarray, pair: Pair) -> dict[str, float]:
    """Return every error of an estimate by name; infinite where the estimate is not a similarity at all."""
    names = ('rmse', 'rmse_absolute', 'mean', 'rotation', 'scale', 'f_rotation', 'f_matrix', 'rte')
    if pair.T_target_source is None:
        return dict.fromkeys(names, math.nan)
    if not np.all(np.isfinite(estimate)) or np.linalg.det(estimate[:3, :3]) <= 0:
        return dict.fromkeys(names, math.inf)
    truth = pair.T_target_source
    values = (
        rmse_over_radius(estimate, pair),
        rmse_over_radius(estimate, pair) * radius(pair.target),
        float(displacements(estimate, pair).mean()),
        rotation_error_deg(estimate, truth),
        scale_error(estimate, truth),
        rotation_f_norm(estimate, truth),
        matrix_f_norm(estimate, truth),
        threedcsr_errors(estimate, pair)[0],
    )
    return dict(zip(names, values, strict=True))


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Return the 95 % Wilson score interval of a rate."""
    if trials == 0:
        return 0.0, 1.0
    z = 1.959963984540054
    rate, spread = successes / trials, z * z / trials
    centre = (rate + spread / 2) / (1 + spread)
    half = z / (1 + spread) * math.sqrt(rate * (1 - rate) / trials + spread / (4 * trials))
    return max(0.0, centre - half), min(1.0, centre + half)
