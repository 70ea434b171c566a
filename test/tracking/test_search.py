"""Where a submap lies in a map: what makes a place certain, and that another map has none."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sequences import Sequence

from csgm_ros.config import profile
from csgm_ros.tracking import frames, localization
from csgm_ros.tracking.evidence import Evidence
from csgm_ros.tracking.localization import Localizer
from csgm_ros.tracking.maps import prepare_map
from csgm_ros.tracking.odometry import Odometry
from csgm_ros.tracking.search import LOOKS, MARGIN, Candidates, Query, certain, look_again, search
from csgm_ros.types import Term, Verdict

SEEN = Evidence(0.3, 0.8, 0.92, 1500)


def verdict(margin, *terms):
    lead = Term('lead', margin, 2.3, True, MARGIN)
    return Verdict(margin >= 2.3, '', 0.5, 0.5, 0.01, margin, (lead, *terms))


@pytest.mark.parametrize(
    ('lead', 'evidence', 'judged', 'expected'),
    [
        (2.5, SEEN, verdict(4.0), True),
        (1.7, SEEN, verdict(2.0), True),  # neither would do alone
        (1.1, SEEN, verdict(4.0), False),  # the views see as much elsewhere
        (2.5, SEEN, verdict(0.9), False),  # the clouds fit better elsewhere
        (np.inf, SEEN, verdict(1.05), False),  # nothing to compare with is no proof
        (1.5, SEEN, verdict(1.5), False),
        (2.5, SEEN._replace(agreement=0.7), verdict(4.0), False),  # much was looked through
        (2.5, SEEN, verdict(4.0, Term('mirrored', 0.99, 0.9, False, 'x')), False),
    ],
)
def test_views_and_verdict_make_a_place_certain_together(lead, evidence, judged, expected):
    assert certain(lead, evidence, judged) is expected


def submap(sequence, first, count):
    """Join frames as the session does."""
    voxel = frames.resolution(sequence.points(first), profile().tracking.resolution)
    odometry, parts = Odometry(voxel, np.random.default_rng(0)), []
    for number in range(first, first + count):
        points = sequence.points(number)
        frame = frames.prepared(points[points[:, 2] > 0], voxel)
        assert odometry.add(frame, sequence.stamps[number])
        parts.append((frame, odometry.matrix.copy()))
    return localization.joined(parts, voxel), parts[-1][1]


@pytest.fixture(scope='module')
def fresh(shared):
    """A second look: its map, and its true pose there."""
    kitchen = Sequence(shared / 'data' / 'sequence_kitchen')
    seen, _ = submap(kitchen, 50, 5)
    return Localizer(seen, prepare_map(kitchen.map), np.random.default_rng(0)), kitchen.truth[50]


def turned(matrix, degrees):
    """Return a pose that looks elsewhere from the same point."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler('y', degrees, degrees=True).as_matrix()
    return matrix @ turn


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
    found = look_again(Candidates(matrices, np.array(odds), 1), localizer, fixed_scale=False)
    assert (found.matrix is not None) is expected
    assert not expected or localizer.alike(found.matrix, truth)


def test_places_that_are_all_wrong_are_dropped_after_some_looks(fresh):
    localizer, truth = fresh
    candidates = Candidates(np.stack([turned(truth, angle) for angle in (90, 180, 270)]), np.array((2.6, 0.9, 0.8)), 1)
    for _ in range(LOOKS):
        found = look_again(candidates, localizer, fixed_scale=False)
        assert found.matrix is None
        if found.candidates is None:
            return
        candidates = found.candidates
    raise AssertionError(candidates)


@pytest.mark.slow
@pytest.mark.parametrize('place', ['kitchen', 'desk'])
def test_a_kitchen_is_found_in_its_own_map_and_in_no_other(shared, place):
    kitchen = Sequence(shared / 'data' / 'sequence_kitchen')
    map_ = Sequence(shared / 'data' / f'sequence_{place}').map
    seen, sensor = submap(kitchen, 40, 10)
    found = search(Query(seen, None, None, sensor), prepare_map(map_), profile(), 0)
    if place == 'desk':
        assert found.matrix is None
    else:
        assert kitchen.right(49, found.matrix @ sensor)
