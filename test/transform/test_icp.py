"""The final ICP."""

import numpy as np
import pytest
from scenes import error, random_rotation, room

from csgm_ros.transform.icp import refine
from csgm_ros.types import Similarity, rotation_angle

SOURCE = room(1, 300)
TRUTH = Similarity(0.5, random_rotation(np.random.default_rng(4)), np.array([3.0, -2.0, 1.0]))
TARGET = TRUTH.apply(room(2, 300))
DISTANCES = (0.1, 0.04)


def nudge(scale, angle, offset):
    cosine, sine = np.cos(angle), np.sin(angle)
    return Similarity(scale, np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]]), np.full(3, offset))


def test_pulls_a_start_nearby_to_the_truth():
    start = TRUTH @ nudge(1.03, 0.03, 0.03)
    found = refine(SOURCE, TARGET, start, DISTANCES)
    assert error(start, TRUTH, SOURCE) > 0.02
    assert error(found, TRUTH, SOURCE) < 0.005
    assert rotation_angle(found.rotation.T @ TRUTH.rotation) < 0.01


def test_without_scale_the_scale_stays():
    found = refine(SOURCE, TARGET, TRUTH @ nudge(1.0, 0.03, 0.03), DISTANCES, estimate_scale=False)
    assert found.scale == pytest.approx(TRUTH.scale, rel=1e-12)
    assert error(found, TRUTH, SOURCE) < 0.005


def test_a_start_without_neighbours_is_returned_as_it_was():
    start = Similarity(0.5, np.eye(3), np.full(3, 100.0))
    np.testing.assert_allclose(refine(SOURCE, TARGET, start, DISTANCES).matrix, start.matrix, rtol=1e-12)


def test_the_same_start_gives_the_same_bits():
    start = TRUTH @ nudge(1.02, 0.02, 0.02)
    first, second = (refine(SOURCE, TARGET, start, DISTANCES).matrix for _ in range(2))
    assert first.tobytes() == second.tobytes()


def test_the_number_of_threads_reaches_open3d_and_changes_nothing():
    open3d = pytest.importorskip('open3d')
    source, target = room(1, 200), room(2, 200)
    found = [
        refine(source, target, Similarity.identity(), (0.1,), threads=threads).matrix.tobytes() for threads in (1, 2)
    ]
    assert found[0] == found[1]
    if hasattr(open3d.utility, 'get_max_threads'):
        assert open3d.utility.get_max_threads() == 2
