"""Local features of the micro structure: FPFH per voxel, and the partners they suggest."""

from __future__ import annotations

import numpy as np

from csgm_ros.types import PreparedCloud

MAX_NEIGHBORS = 100


def fpfh(cloud: PreparedCloud, radius: float) -> np.ndarray:
    """Return the FPFH of every point, (N, 33).

    Normals are turned away from the centroid first: FPFH needs a sign, and two sensors share no viewpoint.
    """
    import open3d

    outward = np.sign((cloud.normals * cloud.points).sum(1, keepdims=True))
    handle = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud.points))
    handle.normals = open3d.utility.Vector3dVector(cloud.normals * np.where(outward == 0.0, 1.0, outward))
    search = open3d.geometry.KDTreeSearchParamHybrid(radius, MAX_NEIGHBORS)
    return np.asarray(open3d.pipelines.registration.compute_fpfh_feature(handle, search).data).T


def partners(source_features: np.ndarray, target_features: np.ndarray, count: int) -> np.ndarray:
    """Return for each source feature its ``count`` nearest target features, (k, 2) index pairs."""
    from scipy.spatial import cKDTree

    count = min(count, len(target_features))
    _, nearest = cKDTree(target_features).query(source_features, k=count)
    rows = np.repeat(np.arange(len(source_features)), count)
    return np.column_stack([rows, np.reshape(nearest, -1)])


def partners_both_ways(source_features: np.ndarray, target_features: np.ndarray, count: int) -> np.ndarray:
    """Return the pairs in which one feature is among the ``count`` nearest of the other, (k, 2) index pairs."""
    forth = partners(source_features, target_features, count)
    back = partners(target_features, source_features, count)
    return np.unique(np.concatenate([forth, back[:, ::-1]]), axis=0)
