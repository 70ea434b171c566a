"""Planes through the neighbourhoods of points."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

CHUNK = 4096  # neighbourhoods at a time: all at once would take gigabytes on a large cloud


def fit_planes(points: np.ndarray, neighbors: int, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit a plane to the nearest points of each place by their covariance.

    Parameters
    ----------
    points : (N, 3) ndarray
        Finite points.
    neighbors : int
        Nearest points that a plane is fitted to.
    places : (P, 3) ndarray

    Returns
    -------
    means, normals : (P, 3) ndarray
        A point of each plane and its unit normal, of arbitrary sign.
    extents : (P, 3) ndarray
        Standard deviations along the principal axes, ascending: the first is across the plane.
    """
    _, near = cKDTree(points).query(places, k=min(neighbors, len(points)))
    means, covariances = np.empty_like(places), np.empty((len(places), 3, 3))
    for first in range(0, len(places), CHUNK):
        chunk = slice(first, first + CHUNK)
        group = points[near[chunk]]
        means[chunk] = group.mean(1)
        centred = group - means[chunk, None]
        covariances[chunk] = np.einsum('nki,nkj->nij', centred, centred) / near.shape[1]
    variances, axes = np.linalg.eigh(covariances)
    return means, axes[:, :, 0], np.sqrt(np.maximum(variances, 0.0))
