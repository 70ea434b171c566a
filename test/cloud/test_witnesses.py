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


def test_an_enlarged_cloud_has_the_same_witnesses_but_for_their_size():
    points, _ = cube(12000)
    made = [witnesses.witnesses(f * points, f * 0.05, f * 3.0, np.random.default_rng(0), 12) for f in (1.0, 2.7)]
    resized, built = made[0].resized(2.7), made[1]
    assert (resized.sample == built.sample).all()
    assert (resized.coplanar == built.coplanar).all()
    np.testing.assert_allclose(resized.points, built.points, atol=1e-9)
    ours, theirs = ((seen.cell, seen.gap, seen.grid.cell) for seen in (resized, built))
    np.testing.assert_allclose(ours, theirs)
    same = resized.grid.index[1] == built.grid.index[1]  # but for cells whose centres are as near to two points
    assert same.mean() > 0.999
