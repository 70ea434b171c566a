"""Graph construction: which nodes are joined, and what an edge is described by."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import random_rotation, random_similarity

from csgm_ros.config import GraphConfig
from csgm_ros.graph.build import build, euler_descriptors, invariant_descriptors, neighbor_edges
from csgm_ros.types import Similarity, Structure

SEEDS = st.integers(0, 2**32 - 1)


def drawn(seed, count=25):
    rng = np.random.default_rng(seed)
    nodes, normals = rng.normal(size=(2, count, 3))
    return rng, nodes, normals / np.linalg.norm(normals, axis=1, keepdims=True)


@settings(deadline=None)
@given(SEEDS, st.integers(1, 30))
def test_every_node_is_joined_to_its_nearest_in_both_directions(seed, count):
    _, nodes, _ = drawn(seed)
    edges = neighbor_edges(nodes, count)
    joined = set(map(tuple, edges))
    assert len(joined) == len(edges)
    assert all(start != end for start, end in joined)
    assert {(end, start) for start, end in joined} == joined
    distances = np.linalg.norm(nodes[:, None] - nodes, axis=2)
    nearest = np.argsort(distances, axis=1)[:, 1 : count + 1]
    expected = {(i, j) for i, row in enumerate(nearest) for j in row}
    assert joined == expected | {(j, i) for i, j in expected}


def test_graphs_too_small_for_edges():
    assert neighbor_edges(np.zeros((1, 3)), 6).shape == (0, 2)
    assert neighbor_edges(np.arange(6.0).reshape(2, 3), 6).tolist() == [[0, 1], [1, 0]]


def test_nodes_in_one_place_are_not_joined_to_themselves():
    edges = neighbor_edges(np.zeros((5, 3)), 2)
    assert (edges[:, 0] != edges[:, 1]).all()


def test_euler_angles_of_known_edges():
    nodes = np.array([[0.0, 0, 0], [2, 0, 0], [0, 3, 0], [1, 1, np.sqrt(2)]])
    edges = np.array([[0, 1], [0, 2], [0, 3], [1, 0]])
    half = np.pi / 2
    expected = [[0, half, half, 2], [half, 0, half, 3], [np.pi / 4, np.pi / 4, np.pi / 4, 2], [np.pi, half, half, 2]]
    np.testing.assert_allclose(euler_descriptors(nodes, nodes, edges), expected, atol=1e-7)


@pytest.mark.parametrize('describe', [euler_descriptors, invariant_descriptors])
def test_edges_along_z_and_of_no_length_are_finite(describe):
    nodes = np.array([[0.0, 0, 0], [0, 0, 1], [0, 0, 1]])
    normals = np.tile([0.0, 0.0, 1.0], (3, 1))
    found = describe(nodes, normals, np.array([[0, 1], [1, 0], [1, 2]]))
    assert found.shape == (3, 4)
    assert np.isfinite(found).all()


def test_invariant_descriptor_of_a_known_edge():
    nodes = np.array([[0.0, 0, 0], [0, 0, np.e]])
    normals = np.array([[0.0, 0, 1], [0, -np.sqrt(0.75), 0.5]])
    found = invariant_descriptors(nodes, normals, np.array([[0, 1]]))
    np.testing.assert_allclose(found, [[0, np.pi / 3, np.pi / 3, 1]], atol=1e-7)


@settings(deadline=None)
@given(SEEDS)
def test_no_pose_and_no_sign_of_a_normal_changes_the_invariant_descriptor(seed):
    rng, nodes, normals = drawn(seed)
    edges = neighbor_edges(nodes, 4)
    expected = invariant_descriptors(nodes, normals, edges)
    pose = random_similarity(rng, offset=5.0)
    signs = rng.choice([-1.0, 1.0], (len(nodes), 1))
    found = invariant_descriptors(pose.apply(nodes), signs * normals @ pose.rotation.T, edges)
    expected[:, 3] += np.log(pose.scale)  # a constant offset is all that a scale leaves
    np.testing.assert_allclose(found, expected, atol=1e-6)


@settings(deadline=None)
@given(SEEDS)
def test_a_rotation_changes_the_papers_descriptor_but_for_its_length(seed):
    rng, nodes, normals = drawn(seed)
    edges = neighbor_edges(nodes, 4)
    before = euler_descriptors(nodes, normals, edges)
    after = euler_descriptors(nodes @ random_rotation(rng).T, normals, edges)
    np.testing.assert_allclose(after[:, 3], before[:, 3])
    np.testing.assert_allclose(euler_descriptors(nodes + 7.0, normals, edges), before, atol=1e-6)
    assert not np.allclose(after[:, :3], before[:, :3], atol=1e-3)


@pytest.mark.parametrize(('name', 'describe'), [('euler', euler_descriptors), ('invariant', invariant_descriptors)])
def test_a_graph_keeps_what_it_is_built_from(name, describe):
    _, nodes, normals = drawn(0)
    edges = neighbor_edges(nodes, 3)
    structure = Structure(None, None, nodes, normals, np.ones((25, 7)), edges, 1.0, Similarity.identity())
    graph = build(structure, GraphConfig(edges='adjacency', edge_descriptor=name))
    assert graph.nodes is nodes
    assert graph.node_descriptors.shape == (25, 7)
    np.testing.assert_array_equal(graph.edge_descriptors, describe(nodes, normals, edges))
