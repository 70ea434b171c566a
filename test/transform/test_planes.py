"""A small view in a large room: found without any length relative to the extent of either cloud."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from csgm_ros.cloud.cells import cells, working_size
from csgm_ros.cloud.planes import frame
from csgm_ros.transform.flight import scale_of
from csgm_ros.transform.ladder import Ladder
from csgm_ros.transform.planes import finalists, looks_at
from csgm_ros.types import Similarity

NOTHING = np.empty((0, 4, 4))


def box(rng, centre, size, count):
    """Points on the surface of a box."""
    points = rng.uniform(-0.5, 0.5, (count, 3))
    axis = rng.integers(3, size=count)
    points[np.arange(count), axis] = rng.choice((-0.5, 0.5), count)
    return centre + points * size


def hall(seed):
    """A floor of 12 by 9 m with one wall and boxes of all sizes, sampled anew by every seed; nothing repeats."""
    shapes, rng = np.random.default_rng(5), np.random.default_rng(seed)
    parts = [rng.uniform((0, 0, 0), (12, 9, 0.01), (24000, 3)), rng.uniform((0, 0, 0), (12, 0.01, 3), (8000, 3))]
    for _ in range(14):
        size = shapes.uniform(0.4, 1.8, 3)
        place = np.append(shapes.uniform((1, 1), (11, 8)), size[2] / 2)
        parts.append(box(rng, place, size, int(1200 * size.mean() ** 2) + 300))
    return np.concatenate(parts) + rng.normal(0, 0.01, (sum(map(len, parts)), 3))


def view(points):
    """What a sensor sees that looks at one corner: about a fifth."""
    return points[(points[:, 0] < 5.5) & (points[:, 1] < 4.5)]


def corner(points):
    """Less than a seventh."""
    return points[(points[:, 0] < 4.5) & (points[:, 1] < 3.8)]


@pytest.mark.parametrize('given', [True, False])
def test_a_part_is_found_in_the_whole_whatever_its_pose_and_scale(given):
    turn = Rotation.from_euler('xyz', (40, -70, 110), degrees=True).as_matrix()
    truth = Similarity(1.0 if given else 3.7, turn, np.array([5.0, -3.0, 2.0]))
    source, target = view(hall(1)), hall(2)
    ladder = Ladder(truth.inverse().apply(source), target, 0)
    scales = np.ones(1) if given else 3.7 * np.exp(np.arange(-1.03, 1.0, 0.1))
    found = finalists(ladder, scales, NOTHING)
    best = Similarity.from_matrix(found[0])
    assert best.displacement(truth, ladder.flights[0].part.points) < 0.15
    scores = ladder.scores(found)
    assert (np.diff(scores) <= 0).all()
    assert scores[0] > 1.5 * scores[1]


@pytest.mark.parametrize('given', [True, False])
def test_the_whole_is_laid_on_its_part(given):
    source, target = hall(2), corner(hall(1))
    scale = 1.0 if given else 3.7
    truth = Similarity(scale, Rotation.from_euler('xyz', (40, -70, 110), degrees=True).as_matrix(), np.ones(3))
    ladder = Ladder(truth.inverse().apply(source), target, 0)
    found = finalists(ladder, np.ones(1) if given else scale * np.exp(np.arange(-1.03, 1.0, 0.1)), NOTHING)
    best = Similarity.from_matrix(found[0]).inverse()
    assert best.displacement(truth.inverse(), target) * scale < 0.15


def test_scales_at_which_the_whole_shows_no_surface_are_left_out():
    ladder = Ladder(view(hall(1)), hall(2)[::40], 0)
    flight = ladder.flights[0]
    assert flight.resolved(8.0)  # a voxel holds several of its points
    assert not flight.resolved(1.0)  # about one, with nothing between them
    scales = np.array([1.0, 8.0])
    assert all(look.flight.resolved(scale) for look in looks_at(ladder, scales) for scale in look.scales)


@pytest.mark.parametrize('factor', [1e-7, 1e7])
def test_nothing_is_found_where_one_cloud_is_a_point_of_the_other(factor):
    ladder = Ladder(view(hall(1)), factor * hall(2), 0)
    found = finalists(ladder, np.ones(1), NOTHING)
    assert not ladder.scores(found).any()


def test_the_same_clouds_have_the_same_finalists():
    source, target = view(hall(1)), hall(2)
    first, second = (finalists(Ladder(source, target, 0), np.ones(1), NOTHING) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_a_known_transform_takes_part():
    source, target = view(hall(1)), hall(2)
    ladder = Ladder(source, target, 0)
    found = finalists(ladder, np.ones(1), np.eye(4)[None])
    assert ladder.alike(found[0], np.eye(4))


@pytest.mark.parametrize('unit', [1e-3, 1.0, 1e4])
def test_cells_follow_the_unit(unit):
    points = hall(1)
    size = working_size(unit * points, 4000)
    np.testing.assert_allclose(size, unit * working_size(points, 4000), rtol=0.1)
    rng = np.random.default_rng(0)
    assert 3000 < len(cells(unit * points, size, 8000, rng).points) < 4500


def test_cells_are_no_finer_than_the_points():
    points = np.random.default_rng(0).normal(size=(300, 3))
    assert len(cells(points, working_size(points, 4000), 8000, np.random.default_rng(0)).points) < 300


def test_the_largest_plane_is_the_floor_and_its_normal_points_up():
    points = hall(1)
    plane = cells(points, working_size(points, 4000), 8000, np.random.default_rng(0)).planes[0]
    assert plane.normal[2] > 0.999
    assert abs(plane.point[2]) < 0.05
    np.testing.assert_allclose(frame(plane.normal) @ plane.normal, (0, 0, 1), atol=1e-12)


def test_what_stands_on_a_floor_says_more_than_the_floor():
    source, target = view(hall(1)), hall(2)
    ladder = Ladder(source, target, 0)
    slid = np.eye(4)
    slid[0, 3] = 2.0  # the floor still lies on the floor
    right, wrong = ladder.scores([np.eye(4), slid])
    assert right > 5.0 * wrong


def test_clouds_without_any_surface_do_not_agree():
    line = np.linspace(0.0, 1.0, 600)[:, None] * (1.0, 0.0, 0.0)
    assert Ladder(line, hall(2), 0).scores([np.eye(4)]) == 0.0


def test_the_scale_of_a_matrix():
    np.testing.assert_allclose(scale_of(Similarity(2.5, np.eye(3), np.ones(3)).matrix), 2.5)
