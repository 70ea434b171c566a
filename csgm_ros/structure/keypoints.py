"""Local features of the micro structure: keypoints on coarse voxels and their FPFH."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from csgm_ros.cloud.voxels import voxel_means
from csgm_ros.structure.fpfh import fpfh
from csgm_ros.types import PreparedCloud

MOST = 4000  # keypoints, from which their spacing grows: of a surface there are fewer, of a blob or fog many more
SPACING = 0.2  # of the keypoints, in feature radii: finer ones cost more and match no better


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
    """Thin a surface for features of a radius, and describe what is left by the FPFH of its surroundings.

    Each keypoint has the normal of the nearest surface point, turned away from the centroid: FPFH needs a sign, and
    two sensors share no viewpoint.
    """
    from scipy.spatial import cKDTree

    spacing = SPACING * radius
    while len(points := voxel_means(surface.points, spacing)) > MOST:
        spacing *= 1.2
    _, nearest = cKDTree(surface.points).query(points)
    normals = surface.normals[nearest]
    outward = np.where((normals * points).sum(1, keepdims=True) < 0.0, -1.0, 1.0)
    return Keypoints(points, normals, fpfh(points, normals * outward, radius, points))
