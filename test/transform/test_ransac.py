"""RANSAC on matched centroids: mostly wrong matches, few matches, degenerate ones."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import error, random_rotation, random_similarity

from csgm_ros.transform.ransac import ransac
from csgm_ros.types import Similarity

SEEDS = st.integers(0, 2**32 - 1)


def matches(seed, right, wrong, rigid=False):
    """Matches of a source in any unit with a target of radius about 1, the right ones first."""
    rng = np.random.default_rng(seed)
    truth = random_similarity(rng, (0.05, 20.0), 1.0)
    truth = Similarity(1.0, truth.rotation, truth.translation) if rigid else truth
    target = rng.uniform(-1, 1, (right + wrong, 3))
    source = truth.inverse().apply(target)
    target[right:] = rng.uniform(-1, 1, (wrong, 3))
    return source, target, truth


@settings(max_examples=15, deadline=None)
@given(SEEDS, st.booleans())
def test_finds_the_truth_among_seventy_per_cent_wrong_matches(seed, rigid):
    source, target, truth = matches(seed, 24, 56, rigid)
    found, inliers = ransac(source, target, np.random.default_rng(0), inlier_distance=0.05, estimate_scale=not rigid)
    assert inliers[:24].all()
    assert inliers[24:].sum() <= 3  # a wrong match may lie close by chance
    assert error(found, truth, source) < 0.02
    if rigid:
        assert found.scale == 1.0


@settings(max_examples=15, deadline=None)
@given(SEEDS)
def test_the_inliers_are_those_of_the_transform(seed):
    source, target, _ = matches(seed, 10, 20)
    found, inliers = ransac(source, target, np.random.default_rng(1), iterations=200, inlier_distance=0.1)
    distances = np.linalg.norm(found.apply(source) - target, axis=1)
    np.testing.assert_array_equal(inliers, distances < 0.1)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize('count', [0, 1, 2])
def test_too_few_matches_give_the_identity_and_no_inliers(count):
    points = np.ones((count, 3))
    found, inliers = ransac(points, points, np.random.default_rng(0))
    np.testing.assert_array_equal(found.matrix, np.eye(4))
    assert inliers.shape == (count,)
    assert not inliers.any()


def test_three_matches_are_enough():
    source, target, truth = matches(5, 3, 0)
    found, inliers = ransac(source, target, np.random.default_rng(0), iterations=10)
    assert inliers.all()
    assert error(found, truth, source) < 1e-9


@pytest.mark.parametrize('source', [np.zeros((10, 3)), np.outer(np.arange(10.0), (1.0, 2.0, 3.0))])
def test_matches_in_one_place_or_on_a_line_give_a_proper_transform(source):
    target = source @ random_rotation(np.random.default_rng(0)).T + 1.0
    found, inliers = ransac(source, target, np.random.default_rng(0), iterations=100)
    assert np.isfinite(found.matrix).all()
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    assert found.scale > 0.0
    assert inliers.all()


def test_the_same_generator_gives_the_same_bits():
    source, target, _ = matches(3, 10, 30)
    first, second = (ransac(source, target, np.random.default_rng(9), iterations=5000)[0].matrix for _ in range(2))
    assert first.tobytes() == second.tobytes()
