"""Which nodes and features of two clouds may belong together: graph matching, and next-best partners."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from csgm_ros.config import Config, HypothesesConfig
from csgm_ros.graph.affinity import affinity
from csgm_ros.matching.match import match_graphs
from csgm_ros.progress import Clock
from csgm_ros.structure import keypoints as local_features
from csgm_ros.structure.extract import Structure
from csgm_ros.transform.hypotheses import Correspondences


class GraphMatch(NamedTuple):
    """What graph matching says of two structures.

    Attributes
    ----------
    pairs : (k, 2) int ndarray
        Matched nodes (source, target): the non-zeros of X.
    node_affinity : (n1, n2) ndarray
        K_p, Eq. (2).
    """

    pairs: np.ndarray
    node_affinity: np.ndarray


def match(source: Structure, target: Structure, config: Config, clock: Clock) -> GraphMatch:
    """Match the graphs of two structures: affinities (step 3) and factorised graph matching (step 4)."""
    part, first, second = config.graph, source.graph, target.graph
    node_affinity = affinity(first.node_descriptors, second.node_descriptors, part.similarity, part.node_sigma)
    edge_affinity = affinity(first.edge_descriptors, second.edge_descriptors, part.similarity, part.edge_sigma)
    matching = match_graphs(
        node_affinity,
        edge_affinity,
        first.edges,
        second.edges,
        config=config.matching,
        positions_1=first.nodes,
        positions_2=second.nodes,
        # asked between the values of alpha: a place for the caller to cancel, not for the time budget to bite
        is_cancelled=lambda: clock.tick() and False,
    )
    return GraphMatch(matching.pairs, node_affinity)


def of_nodes(source: Structure, target: Structure, found: GraphMatch, count: int) -> Correspondences:
    """Return the matched nodes and, for each node of either graph, its ``count`` most similar ones."""
    forth = _most_similar(found.node_affinity, count)
    back = _most_similar(found.node_affinity.T, count)[:, ::-1]
    i, a = np.unique(np.concatenate([found.pairs, forth, back]), axis=0).T
    first, second = source.graph, target.graph
    return Correspondences(first.nodes[i], second.nodes[a], first.normals[i], second.normals[a])


def of_features(source: Structure, target: Structure, config: HypothesesConfig) -> Correspondences:
    """Return the keypoints whose local features are among the nearest of each other."""
    sides = source, target
    keypoints = [local_features.keypoints(side.surface, config.feature_radius * side.unit) for side in sides]
    features = [
        local_features.fpfh(points, config.feature_radius * side.unit)
        for points, side in zip(keypoints, sides, strict=True)
    ]
    i, a = local_features.nearest_both_ways(*features, config.partners).T
    first, second = keypoints
    return Correspondences(first.points[i], second.points[a], first.normals[i], second.normals[a])


def _most_similar(affinities: np.ndarray, count: int) -> np.ndarray:
    count = min(count, affinities.shape[1])
    best = np.argsort(-affinities, axis=1, kind='stable')[:, :count]
    return np.column_stack([np.repeat(np.arange(len(affinities)), count), best.ravel()])
