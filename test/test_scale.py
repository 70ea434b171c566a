"""Scale normalisation, Eq. (1): both clouds get radius 1, and how far the search may leave that scale."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import random_similarity, room

from csgm_ros.config import ScaleConfig, profile
from csgm_ros.errors import DegenerateCloudError, naming
from csgm_ros.scale import normalizations, normalize, radius, search_range
from csgm_ros.types import Similarity

SEEDS = st.integers(0, 2**32 - 1)
RIGID = ScaleConfig(estimate_scale=False)


def unit(scale):
    return Similarity(scale, np.eye(3), np.zeros(3))


def test_radius_of_a_known_cloud():
    assert radius(np.array([[0.0, 0, 0], [4, 0, 0], [0, 0, 0], [0, 0, 0]])) == pytest.approx(3.0)


@settings(deadline=None)
@given(SEEDS)
def test_both_clouds_get_radius_one_about_the_origin(seed):
    rng = np.random.default_rng(seed)
    clouds = [random_similarity(rng, (1e-3, 1e3), 50.0).apply(rng.normal(size=(100, 3))) for _ in range(2)]
    for points, transform in zip(clouds, normalizations(*clouds, ScaleConfig()), strict=True):
        normal = transform.apply(points)
        assert radius(normal) == pytest.approx(1.0)
        np.testing.assert_allclose(normal.mean(0), 0.0, atol=1e-9)


@settings(deadline=None)
@given(SEEDS)
def test_the_quotient_is_the_scale_of_equation_1(seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(100, 3))
    truth = random_similarity(rng, (0.05, 20.0))
    first, second = normalizations(points, truth.apply(points), ScaleConfig())
    assert first.scale / second.scale == pytest.approx(truth.scale)


@settings(deadline=None)
@given(SEEDS)
def test_rigid_mode_divides_both_by_one_length(seed):
    rng = np.random.default_rng(seed)
    clouds = rng.normal(size=(100, 3)), 5.0 * rng.normal(size=(100, 3)) + 2.0
    first, second = normalizations(*clouds, RIGID)
    assert first.scale == second.scale
    assert min(map(radius, clouds)) < 1.0 / first.scale < max(map(radius, clouds))
    assert search_range(first, second, RIGID, 2.0) == (1.0, 1.0)


def test_search_range_is_symmetric_about_equation_1_and_wider_with_other_lengths():
    assert search_range(unit(2.0), unit(7.0), ScaleConfig(), 2.0) == (0.5, 2.0)
    low, high = search_range(unit(1.0), unit(1.0), ScaleConfig(), 2.0, relative=0.6)
    assert (low, high) == pytest.approx((0.5 / 0.6, 2.0 / 0.6))


@settings(deadline=None)
@given(st.floats(1e-3, 1e3), st.floats(1e-3, 1e3), st.floats(1e-4, 1e4), st.floats(1.01, 100.0), st.floats(0.5, 2.0))
def test_search_range_obeys_the_bounds_in_the_clouds_own_units(source, target, low, width, relative):
    config = ScaleConfig(scale_min=low, scale_max=low * width)
    first, second = search_range(unit(source), unit(target), config, 2.0, relative)
    assert first < second
    assert first * source / target >= config.scale_min * (1 - 1e-12)
    assert second * source / target <= config.scale_max * (1 + 1e-12)


def test_an_error_about_one_cloud_names_it():
    with pytest.raises(DegenerateCloudError, match=r'^target: too few$'), naming('target'):
        raise DegenerateCloudError('too few')


@pytest.mark.parametrize('away', [1e3, 1e9, 1e30])
@pytest.mark.parametrize('count', [1, 50])
def test_points_absurdly_far_away_do_not_count(away, count):
    cloud = room(1, 200)
    far = cloud[:count] + np.array([away, 0.0, 0.0])
    alone, mixed = (normalize((points, cloud), profile()) for points in (cloud, np.concatenate([cloud, far])))
    assert mixed.normalizations[0].scale == pytest.approx(alone.normalizations[0].scale, rel=1e-9)
    assert len(mixed.clouds[0]) == len(cloud)
