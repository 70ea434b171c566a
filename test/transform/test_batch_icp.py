"""The short ICP: it finds the truth nearby, keeps still without evidence, and never breaks a transform."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import error, random_rotation, rectangle, room

from csgm_ros.cloud import nearest_grid
from csgm_ros.cloud.prepare import prepare
from csgm_ros.config import ScaleConfig
from csgm_ros.scale import normalizations
from csgm_ros.transform.batch_icp import refine_all
from csgm_ros.types import Similarity

SEEDS = st.integers(0, 2**32 - 1)
DISTANCES, COSINE = (0.12, 0.08, 0.05), float(np.cos(np.radians(40.0)))
TURN = random_rotation(np.random.default_rng(7))


def sides(first, second):
    """Grids of two clouds, the second turned, and their samples; the truth between them is TURN."""
    units = normalizations(first, first, ScaleConfig())
    clouds = [prepare(unit.apply(points), 0.03, 20) for points, unit in zip((first, second), units, strict=True)]
    source = nearest_grid.build(clouds[0].points, clouds[0].normals, 0.025, 0.12)
    target = nearest_grid.build(clouds[1].points @ TURN.T, clouds[1].normals @ TURN.T, 0.025, 0.12)
    rng = np.random.default_rng(0)
    return source, target, tuple(rng.permutation(len(grid.points))[:700] for grid in (source, target))


ROOM = sides(room(1, 1000), room(2, 1000))
TRUTH = Similarity(1.0, TURN, np.zeros(3))


def nudge(rng, scale, angle, offset):
    """A transform of this size in every part, in a random direction."""
    x, y, z = (axis := rng.normal(size=3)) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    step = rng.normal(size=3)
    return Similarity(np.exp(rng.choice([-1, 1]) * scale), rotation, offset * step / np.linalg.norm(step))


def refined(starts, grids, estimate_scale=True):
    source, target, samples = grids
    matrices = np.stack([start.matrix for start in starts])
    return refine_all(matrices, source, target, samples, DISTANCES, COSINE, estimate_scale=estimate_scale)


def errors(matrices, points):
    return np.array([error(Similarity.from_matrix(matrix), TRUTH, points) for matrix in matrices])


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_converges_from_perturbed_starts(seed):
    rng = np.random.default_rng(seed)
    starts = [TRUTH @ nudge(rng, 0.04, 0.06, 0.04) for _ in range(5)]
    found = errors(refined(starts, ROOM), ROOM[0].points)
    assert np.median(found) < 0.005
    assert found.max() < 0.02
    assert errors([start.matrix for start in starts], ROOM[0].points).min() > 0.03


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_without_scale_the_scale_stays_and_the_rest_converges(seed):
    rng = np.random.default_rng(seed)
    starts = [TRUTH @ nudge(rng, 0.0, 0.06, 0.04) for _ in range(5)]
    found = refined(starts, ROOM, estimate_scale=False)
    np.testing.assert_allclose(np.linalg.det(found[:, :3, :3]), 1.0, rtol=1e-12)
    assert np.median(errors(found, ROOM[0].points)) < 0.005


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_every_result_is_a_finite_proper_similarity_wherever_it_starts(seed):
    rng = np.random.default_rng(seed)
    starts = [nudge(rng, rng.uniform(0, 1), rng.uniform(0, np.pi), rng.uniform(0, 0.5)) for _ in range(5)]
    for matrix in refined(starts, ROOM):
        transform = Similarity.from_matrix(matrix)
        assert transform.scale > 0.0
        np.testing.assert_allclose(transform.rotation @ transform.rotation.T, np.eye(3), atol=1e-9)
        np.testing.assert_array_equal(matrix[3], [0, 0, 0, 1])


@settings(max_examples=20, deadline=None)
@given(SEEDS, st.integers(0, 9))
def test_fewer_than_ten_correspondences_never_move_anything(seed, count):
    rng = np.random.default_rng(seed)
    source, target, samples = ROOM
    starts = np.stack([(TRUTH @ nudge(rng, 0.02, 0.02, 0.02)).matrix for _ in range(3)])
    few = samples[0][:count], samples[1][:0]
    kept = refine_all(starts, source, target, few, DISTANCES, COSINE)
    assert kept.tobytes() == starts.tobytes()


def test_clouds_that_do_not_meet_or_whose_normals_disagree_never_move():
    source, target, samples = ROOM
    far = Similarity(1.0, TURN, np.full(3, 10.0)).matrix[None]
    assert refine_all(far, source, target, samples, DISTANCES, COSINE).tobytes() == far.tobytes()
    start = (TRUTH @ nudge(np.random.default_rng(0), 0.02, 0.02, 0.02)).matrix[None]
    unknown = target._replace(normals=np.zeros_like(target.normals))
    assert refine_all(start, source, unknown, samples, DISTANCES, COSINE).tobytes() == start.tobytes()


def test_each_transform_is_refined_for_itself_and_the_input_is_left_alone():
    rng = np.random.default_rng(5)
    starts = np.stack([(TRUTH @ nudge(rng, 0.03, 0.05, 0.03)).matrix for _ in range(6)])
    before = starts.copy()
    source, target, samples = ROOM
    together = refine_all(starts, source, target, samples, DISTANCES, COSINE)
    alone = [refine_all(start, source, target, samples, DISTANCES, COSINE)[0] for start in starts]
    np.testing.assert_array_equal(together, np.stack(alone))
    np.testing.assert_array_equal(starts, before)


@pytest.mark.parametrize('iterations', [0, 1])
def test_the_number_of_iterations_is_a_limit(iterations):
    source, target, samples = ROOM
    start = (TRUTH @ nudge(np.random.default_rng(0), 0.04, 0.06, 0.04)).matrix[None]
    short = refine_all(start, source, target, samples, DISTANCES, COSINE, iterations=iterations)
    assert np.array_equal(short, start) == (iterations == 0)
    assert errors(short, source.points)[0] > errors(refined([Similarity.from_matrix(start[0])], ROOM), source.points)[0]


def test_a_plane_that_leaves_directions_open_stays_finite_and_flat():
    rng = np.random.default_rng(0)
    planes = [rectangle(rng, (0, 0, 0), (2, 0, 0), (0, 1.3, 0), 2000) for _ in range(2)]
    grids = sides(*planes)
    starts = [TRUTH @ nudge(rng, 0.02, 0.05, 0.03) for _ in range(5)]
    for matrix in refined(starts, grids):
        moved = Similarity.from_matrix(matrix).apply(grids[0].points)
        normal = TURN[:, 2]
        assert np.abs((moved - grids[1].points.mean(0)) @ normal).max() < 0.02
