"""Similarity transforms: the laws of composition, the least-squares fit, the two errors."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import random_rotation, random_similarity

from csgm_ros.transform.similarity import umeyama
from csgm_ros.types import Similarity, rotation_angle

SEEDS = st.integers(0, 2**32 - 1)


def drawn(seed, scales=(0.01, 100.0)):
    rng = np.random.default_rng(seed)
    return rng, random_similarity(rng, scales, 10.0), rng.normal(size=(20, 3))


def turn(axis, angle):
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def assert_same(first, second, points):
    size = np.abs(first.apply(points)).max()
    np.testing.assert_allclose(first.apply(points), second.apply(points), atol=1e-12 * size)


@settings(deadline=None)
@given(SEEDS)
def test_apply_is_the_sentence_of_the_documentation(seed):
    _, transform, points = drawn(seed)
    for point, moved in zip(points, transform.apply(points), strict=True):
        np.testing.assert_allclose(transform.scale * transform.rotation @ point + transform.translation, moved)


@settings(deadline=None)
@given(SEEDS)
def test_inverse_undoes_from_both_sides(seed):
    _, transform, points = drawn(seed)
    for both in (transform @ transform.inverse(), transform.inverse() @ transform):
        np.testing.assert_allclose(both.matrix, np.eye(4), atol=1e-10)
    np.testing.assert_allclose(transform.inverse().apply(transform.apply(points)), points, atol=1e-10)


@settings(deadline=None)
@given(SEEDS)
def test_composition_is_that_of_the_matrices_and_associative(seed):
    rng, a, points = drawn(seed)
    b, c = random_similarity(rng, offset=3.0), random_similarity(rng, offset=3.0)
    np.testing.assert_allclose((a @ b).matrix, a.matrix @ b.matrix, rtol=1e-12, atol=1e-9)
    assert_same((a @ b) @ c, a @ (b @ c), points)
    assert_same((a @ b).inverse(), b.inverse() @ a.inverse(), points)
    assert_same(a @ Similarity.identity(), a, points)


@settings(deadline=None)
@given(SEEDS)
def test_matrix_and_back(seed):
    _, transform, points = drawn(seed)
    back = Similarity.from_matrix(transform.matrix)
    assert back.scale == pytest.approx(transform.scale)
    np.testing.assert_allclose(back.rotation @ back.rotation.T, np.eye(3), atol=1e-12)
    assert_same(back, transform, points)


@settings(deadline=None)
@given(SEEDS)
def test_umeyama_recovers_any_similarity(seed):
    _, truth, points = drawn(seed)
    assert_same(umeyama(points, truth.apply(points)), truth, points)


@settings(deadline=None)
@given(SEEDS)
def test_umeyama_recovers_from_points_on_a_plane(seed):
    _, truth, points = drawn(seed)
    flat = points * (1.0, 1.0, 0.0)
    found = umeyama(flat, truth.apply(flat))
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    assert_same(found, truth, flat)


@settings(deadline=None)
@given(SEEDS)
def test_umeyama_of_a_mirror_image_is_still_a_rotation(seed):
    _, truth, points = drawn(seed)
    found = umeyama(points, truth.apply(points * (1.0, 1.0, -1.0)))
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    assert found.scale > 0.0


@settings(deadline=None)
@given(SEEDS)
def test_no_similarity_nearby_fits_better_than_umeyama(seed):
    rng, truth, points = drawn(seed, (0.1, 10.0))
    target = truth.apply(points) + truth.scale * rng.normal(scale=0.3, size=points.shape)

    def residual(transform):
        return ((transform.apply(points) - target) ** 2).sum()

    for rigid in (False, True):
        found = umeyama(points, target, estimate_scale=not rigid)
        for _ in range(20):
            nudge = Similarity(
                1.0 if rigid else float(np.exp(rng.normal(scale=0.05))),
                turn(rng.normal(size=3), rng.normal(scale=0.05)),
                rng.normal(scale=0.05, size=3),
            )
            assert residual(found) <= residual(found @ nudge) * (1 + 1e-12)


@settings(deadline=None)
@given(SEEDS)
def test_rigid_fit_has_scale_exactly_one(seed):
    _, truth, points = drawn(seed)
    rigid = Similarity(1.0, truth.rotation, truth.translation)
    found = umeyama(points, rigid.apply(points), estimate_scale=False)
    assert found.scale == 1.0
    assert_same(found, rigid, points)
    assert umeyama(points, truth.apply(points), estimate_scale=False).scale == 1.0


@settings(deadline=None)
@given(SEEDS, st.floats(1e-7, np.pi))
def test_rotation_angle_is_the_angle_turned(seed, angle):
    axis = np.random.default_rng(seed).normal(size=3)
    assert rotation_angle(turn(axis, angle)) == pytest.approx(angle, rel=1e-6, abs=1e-12)


def test_rotation_angle_keeps_its_accuracy_at_zero_and_pi():
    assert rotation_angle(np.eye(3)) == 0.0
    assert rotation_angle(turn([1, 2, 3], 1e-9)) == pytest.approx(1e-9, rel=1e-6)
    assert rotation_angle(np.diag([1.0, -1.0, -1.0])) == pytest.approx(np.pi, abs=1e-15)


@settings(deadline=None)
@given(SEEDS)
def test_displacement_is_a_distance_in_target_units(seed):
    rng, a, points = drawn(seed)
    b = random_similarity(rng, offset=3.0)
    assert a.displacement(a, points) == 0.0
    assert a.displacement(b, points) == pytest.approx(b.displacement(a, points))
    moved = Similarity(a.scale, a.rotation, a.translation + np.array([3.0, 0.0, 4.0]))
    assert a.displacement(moved, points) == pytest.approx(5.0)
    assert np.linalg.det(random_rotation(rng)) == pytest.approx(1.0)
