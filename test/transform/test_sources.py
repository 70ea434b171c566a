"""Sources of hypotheses: what they are given, and that the truth is among what they propose."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import error, room

from csgm_ros.config import HYPOTHESIS_SOURCES, profile
from csgm_ros.graph.affinity import affinity
from csgm_ros.scale import normalizations
from csgm_ros.structure.extract import cut, describe
from csgm_ros.structure.keypoints import describe_keypoints
from csgm_ros.transform import graph_source, local_source
from csgm_ros.transform.ladder import Ladder
from csgm_ros.transform.sources import StructurePair, propose
from csgm_ros.types import Prior, Similarity

CONFIG = profile()


@pytest.fixture(scope='module')
def pair():
    """Two samplings of one room in one frame: the truth is the identity, but for the normalisation."""
    clouds = room(1, 600), room(2, 600)
    unit = normalizations(*clouds, CONFIG.scale)[0]
    rng = np.random.default_rng(0)
    source, target = (describe(cut(unit.apply(cloud), CONFIG), unit, CONFIG, rng) for cloud in clouds)
    node_affinity = affinity(source.descriptors, target.descriptors, 'gaussian', CONFIG.graph.node_sigma)
    found = [describe_keypoints(side.surface, CONFIG.hypotheses.feature_radius) for side in (source, target)]
    return StructurePair(
        source,
        target,
        np.empty((0, 2), int),
        node_affinity,
        (0.5, 2.0),
        lambda: tuple(found),
        Ladder(*map(unit.apply, clouds), 0),
        (0.5, 2.0),
        lambda: np.empty((0, 4, 4)),
        Prior(Similarity(1.1, np.eye(3), np.array((0.1, 0.1, 0.0))), (0.1, 5.0, 0.1)),
    )


@pytest.mark.parametrize('source', [graph_source, local_source])
def test_enough_putative_correspondences_are_right(pair, source):
    found = source.putative(pair, CONFIG.hypotheses.correspondences)
    distance = np.linalg.norm(found.source - found.target, axis=1)
    assert (distance < 0.1).mean() > 0.05  # chance gives below 2 %


@pytest.mark.parametrize('name', HYPOTHESIS_SOURCES)
def test_the_truth_is_among_the_hypotheses_of_every_source(pair, name):
    given = replace(pair, wide_scales=(1.0, 1.0)) if name == 'volumes' else pair
    proposed = propose(name, given, CONFIG.hypotheses, np.random.default_rng(0))
    assert proposed.shape[1:] == (4, 4)
    probe = pair.source.surface.points[::20]
    errors = [error(Similarity.from_matrix(matrix), Similarity.identity(), probe) for matrix in proposed]
    assert min(errors) < 0.1


def test_matched_nodes_are_putative_correspondences(pair):
    match = np.array([[0, len(pair.target.nodes) - 1]])
    with_match = replace(pair, matches=match)
    found = graph_source.putative(with_match, 1)
    both = np.column_stack([found.source, found.target])
    assert (both == np.concatenate([pair.source.nodes[0], pair.target.nodes[-1]])).all(1).any()


def test_without_putative_correspondences_only_the_matched_nodes_are_left(pair):
    match = np.array([[0, len(pair.target.nodes) - 1]])
    found = graph_source.putative(replace(pair, matches=match), 0)
    assert np.array_equal(found.source, pair.source.nodes[:1])
    assert np.array_equal(found.target, pair.target.nodes[-1:])
    assert len(local_source.putative(pair, 0).source) == 0
    none = replace(CONFIG.hypotheses, correspondences=0)
    assert propose('local', pair, none, np.random.default_rng(0)).shape == (0, 4, 4)
