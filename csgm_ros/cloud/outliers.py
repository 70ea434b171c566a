"""What noise, clutter and stray points do to a cloud, and what can be done about it before the five steps."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from csgm_ros.cloud.voxels import voxel_means, voxelized
from csgm_ros.types import Similarity

VOXEL = 0.02  # of the radius: evens out the density before neighbours are counted
FINE_VOXEL = 0.01  # the same where clutter is sought: in coarser voxels it is as dense as a surface
NEIGHBORS = 10
FAR = 2.0  # radii
MIN_SEPARATION = 0.77  # of clutter from the rest, see _split
THICKNESS_SAMPLES = 2000
MIN_KEPT = 0.1  # of the points: a few in one place do not make all the others clutter
VOLUME = 0.7  # thickness from which clutter fills a volume; that of a noisy surface is below


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
    means, distances, _ = _spacing(points, VOXEL)
    kept = means[distances <= factor * np.median(distances)]
    return kept if len(kept) >= 3 else points


def without_clutter(points: np.ndarray) -> np.ndarray:
    """Return the points without clutter: a second population that is sparser than the first and fills a volume.

    Parameters
    ----------
    points : (N, 3) ndarray
        Finite points.

    Returns
    -------
    (M, 3) ndarray
        All points, where there are not two populations, where the sparser one lies on surfaces too, or where hardly
        anything would be left.
    """
    means, distances, voxel_of = _spacing(points, FINE_VOXEL)
    sparse, separation = _split(np.log(np.maximum(distances, np.finfo(float).tiny)))
    if separation < MIN_SEPARATION or sparse.sum() < NEIGHBORS or thickness(means[sparse]) < VOLUME:
        return points
    kept = ~sparse[voxel_of]
    return points[kept] if kept.mean() >= MIN_KEPT else points


def _spacing(points: np.ndarray, voxel: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Voxel means (V, 3), the distance of each to its 10th neighbour (V,), and the voxel of every point (N,)."""
    distances = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    # not the largest distance: one stray would make the voxels larger than the cloud
    size = voxel * 1.2 * float(np.quantile(distances, 0.98))
    means, voxel_of = voxelized(points, size)
    return means, cKDTree(means).query(means, k=min(NEIGHBORS, len(means)))[0][:, -1], voxel_of


def _split(values: np.ndarray) -> tuple[np.ndarray, float]:
    """Cut values in two by Otsu's method: which are in the upper part, and the share of the variance that explains.

    0.64 for a Gaussian, 0.75 for a uniform distribution, more for two populations.
    """
    ordered = np.sort(values)
    count, total = len(ordered), ordered.sum()
    low = np.arange(1, count)
    between = (ordered.cumsum()[:-1] * count - low * total) ** 2 / (low * (count - low))
    cut = int(np.argmax(between))
    variance = values.var() * count**3
    return values > ordered[cut], float(between[cut] * count / variance) if variance > 0.0 else 0.0


def without_far_strays(points: np.ndarray, unit: Similarity) -> np.ndarray:
    """Return the points within twice the radius that :func:`dense_part` left: what is beyond only costs memory."""
    return points[np.linalg.norm(unit.apply(points), axis=1) <= FAR]


def thickness(points: np.ndarray, neighbors: int = 40) -> float:
    """Return how far a cloud is from a surface: median ratio of the two smaller extents of a neighbourhood.

    0 for planes, about 0.3 for scanned objects, 0.7 for the SfM cloud of a room, 0.8 and more for noise that hides
    the surface.
    """
    _, _, extents = _planes(points, neighbors, points[:: -(-len(points) // THICKNESS_SAMPLES)])
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
        means, normals, _ = _planes(moved, neighbors, moved)
        moved = moved - ((moved - means) * normals).sum(1, keepdims=True) * normals
    return moved


def _planes(points: np.ndarray, neighbors: int, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean (P, 3), normal (P, 3) and extents (P, 3), ascending, of the points around each of (P, 3) places."""
    _, near = cKDTree(points).query(places, k=min(neighbors, len(points)))
    means, covariances = np.empty_like(places), np.empty((len(places), 3, 3))
    for first in range(0, len(places), 4096):  # all at once would take gigabytes on a large cloud
        chunk = slice(first, first + 4096)
        group = points[near[chunk]]
        means[chunk] = group.mean(1)
        centred = group - means[chunk, None]
        covariances[chunk] = np.einsum('nki,nkj->nij', centred, centred) / near.shape[1]
    variances, axes = np.linalg.eigh(covariances)
    return means, axes[:, :, 0], np.sqrt(np.maximum(variances, 0.0))
