"""Local features of the micro structure: keypoints on coarse voxels and their FPFH."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from csgm_ros.cloud.voxels import voxel_means
from csgm_ros.types import PreparedCloud

SPACING = 0.2  # of the keypoints, in feature radii: finer ones cost more and match no better
MAX_NEIGHBORS = 150


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Places of a cloud that can be recognised.

    Attributes
    ----------
    points, normals : (k, 3) ndarray
    features : (k, 33) ndarray
        FPFH.
    """

    points: np.ndarray
    normals: np.ndarray
    features: np.ndarray


def describe_keypoints(surface: PreparedCloud, radius: float) -> Keypoints:
    """Return keypoints of a surface with the features of their surroundings of a radius."""
    chosen = keypoints(surface, radius)
    return Keypoints(chosen.points, chosen.normals, fpfh(chosen, radius))


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
