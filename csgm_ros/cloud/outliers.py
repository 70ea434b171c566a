"""Points that belong to no surface: which they are, and the cloud without them."""

from __future__ import annotations

import numpy as np

from csgm_ros.cloud.kernels import kernel
from csgm_ros.cloud.surface_variation import surface_variation
from csgm_ros.cloud.voxels import voxelized
from csgm_ros.types import Similarity

VOXEL = 0.02  # of the radius: evens out the density before neighbours are counted
FINE_VOXEL = 0.01  # the same where uniform outliers are sought: in coarser voxels they are as dense as a surface
NEIGHBORS = 10
FAR = 2.0  # radii
MOST, EXTREME = 0.8, 30.0  # share of the points, and how many times as far as it is too far
MIN_SEPARATION = 0.77  # of uniform outliers from the rest, see _split
MIN_KEPT = 0.1  # of the points: a few in one place do not make outliers of all the others
VOLUME = 0.7  # surface variation from which points fill a volume; that of a noisy surface is below


def without_extremes(points: np.ndarray) -> np.ndarray:
    """Return the points that are not absurdly far from most: one at 1e9 leaves no voxel of a usable size."""
    distances = distances_from(np.median(points, axis=0), points)
    return points[distances <= EXTREME * np.quantile(distances, MOST)]


def without_isolated(points: np.ndarray, factor: float) -> np.ndarray:
    """Return the voxels that are not isolated: whose 10th neighbour is at most ``factor`` medians away.

    Parameters
    ----------
    points : (N, 3) ndarray
        Finite points.
    factor : float
        0 returns the points as they are.

    Returns
    -------
    (M, 3) ndarray
        Voxel means. One outlier far away changes the radius of Eq. (1), and with it every length; on real SfM
        clouds leaving outliers out brings Eq. (1) from 0.63-1.12 of the true scale to 0.82-1.27.
    """
    if factor <= 0.0:
        return points
    means, distances, _ = _spacing(points, VOXEL)
    kept = means[distances <= factor * np.median(distances)]
    return kept if len(kept) >= 3 else points


def without_uniform_outliers(points: np.ndarray) -> np.ndarray:
    """Return the points without uniform outliers: a second population, sparser than the first, that fills a volume.

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
    if separation < MIN_SEPARATION or sparse.sum() < NEIGHBORS or surface_variation(means[sparse]) < VOLUME:
        return points
    kept = ~sparse[voxel_of]
    return points[kept] if kept.mean() >= MIN_KEPT else points


def _spacing(points: np.ndarray, voxel: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Voxel means (V, 3), the distance of each to its 10th neighbour (V,), and the voxel of every point (N,)."""
    from scipy.spatial import cKDTree

    distances = distances_from(np.median(points, axis=0), points)
    # not the largest distance: one outlier would make the voxels larger than the cloud
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


def without_far(points: np.ndarray, unit: Similarity) -> np.ndarray:
    """Return the points within twice the radius that :func:`without_isolated` left: what is beyond costs memory."""
    return points[distances_from(unit.inverse().translation, points) <= FAR / unit.scale]


@kernel
def distances_from(place, points):
    """Return the distance of each of (N, 3) points from a place; numpy takes ten times as long on rows of three."""
    distances = np.empty(len(points))
    for i in range(len(points)):
        x, y, z = points[i, 0] - place[0], points[i, 1] - place[1], points[i, 2] - place[2]
        distances[i] = np.sqrt(x * x + y * y + z * z)
    return distances
