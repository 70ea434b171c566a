"""Step 3, graph construction: nodes, directed edges and what describes them (Sec. III-C)."""

from __future__ import annotations

import numpy as np

from csgm_ros.config import GraphConfig
from csgm_ros.types import Structure, StructureGraph


def build(structure: Structure, config: GraphConfig) -> StructureGraph:
    """Join the nodes P of a structure by directed edges Q.

    Parameters
    ----------
    structure : Structure
        Supervoxels and their descriptors.
    config : GraphConfig
        Which nodes are joined, and what describes an edge.
    """
    edges = structure.adjacency if config.edges == 'adjacency' else neighbor_edges(structure.nodes, config.neighbors)
    describe = {'euler': euler_descriptors, 'invariant': invariant_descriptors}[config.edge_descriptor]
    described = describe(structure.nodes, structure.normals, edges)
    return StructureGraph(structure.nodes, structure.normals, structure.descriptors, edges, described)


def neighbor_edges(nodes: np.ndarray, count: int) -> np.ndarray:
    """Return directed edges (m, 2) from every node to its nearest ``count`` nodes and back.

    Notes
    -----
    The paper takes the adjacency of the supervoxels once each, "without flowing back". Which of the two
    directions is kept then depends on the segmentation, so a right pair of edges can run in opposite directions
    in the two clouds, and gaps of the sensor cut the adjacency. Nearest nodes bridge gaps, and with both
    directions no choice is left to chance.
    """
    from scipy.spatial import cKDTree

    count = min(count, len(nodes) - 1)
    if count < 1:
        return np.empty((0, 2), np.int32)
    _, nearest = cKDTree(nodes).query(nodes, k=count + 1)
    starts = np.repeat(np.arange(len(nodes)), count + 1)
    ends = nearest.ravel()
    forth = np.column_stack([starts, ends])[starts != ends]
    return np.unique(np.concatenate([forth, forth[:, ::-1]]), axis=0).astype(np.int32)


def euler_descriptors(nodes: np.ndarray, normals: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the paper's (m, 4) edge descriptor: three angles to the axes in radians, and the length.

    The angles depend on the orientation of the cloud (``normals`` are not used); see
    :func:`invariant_descriptors` for the default.
    """
    vectors = nodes[edges[:, 1]] - nodes[edges[:, 0]]
    lengths = np.linalg.norm(vectors, axis=1)
    safe = np.maximum(lengths, 1e-12)
    z_angle = np.arccos(np.clip(vectors[:, 2] / safe, -1.0, 1.0))
    # an edge along z has no direction in the xy plane: the quotient's limit is unbounded, so it is clipped
    across = np.maximum(safe * np.sin(z_angle), 1e-12)
    x_angle = np.arccos(np.clip(vectors[:, 0] / across, -1.0, 1.0))
    y_angle = np.arccos(np.clip(vectors[:, 1] / across, -1.0, 1.0))
    return np.column_stack([x_angle, y_angle, z_angle, lengths])


def invariant_descriptors(nodes: np.ndarray, normals: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return a (m, 4) edge descriptor that no rotation changes: two angles with the normals, one between, log length.

    Notes
    -----
    The paper measures angles to the absolute x, y and z axes; two clouds in arbitrary pose share none. Here the
    edge is measured against the normals of its own two nodes. Normals have no sign, so every angle lies in
    [0, pi/2]. The logarithm of the length turns an error of the scale into a constant offset.
    """
    start, end = edges[:, 0], edges[:, 1]
    vectors = nodes[end] - nodes[start]
    lengths = np.maximum(np.linalg.norm(vectors, axis=1), 1e-12)
    directions = vectors / lengths[:, None]

    def angle(first, second):
        return np.arccos(np.clip(np.abs((first * second).sum(1)), 0.0, 1.0))

    return np.column_stack(
        [
            angle(directions, normals[start]),
            angle(directions, normals[end]),
            angle(normals[start], normals[end]),
            np.log(lengths),
        ]
    )
