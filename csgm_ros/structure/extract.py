"""Step 2 for one cloud: its supervoxels and what describes them (Sec. III-B)."""

from __future__ import annotations

import numpy as np

from csgm_ros.config import DESCRIPTORS, Config
from csgm_ros.errors import DegenerateCloudError
from csgm_ros.schema import implementation
from csgm_ros.structure.supervoxels import segment
from csgm_ros.types import PreparedCloud, Similarity, Structure, Supervoxels


def cut(points: np.ndarray, config: Config, relative: float = 1.0) -> Supervoxels:
    """Cut a cloud into supervoxels, the quick half of its structure.

    Parameters
    ----------
    points : (N, 3) ndarray
        Finite points in the normalised frame.
    relative : float, optional
        Factor on every length, for clouds between which Eq. (1) is far off.
    """
    part = config.supervoxels
    return segment(
        points,
        part.voxel_size * relative,
        part.seed_size * relative,
        spatial_weight=part.spatial_weight,
        normal_weight=part.normal_weight,
        refinements=part.refinements,
    )


def describe(
    supervoxels: Supervoxels, normalization: Similarity, config: Config, rng: np.random.Generator, relative: float = 1.0
) -> Structure:
    """Describe supervoxels; parameters as of :func:`cut`, ``rng`` draws the samples of ESF.

    ``normalization``, from the cloud's own unit to the normalised frame, is kept for those who need the way back.

    Raises
    ------
    DegenerateCloudError
        When fewer than three supervoxels have a normal.
    """
    # a voxel without a plane around it has no normal: zero agrees with nothing
    normals = np.where(np.isfinite(supervoxels.voxel_normals), supervoxels.voxel_normals, 0.0)
    surface = PreparedCloud(supervoxels.voxel_points, normals)
    described = implementation(DESCRIPTORS[config.descriptors.kind])(supervoxels, surface, config, rng, relative)
    # a supervoxel so thin that it has no normal is noise, and no node
    kept = np.isfinite(supervoxels.normals).all(1)
    if kept.sum() < 3:
        raise DegenerateCloudError(
            f'only {kept.sum()} supervoxels: the cloud is too noisy or too sparse for its size, or '
            f'supervoxels.seed_size ({config.supervoxels.seed_size} of the radius) is too large'
        )
    adjacency = (np.cumsum(kept) - 1)[supervoxels.adjacency[kept[supervoxels.adjacency].all(1)]]
    nodes, node_normals = supervoxels.centroids[kept], supervoxels.normals[kept]
    return Structure(
        surface,
        supervoxels.voxel_labels,
        nodes,
        node_normals,
        described[kept],
        adjacency.astype(np.int32),
        relative,
        normalization,
    )
