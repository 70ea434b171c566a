"""Pictures show clouds the right way up, whole, and close enough to judge by."""

import numpy as np

from csgm_ros.io.cloud_file import CloudFile
from csgm_ros.visual.pictures import PAPER, draw, upright
from csgm_ros.visual.slices import common, slices


def test_clouds_are_looked_at_the_right_way_up():
    rng = np.random.default_rng(0)
    place = rng.random((3000, 3)) * (8.0, 5.0, 1.0)
    right, down, away = upright(place - (4.0, 2.5, 0.5))
    assert down @ (0, 0, -1) > 0.99
    assert abs(right[0]) > 0.99
    assert np.allclose(np.cross(right, down), away)
    seen = rng.random((3000, 3)) * (2.0, 2.0, 1.0) + (-1.0, -1.0, 2.0)  # from the origin along z
    assert np.array_equal(upright(seen), np.eye(3))


def test_a_small_cloud_in_a_large_one_is_looked_at_from_near():
    rng = np.random.default_rng(1)
    large = rng.random((20_000, 3)) * (50.0, 50.0, 3.0)
    small = rng.random((2000, 3)) * (4.0, 3.0, 2.0) + (30.0, 10.0, 0.0)
    low, high = common(small, large)
    assert (low < small.min(axis=0)).all()
    assert (high > small.max(axis=0)).all()
    assert (high - low < 10.0).all()
    low, high = common(small + 100.0, large)  # apart: all of both
    assert (low < 1.0).all()
    assert (high > 101.0).all()
    drawn = slices(small, large)[2][1]
    orange_or_dark = (drawn[..., 2] < 0.5).mean()
    assert orange_or_dark > 0.015


def test_what_sticks_out_a_little_is_drawn_and_a_stray_point_makes_nothing_small():
    rng = np.random.default_rng(2)
    body = np.column_stack([rng.random((20_000, 2)), np.zeros(20_000)])
    rod = np.column_stack([np.full(40, 0.5), np.linspace(1.0, 1.1, 40), np.zeros(40)])
    red, dark = np.array([1.0, 0.0, 0.0]), np.zeros(3)
    clouds = [CloudFile(body, np.tile(dark, (len(body), 1))), CloudFile(rod, np.tile(red, (len(rod), 1)))]
    alone = draw(clouds, np.eye(3))
    reddish = (alone[..., 0] > 0.9) & (alone[..., 1] < 0.5)
    assert reddish.any(axis=1).sum() > 30  # the rod in its length, not cut off at the edge
    stray = CloudFile(np.array([[50.0, 0.5, 0.0]]), dark[None])
    drawn = (draw([*clouds, stray], np.eye(3)) < PAPER - 0.3).any(axis=2)
    assert drawn.mean() > 0.2
