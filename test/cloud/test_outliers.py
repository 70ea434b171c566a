"""Outliers, noise and smoothing: what is done to a cloud before the five steps."""

import numpy as np
import pytest
from scenes import room

from csgm_ros.cloud.outliers import without_far, without_isolated, without_uniform_outliers
from csgm_ros.cloud.smoothing import smoothed
from csgm_ros.cloud.surface_variation import surface_variation
from csgm_ros.scale import radius
from csgm_ros.types import Similarity


def noisy_sheet(noise, seed=0):
    rng = np.random.default_rng(seed)
    sheet = np.column_stack([rng.uniform(-0.7, 0.7, (4000, 2)), np.zeros(4000)])
    return sheet + rng.normal(size=sheet.shape) * (0.0, 0.0, noise)


def test_outliers_do_not_set_the_radius():
    cloud = room(3, 500)
    outliers = np.array([[30.0, 0.0, 0.0], [0.0, -80.0, 5.0]])
    assert radius(without_isolated(np.vstack([cloud, outliers]), 2.5)) == pytest.approx(radius(cloud), rel=0.05)
    assert without_isolated(cloud, 0.0) is cloud


def test_far_outliers_are_left_out_and_nothing_else():
    cloud = room(3, 500)
    unit = Similarity(1.0 / radius(cloud), np.eye(3), -cloud.mean(0) / radius(cloud))
    kept = without_far(np.vstack([cloud, [[30.0, 0.0, 0.0]]]), unit)
    np.testing.assert_array_equal(kept, cloud)


def test_thickness_tells_a_surface_from_a_volume():
    volume = np.random.default_rng(1).uniform(-1.0, 1.0, (4000, 3))
    assert surface_variation(noisy_sheet(0.0)) < 0.05
    assert surface_variation(noisy_sheet(0.0)) < surface_variation(noisy_sheet(0.02)) < surface_variation(volume)


def test_smoothing_brings_noise_back_to_the_surface():
    sheet = noisy_sheet(0.05)
    inner = np.abs(sheet[:, :2]).max(1) < 0.5
    calm = smoothed(sheet, 60)
    calm = calm[np.abs(calm[:, :2]).max(1) < 0.5]
    assert calm[:, 2].std() < 0.4 * sheet[inner, 2].std()


def test_smoothing_does_not_depend_on_the_order_of_the_points():
    sheet = noisy_sheet(0.05)
    shuffled = sheet[np.random.default_rng(2).permutation(len(sheet))]
    np.testing.assert_allclose(smoothed(shuffled, 40), smoothed(sheet, 40), atol=1e-12)


def cluttered(cloud, share, seed=0):
    """The cloud among points that fill the ball around it, and which are its own."""
    rng = np.random.default_rng(seed)
    count = round(share / (1.0 - share) * len(cloud))
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ball = directions * np.cbrt(rng.uniform(size=(count, 1))) * radius(cloud) + cloud.mean(0)
    order = rng.permutation(len(cloud) + count)
    return np.vstack([cloud, ball])[order], order < len(cloud)


@pytest.mark.parametrize('share', [0.1, 0.3, 0.6])
def test_clutter_is_left_out_and_the_surface_kept(share):
    cloud, own = cluttered(room(3, 1000), share)
    kept = np.isin(cloud[:, 0], without_uniform_outliers(cloud)[:, 0])
    assert kept[own].mean() > 0.95
    assert kept[~own].mean() < 0.2


@pytest.mark.parametrize('seed', [0, 1])
def test_a_cloud_without_uniform_outliers_keeps_every_point(seed):
    for cloud in (room(seed, 1000), noisy_sheet(0.05, seed), np.random.default_rng(seed).uniform(size=(4000, 3))):
        np.testing.assert_array_equal(without_uniform_outliers(cloud), cloud)


@pytest.mark.parametrize('noise', [0.0, 0.06])
def test_a_sparser_surface_is_no_clutter(noise):
    sparse = room(4, 30) + np.array([6.0, 0.0, 0.0])
    both = np.vstack([room(3, 1000), sparse + noise * np.random.default_rng(6).normal(size=sparse.shape)])
    np.testing.assert_array_equal(without_uniform_outliers(both), both)


def test_a_few_points_in_one_place_do_not_make_the_rest_clutter():
    rng = np.random.default_rng(5)
    cloud = np.vstack([rng.uniform(-1.0, 1.0, (6000, 3)), 0.05 * rng.normal(size=(600, 3))])
    np.testing.assert_array_equal(without_uniform_outliers(cloud), cloud)
