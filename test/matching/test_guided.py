"""Matching under a known transform: what is one place is paired, whatever the descriptors say of it."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from csgm_ros.matching import match_graphs
from csgm_ros.matching.guided import WIDTHS, match_guided
from csgm_ros.types import MatchedGraphs, Matching, StructureGraph

WIDTH = 0.1


def graph(nodes, near):
    edges = cKDTree(nodes).query_pairs(near, output_type='ndarray') if len(nodes) else np.empty((0, 2), int)
    nothing = np.empty((0, 0))
    return StructureGraph(nodes, np.zeros_like(nodes), nothing, np.concatenate([edges, edges[:, ::-1]]), nothing)


def matched(source, target, node, edge=None):
    """Graphs whose affinities are given; what was matched without the transform is not looked at."""
    edge = np.ones((len(source.edges), len(target.edges))) if edge is None else edge
    return MatchedGraphs(source, target, node, edge, Matching(np.zeros(node.shape, np.uint8), 0.0, 0))


def gaps(source, target):
    return np.linalg.norm(source.nodes[:, None] - target.nodes, axis=2)


def planted(rng, count=40, extra=10, noise=0.02):
    """A graph, and the same renumbered, with noise and nodes of its own; affinities that tell nothing."""
    places = rng.random((count, 3))
    truth = rng.permutation(count + extra)[:count]
    others = rng.random((count + extra, 3)) + np.array([0.0, 0.0, 2.0])
    others[truth] = places + rng.normal(0, noise, places.shape)
    pair = graph(places, 0.3), graph(others, 0.3)
    return matched(*pair, rng.random((count, count + extra))), truth


def test_places_are_paired_though_the_descriptors_tell_nothing():
    right = []
    for seed in range(10):
        graphs, truth = planted(np.random.default_rng(seed))
        found = match_guided(graphs, gaps(graphs.source, graphs.target), WIDTH)
        right += (truth[found[:, 0]] == found[:, 1]).tolist()
        assert len(found) > 30
    assert np.mean(right) > 0.85


def test_only_the_right_transform_makes_matches_agree():
    turn = Rotation.from_euler('xyz', (40, 70, 20), degrees=True).as_matrix()
    shares = []
    for seed in range(5):
        graphs, _ = planted(np.random.default_rng(seed))
        right = gaps(graphs.source, graphs.target)
        middle = graphs.source.nodes.mean(axis=0)
        wrong = cdist((graphs.source.nodes - middle) @ turn.T + middle, graphs.target.nodes)
        edge = graphs.edge_affinity
        unguided = match_graphs(graphs.node_affinity, edge, graphs.source.edges, graphs.target.edges).pairs
        shown, turned = match_guided(graphs, right, WIDTH), match_guided(graphs, wrong, WIDTH)
        agree = [(right[tuple(found.T)] < WIDTH).mean() for found in (shown, unguided)]
        shares.append([*agree, (wrong[tuple(turned.T)] < WIDTH).sum() / len(shown)])
    guided, unguided, turned = np.mean(shares, axis=0)
    assert guided > 0.9
    assert unguided < 0.5
    assert turned < 0.5


@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.integers(1, 12))
@settings(max_examples=40, deadline=None)
def test_pairs_are_one_to_one_and_near(seed, n1, n2):
    rng = np.random.default_rng(seed)
    source, target = (graph(rng.random((n, 3)), 0.5) for n in (n1, n2))
    apart = gaps(source, target)
    edge = rng.random((len(source.edges), len(target.edges)))
    found = match_guided(matched(source, target, rng.random((n1, n2)), edge), apart, WIDTH)
    assert (apart[tuple(found.T)] <= WIDTHS * WIDTH).all()
    for side in found.T:
        assert len(np.unique(side)) == len(side)
    far = match_guided(matched(source, target, np.ones((n1, n2)), edge), apart + 1.0, WIDTH)
    assert len(far) == 0


def test_edges_decide_between_places_equally_near():
    source = graph(np.array([[0.0, 0, 0], [1, 0, 0]]), 2.0)
    target = graph(np.array([[0.0, 0.05, 0], [0, -0.05, 0], [1, 0, 0]]), 2.0)
    kept = target.edges[np.any(target.edges == 2, axis=1)]  # the two near the first node are no neighbours
    for right in (0, 1):
        alike = np.isin(kept, (right, 2)).all(axis=1)
        edge = np.where(alike, 1.0, 0.1) * np.ones((len(source.edges), 1))
        bare = StructureGraph(target.nodes, target.normals, target.node_descriptors, kept, target.edge_descriptors)
        found = match_guided(matched(source, bare, np.ones((2, 3)), edge), gaps(source, target), WIDTH)
        assert found.tolist() == [[0, right], [1, 2]]
