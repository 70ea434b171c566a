"""How much each point of a cloud says."""

import numpy as np
import pytest

from csgm_ros.cloud import witnesses
from csgm_ros.cloud.witnesses import asked


def cube(count, rng=None):
    """Points on three faces of a cube and a few anywhere, with their normals."""
    rng = np.random.default_rng(0) if rng is None else rng
    points, normals = rng.uniform(size=(count, 3)), np.zeros((count, 3))
    axis = rng.integers(3, size=count)
    loose = rng.random(count) < 0.05
    points[np.arange(count), axis] *= loose
    normals[np.arange(count), axis] = 1.0
    turned = rng.normal(size=(count, 3))
    normals[loose] = (turned / np.linalg.norm(turned, axis=1, keepdims=True))[loose]
    return points, normals


def planes(count, least):
    points, normals = cube(12000)
    seen = asked(points, normals, 0.05, 3.0, np.random.default_rng(0), 12, count, least)
    return len(seen.sample), (1.0 / seen.coplanar).sum()


def test_points_that_are_only_asked_do_not_make_more_planes():
    few, independent = planes(1000, 0)
    many, as_independent = planes(1000, 8000)
    assert (few, many) == (1000, 8000)
    assert as_independent == pytest.approx(independent, rel=0.15)
    assert planes(8000, 0)[1] > 2.0 * independent  # as these would, in number


def test_clouds_of_few_points_are_asked_for_all_of_them():
    points, _ = cube(900)
    seen = witnesses.witnesses(points, 0.05, 3.0, np.random.default_rng(0), 12)
    assert len(seen.sample) == len(seen.points)
    assert seen.coplanar.min() >= 1.0
