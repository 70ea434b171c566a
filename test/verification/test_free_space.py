"""What a sensor has looked through is empty."""

import numpy as np
import pytest
from scenes import ball

from csgm_ros.verification.free_space import seen_through

RNG = np.random.default_rng(0)
EYE = np.array([3.0, -1.0, 2.0])
WALL = EYE + ball(RNG, (0, 0, 0), 5.0, 300)
SOME = WALL[RNG.permutation(len(WALL))[:2000]]


def at(share):
    """Points on the way to the wall."""
    return EYE + share * (SOME - EYE)


@pytest.mark.parametrize(('share', 'expected'), [(0.5, 1.0), (0.9, 1.0), (1.0, 0.0), (1.03, 0.0)])
def test_what_lies_before_the_surface_was_looked_through_and_what_lies_on_it_not(share, expected):
    assert seen_through(at(share), WALL, EYE) == pytest.approx(expected, abs=0.01)


def test_what_lies_behind_does_not_count():
    assert seen_through(at(2.0), WALL, EYE) is None
    half = np.concatenate([at(1.0), at(2.0)])
    assert seen_through(half, WALL, EYE) == pytest.approx(0.0, abs=0.01)


def test_shares_are_of_what_was_tested():
    mixed = np.concatenate([at(0.5)[:500], at(1.0)[500:2000]])
    assert seen_through(mixed, WALL, EYE) == pytest.approx(0.25, abs=0.01)


def test_where_the_sensor_has_not_looked_nothing_is_said():
    upper = WALL[WALL[:, 2] > EYE[2] + 1.0]
    below = at(0.5)[SOME[:, 2] < EYE[2] - 1.0]
    assert seen_through(below, upper, EYE) is None


def test_pose_and_unit_do_not_matter_to_the_share():
    mixed = np.concatenate([at(0.5)[:500], at(1.0)[500:2000]])
    assert seen_through(7.0 * mixed, 7.0 * WALL, 7.0 * EYE) == pytest.approx(seen_through(mixed, WALL, EYE), abs=1e-9)
