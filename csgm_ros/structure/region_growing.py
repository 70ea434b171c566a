"""The flow that grows seed voxels into supervoxels (VCCS), ring by ring."""

from __future__ import annotations

import numpy as np

from csgm_ros.cloud.kernels import kernel
from csgm_ros.cloud.normals import axes_of
from csgm_ros.cloud.voxels import VoxelGrid

# Rings of voxels that the flow may grow, in seed spacings.
REACH = 1.8


def flow(
    grid: VoxelGrid,
    axes: np.ndarray,
    seeds: np.ndarray,
    start: tuple[np.ndarray, np.ndarray],
    spacing: float,
    weights: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Grow (n,) seed voxels into supervoxels.

    Parameters
    ----------
    grid : VoxelGrid
        The occupied voxels.
    axes : (v, 3) ndarray
        Their unsigned unit normals, zeros where undefined.
    seeds : (n,) int ndarray
        Distinct voxels.
    start : (n, 3), (n, 3) ndarray
        Positions and axes that stand for the supervoxels in the first ring.
    spacing : float
        Seed spacing in voxels.
    weights : (float, float)
        Of the angle, and of the distance in voxels.

    Returns
    -------
    labels : (v,) int32 ndarray
        Supervoxel of each voxel, -1 for none.
    centers, center_axes : (n, 3) ndarray
        Mean position in voxels, and mean unsigned normal.
    """
    labels = np.full(len(grid.keys), -1, np.int32)
    labels[seeds] = np.arange(len(seeds))
    least = np.full(len(grid.keys), np.inf)
    least[seeds] = 0  # no D is smaller: they stay
    centers, center_axes = start
    for _ in range(max(1, int(REACH * spacing) - 1)):
        grown = _ring(labels, least, grid.centroids, axes, grid.starts, grid.neighbors, centers, center_axes, *weights)
        centers, center_axes = _means(grid.centroids, axes, grown, len(seeds))
        if np.array_equal(grown, labels):
            break
        labels = grown
    return labels, centers, center_axes


@kernel
def _ring(labels, least, centroids, axes, starts, neighbors, centers, center_axes, normal_weight, spatial_weight):
    """Return the labels after every supervoxel took what it touches; lower ``least``, the voxels' D when taken."""
    grown = labels.copy()
    for v in range(len(labels)):
        for e in range(starts[v], starts[v + 1]):
            label = labels[neighbors[e]]
            if label < 0 or label in (labels[v], grown[v]):
                continue
            cosine = distance = 0.0
            for k in range(3):
                cosine += axes[v, k] * center_axes[label, k]
                distance += (centroids[v, k] - centers[label, k]) ** 2
            cost = normal_weight * (1 - abs(cosine)) + spatial_weight * np.sqrt(distance)
            if cost < least[v]:
                grown[v], least[v] = label, cost
    return grown


def _means(centroids, axes, labels, count):
    """Return the mean position and the mean unsigned normal of each supervoxel."""
    sums, moments = _sums(centroids, axes, labels, count)
    return sums[:, :3] / sums[:, 3:], axes_of(moments, True)


@kernel
def _sums(centroids, axes, labels, count):
    """Return each supervoxel's sum of positions with its number of voxels, and sum of n n^T (upper half)."""
    sums, moments = np.zeros((count, 4)), np.zeros((count, 6))
    for v in range(len(labels)):
        label = labels[v]
        if label < 0:
            continue
        x, y, z = axes[v]
        for k in range(3):
            sums[label, k] += centroids[v, k]
        sums[label, 3] += 1
        moments[label, 0] += x * x
        moments[label, 1] += x * y
        moments[label, 2] += x * z
        moments[label, 3] += y * y
        moments[label, 4] += y * z
        moments[label, 5] += z * z
    return sums, moments


@kernel
def nearest_to_centers(centroids, labels, centers):
    """Return the voxel of each supervoxel that is nearest to its centre."""
    nearest, least = np.full(len(centers), -1), np.full(len(centers), np.inf)
    for v in range(len(labels)):
        label = labels[v]
        if label < 0:
            continue
        squared = 0.0
        for k in range(3):
            squared += (centroids[v, k] - centers[label, k]) ** 2
        if squared < least[label]:
            nearest[label], least[label] = v, squared
    return nearest
