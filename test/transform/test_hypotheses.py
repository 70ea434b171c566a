"""Hypotheses from triples of candidate matches."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import error, random_similarity

from csgm_ros.config import HypothesesConfig
from csgm_ros.transform.correspondences import Correspondences
from csgm_ros.transform.hypotheses import from_triples
from csgm_ros.types import Similarity

SEEDS = st.integers(0, 2**32 - 1)
FEW = HypothesesConfig(trials=20000, limit=500)
WIDE = (0.4, 2.5)


def candidates(seed, right, wrong, scales=(0.5, 2.0)):
    rng = np.random.default_rng(seed)
    truth = random_similarity(rng, scales, 0.5)
    source, normals = rng.uniform(-1, 1, (right + wrong, 3)), rng.normal(size=(right + wrong, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    target = truth.apply(source)
    target[right:] = rng.uniform(-1, 1, (wrong, 3))
    signs = rng.choice([-1.0, 1.0], (right + wrong, 1))
    return Correspondences(source, target, normals, signs * normals @ truth.rotation.T), truth


def drawn(matches, config=FEW, scales=WIDE, seed=0):
    return from_triples(matches, np.random.default_rng(seed), config, scales)


def errors(found, truth, points):
    return np.array([error(Similarity.from_matrix(matrix), truth, points) for matrix in found])


@settings(max_examples=15, deadline=None)
@given(SEEDS)
def test_right_matches_give_the_truth(seed):
    matches, truth = candidates(seed, 30, 0)
    found = drawn(matches)
    assert len(found) == FEW.limit
    assert errors(found, truth, matches.source).max() < 1e-6


@settings(max_examples=10, deadline=None)
@given(SEEDS)
def test_the_truth_is_among_them_when_four_of_five_matches_are_wrong(seed):
    matches, truth = candidates(seed, 20, 80)
    found = drawn(matches, HypothesesConfig(trials=100000, limit=5000))
    assert errors(found, truth, matches.source).min() < 1e-9


@settings(max_examples=15, deadline=None)
@given(SEEDS)
def test_every_hypothesis_is_a_similarity_with_a_scale_in_the_range(seed):
    matches, _ = candidates(seed, 10, 40, (0.2, 5.0))
    found = drawn(matches, scales=(0.8, 1.25))
    for matrix in found:
        transform = Similarity.from_matrix(matrix)
        assert 0.8 * (1 - 1e-9) <= transform.scale <= 1.25 * (1 + 1e-9)
        np.testing.assert_allclose(transform.rotation @ transform.rotation.T, np.eye(3), atol=1e-9)
    np.testing.assert_array_equal(found[:, 3], np.tile([0.0, 0.0, 0.0, 1.0], (len(found), 1)))


def test_a_fixed_scale_is_kept():
    matches, truth = candidates(1, 30, 10, (0.999, 1.001))
    found = drawn(matches, scales=(1.0, 1.0))
    assert len(found) > 0
    np.testing.assert_allclose(np.linalg.det(found[:, :3, :3]), 1.0, rtol=1e-12)
    assert errors(found, truth, matches.source).min() < 0.01


def test_sides_are_at_least_as_long_as_asked_and_keep_their_ratio():
    matches, _ = candidates(2, 0, 60)
    found = drawn(matches, HypothesesConfig(trials=200000, limit=1000, min_side=0.9, side_tolerance=0.1))
    assert len(found) > 0
    for matrix in found[:50]:  # each has three candidates that it moves onto each other up to the tolerance
        moved = Similarity.from_matrix(matrix).apply(matches.source)
        assert np.sort(np.linalg.norm(moved - matches.target, axis=1))[2] < 0.5


def test_normals_that_the_transform_does_not_turn_into_each_other_leave_nothing():
    matches, truth = candidates(3, 30, 0)
    x = np.tile([1.0, 0.0, 0.0], (30, 1))
    across, along = ((np.roll(x, shift, axis=1) @ truth.rotation.T) for shift in (1, 0))
    assert len(drawn(matches._replace(source_normals=x, target_normals=-along))) > 0
    assert len(drawn(matches._replace(source_normals=x, target_normals=across))) == 0
    assert len(drawn(matches._replace(source_normals=0.0 * x))) == 0


@pytest.mark.parametrize('count', [0, 1, 2])
def test_fewer_than_three_matches_give_none(count):
    matches, _ = candidates(0, count, 0)
    assert drawn(matches).shape == (0, 4, 4)


def test_no_more_than_the_limit_and_the_same_ones_for_the_same_seed():
    matches, _ = candidates(4, 20, 20)
    found = drawn(matches, HypothesesConfig(trials=1000000, limit=10))
    assert len(found) == 10
    again = drawn(matches, HypothesesConfig(trials=1000000, limit=25))
    np.testing.assert_array_equal(found, again[:10])
    assert not np.array_equal(found, drawn(matches, HypothesesConfig(trials=1000000, limit=10), seed=1))


def test_candidates_on_a_line_give_proper_rotations():
    line = np.outer(np.linspace(-1, 1, 20), (0.0, 0.0, 1.0))
    normals = np.tile([1.0, 0.0, 0.0], (20, 1))
    for matrix in drawn(Correspondences(line, line, normals, normals)):
        assert np.linalg.det(matrix[:3, :3]) > 0.0
        assert np.isfinite(matrix).all()


def test_minimal_samples_on_a_line_are_left_out():
    line = np.linspace(0.0, 3.0, 12)[:, None] * np.array([1.0, 0.5, 0.2])
    normals = np.tile([0.0, 0.0, 1.0], (12, 1))
    assert len(drawn(Correspondences(line, line, normals, normals))) == 0
    apart = np.concatenate([line, [[0.5, -1.0, 1.0]]])
    normals = np.tile([0.0, 0.0, 1.0], (13, 1))
    for matrix in drawn(Correspondences(apart, apart, normals, normals)):
        rotation = Similarity.from_matrix(matrix).rotation
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
