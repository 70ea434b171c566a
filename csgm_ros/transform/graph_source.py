"""Hypotheses from the structure graph: triples of matched nodes and of their next-best correspondences."""

from __future__ import annotations

import numpy as np

from csgm_ros.config import HypothesesConfig
from csgm_ros.transform.correspondences import Correspondences, most_similar
from csgm_ros.transform.hypotheses import from_triples
from csgm_ros.transform.sources import StructurePair


def propose(pair: StructurePair, config: HypothesesConfig, rng: np.random.Generator) -> np.ndarray:
    """Return the (H, 4, 4) transforms of triples of nodes that keep the structure."""
    return from_triples(putative(pair, config.correspondences), rng, config, pair.scales, pair.look)


def putative(pair: StructurePair, count: int) -> Correspondences:
    """Return the matched nodes and, for each node of either graph, its ``count`` most similar ones.

    The paper trusts the matched nodes alone (Sec. III-E), of which one in five is right; with the support of others
    (:mod:`csgm_ros.graph.support`) two in three are, and fewer are matched.
    """
    forth = most_similar(pair.node_affinity, count)
    back = most_similar(pair.node_affinity.T, count)[:, ::-1]
    i, a = np.unique(np.concatenate([pair.matches, forth, back]), axis=0).T
    source, target = pair.source, pair.target
    return Correspondences(source.nodes[i], target.nodes[a], source.normals[i], target.normals[a])
