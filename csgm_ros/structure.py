"""Step 2 for one cloud: its surface, its supervoxels and what describes them (Sec. III-B)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from csgm_ros import local_features
from csgm_ros.config import Config
from csgm_ros.supervoxels import segment
from csgm_ros.types import PreparedCloud, Similarity, Supervoxels

FEATURES_PER_NODE = 3  # the features nearest to a node that are averaged to describe it


@dataclass(frozen=True, eq=False)
class Structure:
    """Macro and micro structure of one cloud in its normalised frame.

    Attributes
    ----------
    surface : PreparedCloud
        The voxels that the supervoxels were grown from.
    supervoxels : Supervoxels
        Macro structure.
    keypoints : PreparedCloud
        Coarser voxels that carry local features.
    features : (k, 33) ndarray
        FPFH of the keypoints.
    """

    surface: PreparedCloud
    supervoxels: Supervoxels
    keypoints: PreparedCloud
    features: np.ndarray

    @property
    def node_features(self) -> np.ndarray:
        """(n, 33) FPFH of the surroundings of every supervoxel."""
        count = min(FEATURES_PER_NODE, len(self.features))
        _, near = cKDTree(self.keypoints.points).query(self.supervoxels.centroids, k=count)
        return self.features[near.reshape(len(near), count)].mean(1)


def extract(points: np.ndarray, normalization: Similarity, config: Config, relative: float = 1.0) -> Structure:
    """Extract the structure of a cloud.

    Parameters
    ----------
    points : (N, 3) ndarray
        Finite points in the cloud's own unit.
    normalization : Similarity
        Own unit to radius 1.
    relative : float, optional
        Factor on every length: what the other cloud's radius measures in this one's when Eq. (1) is wrong.
    """
    part = config.supervoxels
    cut = segment(
        normalization.apply(points),
        part.voxel_size,
        part.seed_size,
        spatial_weight=part.spatial_weight,
        normal_weight=part.normal_weight,
        refinements=part.refinements,
    )
    # a voxel without a plane around it has no normal: zero agrees with nothing
    normals = np.where(np.isfinite(cut.voxel_normals), cut.voxel_normals, 0.0)
    surface = PreparedCloud(cut.voxel_points, normals, normalization)
    radius = config.hypotheses.feature_radius * relative
    keypoints = local_features.keypoints(surface, radius * local_features.SPACING)
    return Structure(surface, cut, keypoints, local_features.fpfh(keypoints, radius))
