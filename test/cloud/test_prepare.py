"""Checks of the input, voxel grid and normals."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import ball, random_similarity, rectangle, room
from scipy.spatial import cKDTree

from csgm_ros.cloud.prepare import finite_points, normals_of, prepare
from csgm_ros.errors import CsgmError, DegenerateCloudError, InputError

SEEDS = st.integers(0, 2**32 - 1)
CLOUD = room(0, 100)
NO_ARRAY = {
    'letters': np.full((100, 3), 'a'),
    'digits as text': CLOUD.astype(str),
    'a word': 'points.ply',
    'nothing': None,
    'objects': np.full((100, 3), None),
    'ragged': [[1.0, 2.0, 3.0], [1.0, 2.0]],
    'complex': CLOUD + 1j,
    'fields': np.zeros(100, [('x', float), ('y', float), ('z', float)]),
    'two columns': CLOUD[:, :2],
    'four columns': np.hstack([CLOUD, CLOUD[:, :1]]),
    'flat': CLOUD.ravel(),
    'organized': CLOUD[:1000].reshape(10, 100, 3),
    'empty list': [],
}
DEGENERATE = {
    'empty': np.empty((0, 3)),
    'three points': CLOUD[:3],
    'only NaN': np.full((100, 3), np.nan),
    'only inf': np.full((100, 3), -np.inf),
    'few finite': np.where(np.arange(1000)[:, None] < 49, CLOUD[:1000], np.nan),
    'one place': np.full((100, 3), 7.0),
    'one place, many points': np.repeat(CLOUD[:1], 100000, 0),
    'a line': np.outer(np.linspace(-1, 1, 200), (1.0, 2.0, 3.0)) + 5.0,
    'two places': np.repeat(CLOUD[:2], 50, 0),
}


@pytest.mark.parametrize('name', ['source', 'target'])
@pytest.mark.parametrize('case', NO_ARRAY)
def test_what_is_no_cloud_is_refused_with_a_remedy(case, name):
    with pytest.raises(InputError, match=rf'^{name}: .*give an \(N, 3\) array'):
        finite_points(NO_ARRAY[case], name)


@pytest.mark.parametrize('case', DEGENERATE)
def test_clouds_without_a_surface_are_refused(case):
    with pytest.raises(DegenerateCloudError, match=r'^target: '):
        finite_points(DEGENERATE[case], 'target')


@pytest.mark.parametrize('size', [1e120, 1e200, 1e300])
def test_coordinates_that_overflow_are_refused(size):
    with pytest.raises(InputError, match=r'^source: .*unit'):
        finite_points(CLOUD * size, 'source')


@pytest.mark.parametrize('kind', [np.float32, np.float64, np.int32, np.uint8, list])
def test_every_kind_of_number_comes_back_as_float64(kind):
    points = np.abs(CLOUD * 50).astype(np.uint8)
    found = finite_points(points.tolist() if kind is list else points.astype(kind))
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, points)


@settings(deadline=None)
@given(SEEDS)
def test_only_finite_rows_are_kept_in_their_order_and_the_input_is_left_alone(seed):
    rng = np.random.default_rng(seed)
    points = CLOUD[:400].copy()
    rows = rng.choice(400, 100, replace=False)
    points[rows, rng.integers(0, 3, 100)] = rng.choice([np.nan, np.inf, -np.inf], 100)
    before = points.copy()
    found = finite_points(points)
    np.testing.assert_array_equal(found, np.delete(CLOUD[:400], rows, axis=0))
    found += 1.0
    np.testing.assert_array_equal(points, before)


@settings(deadline=None)
@given(SEEDS)
def test_pose_and_unit_do_not_decide_what_is_degenerate(seed):
    pose = random_similarity(np.random.default_rng(seed), (1e-5, 1e5), 1.0)
    assert len(finite_points(pose.apply(CLOUD))) == len(CLOUD)
    flat = pose.apply(rectangle(np.random.default_rng(0), (0, 0, 0), (2, 0, 0), (0, 1, 0), 100))
    assert len(finite_points(flat)) == len(flat)


def test_normals_of_a_plane_and_a_ball():
    rng = np.random.default_rng(0)
    plane = normals_of(rectangle(rng, (0, 0, 0), (1, 0, 0), (0, 1, 1), 1000), 20)
    np.testing.assert_allclose(np.abs(plane @ [0, -np.sqrt(0.5), np.sqrt(0.5)]), 1.0, atol=1e-9)
    round_ = ball(rng, (5, 5, 5), 1.0, 1000)
    assert np.abs(((round_ - 5.0) * normals_of(round_, 20)).sum(1)).min() > 0.95


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_a_prepared_cloud_has_one_point_a_voxel(seed):
    rng = np.random.default_rng(seed)
    normalization = random_similarity(rng, (0.1, 1.0), 1.0)
    moved = normalization.apply(CLOUD)
    cloud = prepare(moved, 0.05 * normalization.scale, 20)
    assert len(cloud.points) == len(cloud.normals) < len(CLOUD)
    reach = np.sqrt(3) * 0.05 * normalization.scale
    assert cKDTree(cloud.points).query(moved)[0].max() <= reach
    assert cKDTree(moved).query(cloud.points)[0].max() <= reach
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1.0)
    shuffled = prepare(rng.permutation(moved), 0.05 * normalization.scale, 20)
    np.testing.assert_array_equal(shuffled.points, cloud.points)


def test_fewer_points_than_neighbors_still_have_normals():
    cloud = prepare(CLOUD[:5], 0.001, 20)
    assert len(cloud.points) == 5
    assert np.isfinite(cloud.normals).all()


def test_degenerate_is_an_input_error_and_a_value_error():
    assert issubclass(DegenerateCloudError, InputError)
    assert issubclass(InputError, CsgmError)
    assert issubclass(InputError, ValueError)


@pytest.mark.parametrize('extremes', [[[1e9, 0, 0]], [[1e9, 0, 0], [-1e9, 5, 0], [3, 1e12, 0]]])
def test_a_few_points_absurdly_far_out_make_no_line_of_a_cloud(extremes):
    points = np.random.default_rng(0).normal(size=(400, 3))
    assert len(finite_points(np.vstack([points, extremes]))) == 400 + len(extremes)
