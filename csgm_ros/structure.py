"""Steps 1 and 2 for one cloud: supervoxels and what describes them (Sec. III-B)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from csgm_ros import local_features
from csgm_ros.config import Config
from csgm_ros.supervoxels import segment
from csgm_ros.types import PreparedCloud, Similarity, Supervoxels


class Nodes(NamedTuple):
    points: np.ndarray
    normals: np.ndarray


@dataclass(frozen=True, eq=False)
class Structure:
    """A cloud's surface (voxels) and its supervoxels, in the normalised frame."""

    surface: PreparedCloud
    supervoxels: Supervoxels
    config: Config

    @property
    def nodes(self) -> Nodes:
        return Nodes(self.supervoxels.centroids, self.supervoxels.normals)

    def described(self, relative: float) -> np.ndarray:
        part = self.config
        radius = part.descriptors.context_radius * part.supervoxels.seed_size * relative
        features = local_features.fpfh(self.surface, radius)
        _, near = cKDTree(self.surface.points).query(self.supervoxels.centroids, k=min(5, len(features)))
        return features[near].mean(1)


def extract(points: np.ndarray, normalization: Similarity, config: Config) -> Structure:
    """Cut a cloud into supervoxels in its normalised frame."""
    part = config.supervoxels
    cut = segment(
        normalization.apply(points),
        part.voxel_size,
        part.seed_size,
        spatial_weight=part.spatial_weight,
        normal_weight=part.normal_weight,
        refinements=part.refinements,
    )
    normals = np.where(np.isfinite(cut.voxel_normals), cut.voxel_normals, 0.0)
    return Structure(PreparedCloud(cut.voxel_points, normals, normalization), cut, config)
