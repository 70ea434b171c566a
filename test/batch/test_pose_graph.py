"""Poses of many clouds against known truth, with wrong edges among the right ones."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import random_similarity

from csgm_ros.batch.pose_graph import CORNERS, Edge, align, path
from csgm_ros.types import Similarity

SPREAD = 2.0


def world(rng, count):
    """Poses of clouds, each in a unit and frame of its own, far from its own origin."""
    return [random_similarity(rng, (0.1, 10.0), 50.0) for _ in range(count)]


def small(rng, size):
    """A similarity close to none."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(rng.normal(scale=size, size=3)).as_matrix()
    return Similarity(float(np.exp(rng.normal(scale=size))), turn, rng.normal(scale=size * SPREAD, size=3))


def edge(rng, truth, source, target, noise=0.0):
    """What a registration of two of the clouds would give; both are 10 units of the common frame around its origin."""
    center, spread = truth[source].inverse().translation, SPREAD / truth[source].scale
    return Edge(source, target, truth[target].inverse() @ small(rng, noise) @ truth[source], center, spread)


def wrong(rng, right):
    """An accepted registration that is wrong in every way."""
    off = random_similarity(rng, (0.5, 2.0), right.spread)
    around = Similarity(1.0, np.eye(3), np.asarray(right.center))
    return Edge(
        right.source, right.target, right.transform @ around @ off @ around.inverse(), right.center, right.spread
    )


def ring(rng, truth, count, noise):
    """Every cloud with its next three."""
    pairs = [(k, (k + step) % count) for k in range(count) for step in (1, 2, 3)]
    return [edge(rng, truth, *(pair if rng.random() < 0.5 else pair[::-1]), noise) for pair in pairs]


def errors(truth, aligned, members):
    """RMS displacement of each cloud's points, relative to their spread, in the frame of the first."""
    first = members[0]
    found = []
    for node in members:
        points = truth[node].inverse().apply(SPREAD * CORNERS)
        estimate = (aligned.poses[first].inverse() @ aligned.poses[node]).apply(points)
        right = (truth[first].inverse() @ truth[node]).apply(points)
        found.append(np.sqrt(((estimate - right) ** 2).sum(1).mean()) * truth[first].scale / SPREAD)
    return np.array(found)


@given(st.integers(0, 10**6))
@settings(max_examples=15)
def test_a_tenth_of_wrong_edges_is_found_and_does_no_harm(seed):
    rng = np.random.default_rng(seed)
    count = 12
    truth = world(rng, count)
    edges = ring(rng, truth, count, 0.01)
    planted = rng.permutation(len(edges))[: round(0.1 * len(edges))]
    for number in planted:
        edges[number] = wrong(rng, edges[number])
    aligned = align(count, edges)
    assert set(aligned.component) == {0}
    assert set(np.flatnonzero(~aligned.kept)) == set(planted)
    assert aligned.verified[aligned.kept].all()
    assert errors(truth, aligned, range(count)).max() < 0.08


def test_without_noise_the_truth_comes_back():
    rng = np.random.default_rng(1)
    truth = world(rng, 9)
    aligned = align(9, ring(rng, truth, 9, 0.0))
    assert errors(truth, aligned, range(9)).max() < 1e-6
    assert aligned.residuals.max() < 1e-6


def test_clouds_that_no_edge_connects_are_components_of_their_own():
    rng = np.random.default_rng(2)
    truth = world(rng, 8)
    edges = [edge(rng, truth, a, b) for a, b in ((0, 1), (1, 2), (2, 0), (4, 5), (6, 5))]
    aligned = align(8, edges)
    assert aligned.component.tolist() == [0, 0, 0, 1, 2, 2, 2, 3]
    assert aligned.verified.tolist() == [True, True, True, False, False]
    assert errors(truth, aligned, [4, 5, 6]).max() < 1e-6


def test_where_it_cannot_be_told_which_of_a_cycle_is_wrong_nothing_of_it_is_kept():
    rng = np.random.default_rng(3)
    truth = world(rng, 5)
    edges = [edge(rng, truth, a, b) for a, b in ((0, 1), (1, 2), (2, 0), (2, 3), (3, 4), (4, 2))]
    edges[2] = wrong(rng, edges[2])
    aligned = align(5, edges)
    assert aligned.kept.tolist() == [False, False, False, True, True, True]
    assert aligned.contradicted.sum() == 2
    assert len(set(aligned.component)) == 3


def test_a_long_loop_closes_by_its_right_closure():
    rng = np.random.default_rng(4)
    count = 40
    truth = world(rng, count)
    edges = [edge(rng, truth, k, (k + 1) % count, 0.01) for k in range(count)]
    aligned = align(count, edges)
    assert aligned.kept.all()
    assert aligned.verified.all()


def test_the_fewest_edges_are_the_path():
    ends = np.array([(0, 1), (1, 2), (2, 3), (3, 0), (4, 4)])
    assert path(5, ends, np.array([True, True, True, False, True]), 0, 3) == [0, 1, 2]
    assert path(5, ends, np.ones(5, bool), 0, 4) == []


def test_poses_are_written_and_the_inconsistent_pair_is_named(tmp_path):
    pytest.importorskip('pyarrow')
    from csgm_ros.batch.align import align as align_results
    from csgm_ros.batch.results import Results

    rng = np.random.default_rng(5)
    truth = world(rng, 5)
    edges = [edge(rng, truth, a, b, 0.005) for a in range(5) for b in range(a)]
    edges[3] = wrong(rng, edges[3])
    with Results(tmp_path / 'results') as results:
        for number, e in enumerate(edges):
            row = {'key': str(number), 'id': f'pair{number}', 'accepted': True, 'failed': False}
            row |= {'source': f'/scans/{e.source}.npy', 'target': f'/scans/{e.target}.npy'}
            row |= {'T_target_source': e.transform.matrix.ravel().tolist(), 'scale': e.transform.scale}
            results.append(row | {'source_center': list(map(float, e.center)), 'source_spread': e.spread})
        results.append({'key': 'bad', 'id': 'failing', 'accepted': False, 'failed': True})
    said = align_results(tmp_path / 'results', tmp_path / 'poses.json', '2.npy')
    assert '5 clouds in 1 frames' in said
    assert 'inconsistent: pair3 is off by' in said
    document = json.loads(Path(tmp_path / 'poses.json').read_text())
    (component,) = document['components']
    assert component['frame'] == '/scans/2.npy'
    for number in range(5):
        found = Similarity.from_matrix(np.array(component['clouds'][f'/scans/{number}.npy']['T_frame_cloud']))
        right = truth[2].inverse() @ truth[number]
        assert found.scale == pytest.approx(right.scale, rel=0.03)
    (pair,) = document['inconsistent_pairs']
    assert pair['id'] == 'pair3'
    assert 1 <= len(pair['cycle']) <= 2
