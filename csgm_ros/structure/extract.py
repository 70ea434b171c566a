"""Steps 2 and 3 for one cloud: its surface, its supervoxels, their graph and what describes them (Sec. III-B, C)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from csgm_ros.config import Config
from csgm_ros.errors import DegenerateCloudError
from csgm_ros.graph import build as graph
from csgm_ros.structure import descriptors
from csgm_ros.structure.supervoxels import segment
from csgm_ros.types import PreparedCloud, Similarity, StructureGraph, Supervoxels

ESF_UNIT, FPFH_UNIT = 0.1, 50.0  # bring both to one scale; FPFH tells nodes apart better and gets twice the weight


@dataclass(frozen=True, eq=False)
class Structure:
    """Macro and micro structure of one cloud in its normalised frame.

    Attributes
    ----------
    surface : PreparedCloud
        The voxels that the supervoxels were grown from.
    graph : StructureGraph
        Supervoxels as nodes, their neighbourhood as edges.
    unit : float
        Length to which the configured ones are relative, here.
    """

    surface: PreparedCloud
    graph: StructureGraph
    unit: float


def cut(points: np.ndarray, normalization: Similarity, config: Config, relative: float = 1.0) -> Supervoxels:
    """Cut a cloud into supervoxels, the quick half of its structure.

    Parameters
    ----------
    points : (N, 3) ndarray
        Finite points in the cloud's own unit.
    normalization : Similarity
        Own unit to radius 1.
    relative : float, optional
        Factor on every length, for clouds between which Eq. (1) is far off.
    """
    part = config.supervoxels
    return segment(
        normalization.apply(points),
        part.voxel_size * relative,
        part.seed_size * relative,
        spatial_weight=part.spatial_weight,
        normal_weight=part.normal_weight,
        refinements=part.refinements,
    )


def describe(
    cut: Supervoxels, normalization: Similarity, config: Config, rng: np.random.Generator, relative: float = 1.0
) -> Structure:
    """Describe supervoxels and make them a graph; parameters as of :func:`cut`, ``rng`` draws the samples of ESF."""
    # a voxel without a plane around it has no normal: zero agrees with nothing
    normals = np.where(np.isfinite(cut.voxel_normals), cut.voxel_normals, 0.0)
    surface = PreparedCloud(cut.voxel_points, normals, normalization)
    described = _describe(cut, surface, config, rng, relative)
    return Structure(surface, _graph(cut, described, config), relative)


def _describe(cut: Supervoxels, surface: PreparedCloud, config: Config, rng: np.random.Generator, relative: float):
    """Describe each node by the ESF of its supervoxel, or by ESF and FPFH of its surroundings.

    The paper takes the ESF of the bare supervoxel, which is at chance: the cut differs between two clouds, and so
    does what one supervoxel holds. Its surroundings stay.
    """
    part = config.descriptors
    if part.kind == 'esf':
        starts, members = descriptors.members_of(cut.voxel_labels, len(cut))
        return descriptors.esf_of_groups(cut.voxel_points, starts, members, rng, part.esf_samples, config.threads)
    radius = part.context_radius * config.supervoxels.seed_size * relative
    esf, fpfh = descriptors.context(
        surface.points, surface.normals, cut.centroids, radius, rng, part.esf_samples, config.threads
    )
    return np.column_stack([esf / ESF_UNIT, fpfh / FPFH_UNIT])


def _graph(cut: Supervoxels, described: np.ndarray, config: Config) -> StructureGraph:
    # a supervoxel so thin that it has no normal is noise, and no node
    kept = np.isfinite(cut.normals).all(1)
    if kept.sum() < 3:
        raise DegenerateCloudError(
            f'only {kept.sum()} supervoxels: the cloud is too noisy or too sparse for its size, or '
            f'supervoxels.seed_size ({config.supervoxels.seed_size} of the radius) is too large'
        )
    nodes, part = cut.centroids[kept], config.graph
    if part.edges == 'adjacency':
        edges = (np.cumsum(kept) - 1)[cut.adjacency[kept[cut.adjacency].all(1)]]
    else:
        edges = graph.neighbor_edges(nodes, part.neighbors)
    return graph.build_graph(nodes, cut.normals[kept], described[kept], edges.astype(np.int32), part.edge_descriptor)
