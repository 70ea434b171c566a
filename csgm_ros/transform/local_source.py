"""Hypotheses from local features: triples of keypoints whose FPFH are alike."""

from __future__ import annotations

import numpy as np

from csgm_ros.config import HypothesesConfig
from csgm_ros.transform.correspondences import Correspondences, nearest_both_ways
from csgm_ros.transform.hypotheses import from_triples
from csgm_ros.transform.sources import StructurePair


def propose(pair: StructurePair, config: HypothesesConfig, rng: np.random.Generator) -> np.ndarray:
    """Return the (H, 4, 4) transforms of triples of keypoints that keep the structure."""
    return from_triples(putative(pair, config.correspondences), rng, config, pair.scales, pair.look)


def putative(pair: StructurePair, count: int) -> Correspondences:
    """Return the keypoints of which one is among the ``count`` most alike of the other."""
    if not count:
        return Correspondences(*np.empty((4, 0, 3)))
    source, target = pair.keypoints()
    i, a = nearest_both_ways(source.features, target.features, count, pair.look).T
    return Correspondences(source.points[i], target.points[a], source.normals[i], target.normals[a])
