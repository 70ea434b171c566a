"""Where a submap lies in a map: what makes a place certain, and that another map has none."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sequences import Sequence

from csgm_ros.config import profile
from csgm_ros.tracking import frames, localization
from csgm_ros.tracking.localization import Localizer, scale_of, scaling
from csgm_ros.tracking.maps import prepare_map
from csgm_ros.tracking.odometry import Odometry
from csgm_ros.tracking.part import Part
from csgm_ros.tracking.search import LOOKS, MOST_LEAD, Candidates, Query, judged, leads, look_again, search


def walked(sequence, first, count):
    """Return frames with their poses as the session has them, their voxel, and the pose of the last."""
    voxel = frames.resolution(sequence.points(first), profile().tracking.resolution)
    odometry, parts = Odometry(voxel, np.random.default_rng(0)), []
    for number in range(first, first + count):
        points = sequence.points(number)
        frame = frames.prepared(points[points[:, 2] > 0], voxel)
        assert odometry.add(frame, sequence.stamps[number])
        parts.append((frame, odometry.matrix.copy()))
    return parts, voxel, parts[-1][1]


@pytest.fixture(scope='module')
def seen(shared):
    """A submap, its map, and its true pose there."""
    kitchen = Sequence(shared / 'data' / 'sequence_kitchen')
    parts, voxel, _ = walked(kitchen, 50, 5)
    return localization.joined(parts, voxel), prepare_map(kitchen.map), kitchen.truth[50]


@pytest.fixture
def fresh(seen):
    """A second look, and its true pose."""
    made, prepared, truth = seen
    return Localizer(made, prepared, np.random.default_rng(0)), truth


def test_a_place_leads_over_its_rivals_alone_and_no_more_than_counts():
    scores = np.array((0.4, 0.35, 0.2, 0.01))
    rivals = np.array([[0, 0, 1, 1], [0, 0, 1, 1], [1, 1, 0, 1], [1, 1, 1, 0]], bool)
    assert leads(scores, rivals) == pytest.approx((2.0, 1.75, 0.5, 0.025))
    assert leads(scores[:2], rivals[:2, :2]).tolist() == [MOST_LEAD] * 2  # nothing to compare with


def turned(matrix, degrees):
    """Return a pose that looks elsewhere from the same point."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler('y', degrees, degrees=True).as_matrix()
    return matrix @ turn


def test_another_place_is_a_rival_and_the_same_at_another_scale_is_none(fresh):
    localizer, truth = fresh
    larger = [truth @ scaling(factor, np.zeros(3)) for factor in (1.15, 1.6)]
    places = [localizer.weighed(matrix) for matrix in (truth, *larger, turned(truth, 90))]
    assert localizer.rivals(places)[0].tolist() == [False, False, True, True]


@pytest.mark.parametrize(('angles', 'certain'), [((0, 90, 180), True), ((90, 180), False)])
def test_views_and_surfaces_make_the_right_place_certain_and_no_other(seen, angles, certain):
    submap, prepared, truth = seen
    localizer = Localizer(submap, prepared, np.random.default_rng(0))
    part = Part(submap.within(1.5), prepared.points, 0)
    places = localizer.distinct([localizer.weighed(turned(truth, angle)) for angle in angles])
    found = judged(places, part, localizer, Query((), submap.voxel, None, None, np.eye(4)))
    assert (found.matrix is not None) is certain
    assert found.candidates is None
    assert not certain or scale_of(found.matrix) == pytest.approx(scale_of(truth))


@pytest.mark.parametrize(
    ('odds', 'expected'),
    [
        ((2.0, 1.0, 0.9), True),
        ((1.0, 2.6, 0.8), False),  # what was the best at first is so no more, and what is now was not
        ((1.01, 1.0, 0.9), False),  # once is not enough
    ],
)
def test_of_two_looks_the_second_decides_but_not_alone(fresh, odds, expected):
    localizer, truth = fresh
    matrices = np.stack([truth, turned(truth, 90), turned(truth, 180)])
    found = look_again(Candidates(matrices, np.array(odds), 1), localizer)
    assert (found.matrix is not None) is expected
    assert not expected or localizer.alike(found.matrix, truth)


def test_places_that_are_all_wrong_are_dropped_after_some_looks(fresh):
    localizer, truth = fresh
    candidates = Candidates(np.stack([turned(truth, angle) for angle in (90, 180, 270)]), np.array((2.6, 0.9, 0.8)), 1)
    for _ in range(LOOKS):
        found = look_again(candidates, localizer)
        assert found.matrix is None
        if found.candidates is None:
            return
        candidates = found.candidates
    raise AssertionError(candidates)


@pytest.mark.parametrize('place', ['kitchen', 'desk'])
def test_a_kitchen_is_found_in_its_own_map_and_in_no_other(shared, place):
    kitchen = Sequence(shared / 'data' / 'sequence_kitchen')
    map_ = Sequence(shared / 'data' / f'sequence_{place}').map
    parts, voxel, sensor = walked(kitchen, 40, 10)
    found = search(Query(parts, voxel, None, None, sensor, reach=1.5), prepare_map(map_), profile(), 0)
    if place == 'desk':
        assert found.matrix is None
    else:
        assert kitchen.right(49, found.matrix @ sensor)


@pytest.mark.parametrize(('first', 'turn'), [(36, 0), (44, 180), (58, 90)])
def test_of_two_kitchens_alike_on_one_floor_neither_is_believed(shared, first, turn):
    kitchen = Sequence(shared / 'data' / 'sequence_kitchen')
    parts, voxel, sensor = walked(kitchen, first, 10)
    order = np.random.default_rng(0).permutation(len(kitchen.map))
    one, other = (kitchen.map[half] for half in np.array_split(order, 2))
    up, aside = np.array(((-0.691, 0.702, 0.175), (0.713, 0.673, 0.116)))  # of the map
    rotation, middle = Rotation.from_rotvec(turn * up, degrees=True).as_matrix(), np.median(kitchen.map, axis=0)
    length = 1.5 * np.ptp(kitchen.map @ aside)
    both = np.concatenate([one, (other - middle) @ rotation.T + middle + length * aside])
    assert search(Query(parts, voxel, None, None, sensor, reach=1.5), prepare_map(both), profile(), 0).matrix is None
