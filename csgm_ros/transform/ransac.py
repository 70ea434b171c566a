"""Step 5, 3-D RANSAC: the transform that most matched centroids agree with (Sec. III-E)."""

from __future__ import annotations

import numpy as np

from csgm_ros.transform.similarity import umeyama, umeyama_many
from csgm_ros.types import Similarity

BATCH = 2000


def ransac(
    source: np.ndarray,
    target: np.ndarray,
    rng: np.random.Generator,
    *,
    iterations: int = 5000,
    inlier_distance: float = 0.1,
    estimate_scale: bool = True,
) -> tuple[Similarity, np.ndarray]:
    """Estimate a similarity from matches of which many may be wrong.

    Parameters
    ----------
    source, target : (k, 3) ndarray
        Matched centroids.
    rng : numpy.random.Generator
        Draws the triples.
    iterations : int, optional
        Triples drawn.
    inlier_distance : float, optional
        Largest distance of an inlier, target units.
    estimate_scale : bool, optional
        False for a rigid transform.

    Returns
    -------
    transform : Similarity
        Fitted to all inliers; the identity when fewer than three matches agree on anything.
    inliers : (k,) bool ndarray
    """
    if len(source) < 3:
        return Similarity.identity(), np.zeros(len(source), bool)
    best, most = Similarity.identity(), -1
    for first in range(0, iterations, BATCH):
        triples = rng.random((min(BATCH, iterations - first), len(source))).argpartition(2, axis=1)[:, :3]
        scales, rotations, translations = umeyama_many(source[triples], target[triples], estimate_scale=estimate_scale)
        moved = scales[:, None, None] * np.einsum('nij,kj->nki', rotations, source) + translations[:, None]
        counts = (((moved - target) ** 2).sum(2) < inlier_distance**2).sum(1)
        winner = int(counts.argmax())
        if counts[winner] > most:
            most = int(counts[winner])
            best = Similarity(float(scales[winner]), rotations[winner], translations[winner])
    inliers = _inliers(best, source, target, inlier_distance)
    if inliers.sum() >= 3:
        best = umeyama(source[inliers], target[inliers], estimate_scale=estimate_scale)
        inliers = _inliers(best, source, target, inlier_distance)
    return best, inliers


def _inliers(transform: Similarity, source: np.ndarray, target: np.ndarray, distance: float) -> np.ndarray:
    return ((transform.apply(source) - target) ** 2).sum(1) < distance**2
