"""Step 1, scale normalisation (Sec. III-A, Eq. 1)."""

from __future__ import annotations

import numpy as np

from csgm_ros.types import Similarity


def radius(points: np.ndarray) -> float:
    """Return the largest distance of (N, 3) points to their centroid, the numerator of Eq. (1)."""
    return float(np.sqrt(((points - points.mean(0)) ** 2).sum(1).max()))


def normalization(points: np.ndarray) -> Similarity:
    """Return the transform that centres (N, 3) points and gives them radius 1.

    Doing so to both clouds divides them by the scale of Eq. (1) and, beyond it, frees every later stage of
    the clouds' units and origins.
    """
    scale = 1.0 / radius(points)
    return Similarity(scale, np.eye(3), -scale * points.mean(0))
