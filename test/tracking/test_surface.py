"""A surface's nearest point, beside a search through all of them."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from csgm_ros.tracking import surface


def nearest(seen, places):
    points, _, *table = seen
    return np.array([surface.nearest(points, *table, *place) for place in places])


def plane(rng):
    return np.column_stack([rng.uniform(-1.0, 1.0, (20000, 2)), np.zeros(20000)])


def dust(rng):
    """Points so far apart that next to no two have a voxel's corner in common."""
    return rng.uniform(-30.0, 30.0, (3000, 3))


@pytest.mark.parametrize('make', [plane, dust])
def test_what_is_within_half_a_voxel_is_found_and_nothing_beyond_the_voxels_around(make):
    rng, voxel = np.random.default_rng(0), 0.1
    points = make(rng)
    seen = surface.build(points, np.tile((0.0, 0.0, 1.0), (len(points), 1)), voxel)
    places = points[:2000] + rng.uniform(-0.25, 0.25, (2000, 3))
    distances, truth = cKDTree(seen.points).query(places)
    found = nearest(seen, places)
    near = distances < 0.5 * voxel
    assert near.any()
    assert (found[near] == truth[near]).all()
    assert (found[distances > 2.0 * np.sqrt(3.0) * voxel] < 0).all()
    there = found >= 0
    assert (np.linalg.norm(seen.points[found[there]] - places[there], axis=1) < 2.0 * np.sqrt(3.0) * voxel).all()


def test_nothing_is_found_outside_of_the_lattice():
    rng = np.random.default_rng(0)
    seen = surface.build(plane(rng), np.tile((0.0, 0.0, 1.0), (20000, 1)), 0.1)
    assert (nearest(seen, 1e9 * rng.normal(size=(50, 3))) < 0).all()


def test_where_normals_cancel_there_is_no_surface():
    points = np.zeros((2, 3))
    seen = surface.build(points, np.array([(0.0, 0.0, 1.0), (0.0, 0.0, -1.0)]), 0.1)
    assert len(seen.points) == 0
    assert nearest(seen, points)[0] == -1
