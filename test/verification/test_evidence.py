"""How well two clouds lie on each other: sparse clouds, and surfaces that cross instead of touching."""

import numpy as np
import pytest
from scenes import ball, rectangle, room

from csgm_ros.config import profile, replaced
from csgm_ros.scale import normalizations
from csgm_ros.types import Similarity
from csgm_ros.verification.evidence import measure
from csgm_ros.verification.surfaces import MIN_NORMAL_ANGLE, normal_angle, surface

CONFIG = profile()
NEAR = CONFIG.verification.inlier_distance
STAY = Similarity.identity()


def surfaces(*clouds):
    """The clouds, all in the frame of the first."""
    unit = normalizations(clouds[0], clouds[0], CONFIG.scale)[0]
    return [surface(unit.apply(cloud), CONFIG, np.random.default_rng(0)) for cloud in clouds]


def tilted(cloud, degrees):
    angle = np.radians(degrees)
    turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    return cloud @ turn.T


@pytest.fixture(scope='module')
def sheet():
    return rectangle(np.random.default_rng(1), (-1, -1, 0), (2, 0, 0), (0, 2, 0), 5000)


@pytest.mark.parametrize('thinning', [1, 10, 30])
def test_a_thinned_cloud_lies_on_the_whole(thinning):
    dense, sparse = surfaces(room(1, 4000), room(2, 4000)[::thinning])
    angle = normal_angle(dense, sparse, CONFIG)
    right = measure(STAY, dense, sparse, NEAR, angle)
    assert right.fitness > 0.8
    aside = Similarity(1.0, np.eye(3), np.array([0.04, 0.04, 0.04]))
    assert measure(aside, dense, sparse, NEAR, angle).score < 0.3 * right.score


def test_only_where_points_are_sparse_the_surface_is_taken_to_go_on_aside_of_them():
    dense, sparse = surfaces(room(1, 4000), room(2, 100))
    assert dense.gap == 0.0
    assert sparse.gap > NEAR


def test_surfaces_that_cross_do_not_fit_though_points_are_near(sheet):
    flat, crossing = surfaces(sheet, tilted(sheet, 20.0))
    assert normal_angle(flat, crossing, CONFIG) == MIN_NORMAL_ANGLE
    near = measure(STAY, flat, crossing, NEAR, 40.0)
    assert near.fitness > 0.05
    assert measure(STAY, flat, crossing, NEAR, MIN_NORMAL_ANGLE).fitness < 0.2 * near.fitness


def test_normals_may_differ_by_little_more_than_in_the_noisier_cloud():
    rng = np.random.default_rng(2)
    clean = ball(rng, (0, 0, 0), 1.0, 3000)
    angles = [
        normal_angle(*surfaces(clean, clean + noise * rng.normal(size=clean.shape)), CONFIG)
        for noise in (0.0, 0.005, 0.01, 0.05)
    ]
    assert angles == sorted(angles)
    assert angles[0] == MIN_NORMAL_ANGLE
    assert angles[1] < CONFIG.verification.max_normal_angle == angles[-1]


def test_the_tolerance_is_a_parameter(sheet):
    rough = sheet + 0.004 * np.random.default_rng(3).normal(size=sheet.shape)
    pair = surfaces(sheet, rough)
    lenient = replaced(CONFIG, {'verification.normal_tolerance': 8.0})
    assert normal_angle(*pair, CONFIG) < normal_angle(*pair, lenient)


@pytest.mark.parametrize('count', [1, 2, 4, 30])
def test_a_handful_of_points_is_measured_too(count):
    many, few = surfaces(room(1, 500), room(1, 500)[:count])
    assert np.isfinite(measure(STAY, few, few, NEAR, 40.0).score)
    assert np.isfinite([few.gap, few.bend, many.gap, many.bend]).all()
