"""The look-up table of nearest points, beside a k-d tree."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import room
from scipy.spatial import cKDTree

from csgm_ros.cloud import nearest_grid

SEEDS = st.integers(0, 2**32 - 1)


def grid_of(points, cell, reach):
    return nearest_grid.build(points, np.zeros_like(points), cell, reach)


def looked_up(grid, queries):
    return np.array([nearest_grid.lookup(grid.index, grid.origin, grid.cell, *query) for query in queries])


@settings(max_examples=30, deadline=None)
@given(SEEDS, st.integers(1, 200), st.floats(0.02, 0.1), st.floats(0.03, 0.3))
def test_every_cell_names_the_point_nearest_to_its_centre(seed, count, cell, reach):
    points = np.random.default_rng(seed).random((count, 3)) * (1.0, 0.7, 0.3)
    grid = grid_of(points, cell, reach)
    assert grid.cell == cell
    sides = nearest_grid.BLOCK * np.array(grid.index[0].shape)
    centres = grid.origin + cell * (np.argwhere(np.ones(sides)) + 0.5)
    centres = centres[:: len(centres) // 5000 + 1]
    named, (true, _) = looked_up(grid, centres), cKDTree(points).query(centres)
    near = np.abs(true - reach) > 1e-5  # at the very reach, rounding decides
    np.testing.assert_array_equal((named >= 0)[near], (true < reach)[near])
    found = np.linalg.norm(points[named[named >= 0]] - centres[named >= 0], axis=1)
    np.testing.assert_allclose(found, true[named >= 0], atol=1e-5)


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_a_distance_is_too_long_by_at_most_a_cells_diagonal(seed):
    rng = np.random.default_rng(seed)
    points = rng.random((300, 3))
    grid = grid_of(points, 0.05, 0.2)
    queries = rng.uniform(-0.4, 1.4, (500, 3))
    true, _ = cKDTree(points).query(queries)
    named, half = looked_up(grid, queries), 0.05 * np.sqrt(3) / 2
    assert (named[true < 0.2 - half] >= 0).all()
    assert (named[true > 0.2 + half] == -1).all()
    hit = named >= 0
    found = np.linalg.norm(points[named[hit]] - queries[hit], axis=1)
    assert (found >= true[hit] - 1e-12).all()
    assert (found <= true[hit] + 2 * half).all()


def test_far_away_there_is_nothing():
    grid = grid_of(room(0, 20), 0.1, 0.3)
    far = np.concatenate([np.eye(3), -np.eye(3)]) * 100.0
    assert (looked_up(grid, far) == -1).all()
    assert (looked_up(grid, far * 1e12) == -1).all()


def test_one_point():
    grid = grid_of(np.array([[5.0, -3.0, 2.0]]), 0.1, 0.25)
    assert looked_up(grid, [[5.0, -3.0, 2.0], [5.15, -3.0, 2.0], [5.4, -3.0, 2.0]]).tolist() == [0, 0, -1]


@pytest.mark.parametrize('distance', [1e2, 1e5])
def test_a_point_far_from_all_others_does_not_fill_the_memory(distance):
    points = np.concatenate([room(0, 50), np.full((1, 3), distance)])
    grid = grid_of(points, 0.015, 0.045)
    assert grid.index[0].size < 1.1 * nearest_grid.MAX_BLOCKS
    assert len(grid.index[1]) <= nearest_grid.MAX_KEPT


def test_points_all_over_the_space_do_not_fill_the_memory():
    points = np.random.default_rng(0).uniform(0.0, 1e3, (3000, 3))
    grid = grid_of(points, 0.5, 20.0)
    assert len(grid.index[1]) <= nearest_grid.MAX_KEPT
    named = looked_up(grid, points[:100])
    assert (np.linalg.norm(points[named] - points[:100], axis=1) < np.sqrt(3) * grid.cell).all()


def test_air_takes_no_memory():
    floor = np.random.default_rng(0).uniform((0.0, 0.0, 0.0), (10.0, 10.0, 0.01), (20000, 3))
    pole = np.random.default_rng(1).uniform((0.0, 0.0, 0.0), (0.01, 0.01, 10.0), (2000, 3))
    grid = grid_of(np.concatenate([floor, pole]), 0.05, 0.2)
    assert grid.index[1].size < 0.2 * grid.index[0].size * nearest_grid.BLOCK**3
