"""Strays, noise and smoothing: what is done to a cloud before the five steps."""

import numpy as np
import pytest
from scenes import room

from csgm_ros.denoise import dense_part, smoothed, thickness, without_far_strays
from csgm_ros.scale import radius
from csgm_ros.types import Similarity


def noisy_sheet(noise, seed=0):
    rng = np.random.default_rng(seed)
    sheet = np.column_stack([rng.uniform(-0.7, 0.7, (4000, 2)), np.zeros(4000)])
    return sheet + rng.normal(size=sheet.shape) * (0.0, 0.0, noise)


def test_strays_do_not_set_the_radius():
    cloud = room(3, 500)
    strays = np.array([[30.0, 0.0, 0.0], [0.0, -80.0, 5.0]])
    assert radius(dense_part(np.vstack([cloud, strays]), 2.5)) == pytest.approx(radius(cloud), rel=0.05)
    assert dense_part(cloud, 0.0) is cloud


def test_far_strays_are_left_out_and_nothing_else():
    cloud = room(3, 500)
    unit = Similarity(1.0 / radius(cloud), np.eye(3), -cloud.mean(0) / radius(cloud))
    kept = without_far_strays(np.vstack([cloud, [[30.0, 0.0, 0.0]]]), unit)
    np.testing.assert_array_equal(kept, cloud)


def test_thickness_tells_a_surface_from_a_volume():
    volume = np.random.default_rng(1).uniform(-1.0, 1.0, (4000, 3))
    assert thickness(noisy_sheet(0.0)) < 0.05
    assert thickness(noisy_sheet(0.0)) < thickness(noisy_sheet(0.02)) < thickness(volume)


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
