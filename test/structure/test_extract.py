"""The structure of one cloud: how many nodes, how they are described, what becomes of noise."""

import numpy as np
import pytest
from scenes import ball, room

from csgm_ros import registration
from csgm_ros.attempts import Attempt
from csgm_ros.config import profile, replaced
from csgm_ros.graph.build import build
from csgm_ros.progress import Clock
from csgm_ros.scale import normalizations
from csgm_ros.structure.extract import cut, describe
from csgm_ros.types import NormalizedPair


def extract(cloud, unit, config, rng):
    return describe(cut(unit.apply(cloud), config), unit, config, rng)


@pytest.fixture(scope='module')
def structures():
    clouds = room(1, 600), room(2, 600)
    config = profile()
    units = normalizations(*clouds, config.scale)
    rng = np.random.default_rng(0)
    return [extract(cloud, unit, config, rng) for cloud, unit in zip(clouds, units, strict=True)]


def test_nodes_are_finite_and_edges_lie_between_them(structures):
    for structure in structures:
        graph = build(structure, profile().graph)
        assert np.isfinite(graph.nodes).all()
        assert np.allclose(np.linalg.norm(graph.normals, axis=1), 1.0)
        assert len(graph.node_descriptors) == len(graph.nodes)
        assert graph.edges.max() < len(graph.nodes)
        assert len(graph.edge_descriptors) == len(graph.edges)


def test_the_paper_describes_a_node_by_the_esf_of_its_supervoxel():
    cloud, config = room(1, 600), profile('paper')
    unit = normalizations(cloud, cloud, config.scale)[0]
    graph = build(extract(cloud, unit, config, np.random.default_rng(0)), config.graph)
    assert graph.node_descriptors.shape[1] == 640
    one_way = {tuple(edge) for edge in graph.edges}
    assert not one_way & {(end, start) for start, end in one_way}


def test_no_cloud_has_more_nodes_than_matching_can_take():
    config = replaced(profile(), {'supervoxels.max_nodes': 60})
    rng = np.random.default_rng(5)
    cloud = ball(rng, (0.0, 0.0, 0.0), 1.0, 1500.0)
    units = normalizations(cloud, cloud, config.scale)
    pair = NormalizedPair((cloud, cloud), units)
    sides = registration._structures(pair, Attempt(), config, np.random.default_rng(0), Clock())
    assert all(20 <= len(side.nodes) <= 60 for side in sides)
