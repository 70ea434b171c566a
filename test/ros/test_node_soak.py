"""The node under many hands and under load; `make soak` is the same for longer."""

import pytest

pytest.importorskip('rclpy')

from ros_helpers.soak import soak

pytestmark = [pytest.mark.ros, pytest.mark.slow]


@pytest.mark.timeout(600)
def test_three_clients_at_once_get_every_answer_while_clouds_arrive():
    """Parameters, register, cancel, deactivate, cleanup in any order, as fast as they are answered."""
    figures = soak(15.0, points=3000, rate=20.0, pause=0.02, rebirth=1e9)
    print(figures.table())
    assert not figures.unanswered
    assert not figures.tracebacks
    assert sum(sum(each) for each in figures.counts.values()) > 30


@pytest.mark.timeout(900)
def test_a_minute_under_load_leaves_nothing_behind():
    figures = soak(60.0)
    print(figures.table())
    assert not figures.complaints(most=float('inf'))  # a minute is warm-up; `make soak` asks for 5 %
