"""Pairs of nodes that support each other, and nodes that nothing supports."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from csgm_ros.graph.support import support
from csgm_ros.types import Matching, StructureGraph

SCALES = 0.5, 2.0


def graph(nodes, normals):
    return StructureGraph(nodes, normals, np.empty((0, 0)), np.empty((0, 2), int), np.empty((0, 0)))


def planted(rng, count=40, extra=30, scale=1.3, noise=0.01):
    """Two graphs that share nodes, each with nodes of its own; their affinities put the counterpart among the first."""
    nodes, normals = rng.random((count + extra, 3)) * 2.0, rng.normal(size=(count + extra, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    turn = Rotation.random(rng=rng).as_matrix()
    others = rng.random((count + extra, 3)) * 2.0
    others[:count] = nodes[:count] + rng.normal(0.0, noise, (count, 3))
    other_normals = rng.permutation(normals)
    other_normals[:count] = normals[:count]
    order = rng.permutation(count + extra)
    affinity = rng.random((count + extra, count + extra))
    affinity[np.arange(count), np.arange(count)] += 0.7
    second = graph((scale * others @ turn.T + (1.0, 2.0, 3.0))[order], (other_normals @ turn.T)[order])
    return graph(nodes, normals), second, affinity[:, order], np.argsort(order)[:count]


def assigned(gain):
    assignment = np.zeros(gain.shape, np.uint8)
    assignment[linear_sum_assignment(gain, maximize=True)] = 1
    return Matching(assignment, 0.0, 0)


def right(pairs, truth):
    return np.array([i < len(truth) and truth[i] == a for i, a in pairs])


@pytest.mark.parametrize('scale', [0.6, 1.0, 1.7])
def test_supported_pairs_are_right_though_surroundings_hardly_tell(scale):
    for seed in range(4):
        first, second, affinity, truth = planted(np.random.default_rng(seed), scale=scale)
        found = support(first, second, affinity, SCALES)
        before, after = assigned(affinity), assigned(found.added(affinity))
        assert right(before.pairs, truth).mean() < 0.5
        assert right(after.pairs[after.pairs[:, 0] < len(truth)], truth).mean() > 0.8  # not all are among the first
        held = found.held(after)
        assert right(held.pairs, truth).mean() > 0.9  # 30 of the 70 nodes have no counterpart
        assert len(held.pairs) > 0.8 * len(truth)


def test_nothing_is_held_together_by_another_scale_than_allowed():
    first, second, affinity, truth = planted(np.random.default_rng(0), scale=1.3)
    known = support(first, second, affinity, (1.3, 1.3))
    wrong = support(first, second, affinity, (0.7, 0.7))
    assert right(known.held(assigned(known.added(affinity))).pairs, truth).mean() > 0.9
    assert right(wrong.held(assigned(wrong.added(affinity))).pairs, truth).mean() < 0.5


def test_unrelated_graphs_support_less():
    first, second, affinity, _ = planted(np.random.default_rng(1))
    unrelated = planted(np.random.default_rng(2))[1]

    def most(one, other):
        found = support(one, other, affinity, SCALES)
        mutual = found.weights @ (found.strength[found.first] * found.strength[found.second])
        return mutual / (found.strength @ found.strength)

    assert most(first, second) > 2.0 * most(first, unrelated)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_neither_pose_nor_unit_nor_order_of_the_nodes_matters(seed):
    rng = np.random.default_rng(seed)
    first, second, affinity, _ = planted(rng, count=15, extra=5)
    turn, order = Rotation.random(rng=rng).as_matrix(), rng.permutation(len(first.nodes))
    moved = graph((0.5 * first.nodes @ turn.T - 4.0)[order], (first.normals @ turn.T)[order])
    before = support(first, second, affinity, SCALES).added(affinity)
    after = support(moved, second, affinity[order], (2.0 * SCALES[0], 2.0 * SCALES[1])).added(affinity[order])
    np.testing.assert_allclose(after, before[order], atol=1e-3)


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**32 - 1), st.integers(2, 12), st.integers(2, 12))
def test_what_is_held_was_matched_and_small_graphs_are_no_trouble(seed, n1, n2):
    rng = np.random.default_rng(seed)
    first, second = (graph(rng.random((n, 3)), np.zeros((n, 3))) for n in (n1, n2))
    affinity = rng.random((n1, n2))
    found = support(first, second, affinity, SCALES)
    matching = assigned(found.added(affinity))
    held = found.held(matching)
    assert (found.added(affinity) >= affinity).all()
    assert np.isfinite(found.strength).all()
    assert {*map(tuple, held.pairs)} <= {*map(tuple, matching.pairs)}


def test_a_node_that_is_there_twice_is_no_trouble():
    nodes = np.zeros((5, 3))
    found = support(graph(nodes, nodes), graph(nodes, nodes), np.ones((5, 5)), SCALES)
    assert len(found.held(Matching(np.eye(5, dtype=np.uint8), 0.0, 0)).pairs) == 0
