"""Geometry of similarity transforms, ``x_target = s R x_source + t``: the least-squares fit and two errors."""

from __future__ import annotations

import numpy as np

from csgm_ros.types import Similarity


def umeyama(source: np.ndarray, target: np.ndarray, *, estimate_scale: bool = True) -> Similarity:
    """Fit the similarity that maps matched points onto each other in the least-squares sense.

    Parameters
    ----------
    source, target : (N, 3) ndarray
        Matched points, N >= 3 and not all on one line.
    estimate_scale : bool, optional
        False fits a rigid transform (s = 1).

    Returns
    -------
    Similarity

    References
    ----------
    .. [1] S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns",
       IEEE TPAMI 13(4), 1991.
    """
    mean_source, mean_target = source.mean(0), target.mean(0)
    centred_source, centred_target = source - mean_source, target - mean_target
    u, singular, vt = np.linalg.svd(centred_target.T @ centred_source)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt)) or 1.0])
    rotation = (u * sign) @ vt
    spread = float((centred_source**2).sum())
    scale = float((singular * sign).sum()) / spread if estimate_scale and spread > 0.0 else 1.0
    return Similarity(scale, rotation, mean_target - scale * (rotation @ mean_source))


def rotation_angle(rotation: np.ndarray) -> float:
    """Return the angle of a (3, 3) rotation in radians, accurate near zero and pi."""
    sine = np.linalg.norm(rotation - rotation.T) / np.sqrt(8.0)
    cosine = (np.trace(rotation) - 1.0) / 2.0
    return float(np.arctan2(sine, cosine))


def displacement(first: Similarity, second: Similarity, points: np.ndarray) -> float:
    """Return the RMS distance between (N, 3) source points under two transforms, target units."""
    return float(np.sqrt(((first.apply(points) - second.apply(points)) ** 2).sum(1).mean()))
