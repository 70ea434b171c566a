"""What noise and stray points do to a cloud, and what can be done about it before the five steps."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from csgm_ros.types import Similarity
from csgm_ros.voxels import voxel_means

VOXEL = 0.02  # of the radius: evens out the density before neighbours are counted
NEIGHBORS = 10
FAR = 2.0  # radii


def dense_part(points: np.ndarray, factor: float) -> np.ndarray:
    """Return the voxels that are not strays: whose 10th neighbour is at most ``factor`` medians away.

    Parameters
    ----------
    points : (N, 3) ndarray
        Finite points.
    factor : float
        0 returns the points as they are.

    Returns
    -------
    (M, 3) ndarray
        Voxel means. One stray point far away changes the radius of Eq. (1), and with it every length; on real SfM
        clouds leaving strays out brings Eq. (1) from 0.63-1.12 of the true scale to 0.82-1.27.
    """
    if factor <= 0.0:
        return points
    distances = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    # not the largest distance: one stray would make the voxels larger than the cloud
    means = voxel_means(points, VOXEL * 1.2 * float(np.quantile(distances, 0.98)))
    distances = cKDTree(means).query(means, k=min(NEIGHBORS, len(means)))[0][:, -1]
    kept = means[distances <= factor * np.median(distances)]
    return kept if len(kept) >= 3 else points


def without_far_strays(points: np.ndarray, unit: Similarity) -> np.ndarray:
    """Return the points within twice the radius that :func:`dense_part` left: what is beyond only costs memory."""
    return points[np.linalg.norm(unit.apply(points), axis=1) <= FAR]


def thickness(points: np.ndarray, neighbors: int = 40) -> float:
    """Return how far a cloud is from a surface: median ratio of the two smaller extents of a neighbourhood.

    0 for planes, about 0.3 for scanned objects, 0.7 for the SfM cloud of a room, 0.8 and more for noise that hides
    the surface.
    """
    _, _, extents = _planes(points, neighbors)
    return float(np.median(extents[:, 0] / np.maximum(extents[:, 1], 1e-12)))


def smoothed(points: np.ndarray, neighbors: int, rounds: int = 2) -> np.ndarray:
    """Move every voxel of a cloud of radius 1 onto the plane of its nearest neighbours, a few times.

    Parameters
    ----------
    points : (N, 3) ndarray
        Cloud of radius about 1.
    neighbors : int
        The noise falls with their root, and so does the detail.

    Returns
    -------
    (M, 3) ndarray
        One point a voxel.
    """
    moved = voxel_means(points, VOXEL)
    for _ in range(rounds):
        means, normals, _ = _planes(moved, neighbors)
        moved = moved - ((moved - means) * normals).sum(1, keepdims=True) * normals
    return moved


def _planes(points: np.ndarray, neighbors: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean (N, 3), normal (N, 3) and extents (N, 3), ascending, of the neighbourhood of every point."""
    _, near = cKDTree(points).query(points, k=min(neighbors, len(points)))
    means, covariances = np.empty_like(points), np.empty((len(points), 3, 3))
    for first in range(0, len(points), 4096):  # all at once would take gigabytes on a large cloud
        chunk = slice(first, first + 4096)
        group = points[near[chunk]]
        means[chunk] = group.mean(1)
        centred = group - means[chunk, None]
        covariances[chunk] = np.einsum('nki,nkj->nij', centred, centred) / near.shape[1]
    variances, axes = np.linalg.eigh(covariances)
    return means, axes[:, :, 0], np.sqrt(np.maximum(variances, 0.0))
