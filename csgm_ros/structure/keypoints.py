"""Local features of the micro structure: FPFH on coarse voxels, and the partners that they suggest."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from csgm_ros.cloud.voxels import voxel_means
from csgm_ros.types import PreparedCloud

SPACING = 0.2  # of the keypoints, in feature radii: finer ones cost more and match no better
MAX_NEIGHBORS = 150


def keypoints(surface: PreparedCloud, radius: float) -> PreparedCloud:
    """Thin a surface for features of a radius; each point has the normal of the nearest surface point."""
    points = voxel_means(surface.points, SPACING * radius)
    _, nearest = cKDTree(surface.points).query(points)
    return PreparedCloud(points, surface.normals[nearest], surface.normalization)


def fpfh(cloud: PreparedCloud, radius: float) -> np.ndarray:
    """Return the FPFH of every point, (N, 33).

    Normals are turned away from the centroid first: FPFH needs a sign, and two sensors share no viewpoint.
    """
    import open3d

    outward = np.sign((cloud.normals * cloud.points).sum(1, keepdims=True))
    handle = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud.points))
    handle.normals = open3d.utility.Vector3dVector(cloud.normals * np.where(outward == 0.0, 1.0, outward))
    search = open3d.geometry.KDTreeSearchParamHybrid(radius, MAX_NEIGHBORS)
    return np.asarray(open3d.pipelines.registration.compute_fpfh_feature(handle, search).data).T.copy()


def nearest_both_ways(source: np.ndarray, target: np.ndarray, count: int) -> np.ndarray:
    """Return the pairs in which one feature is among the ``count`` nearest of the other, (k, 2) index pairs."""
    forth = _nearest(source, target, count)
    back = _nearest(target, source, count)
    return np.unique(np.concatenate([forth, back[:, ::-1]]), axis=0)


def _nearest(features: np.ndarray, others: np.ndarray, count: int) -> np.ndarray:
    count = min(count, len(others))
    _, nearest = cKDTree(others).query(features, k=count)
    return np.column_stack([np.repeat(np.arange(len(features)), count), np.reshape(nearest, -1)])
