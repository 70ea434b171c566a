"""The demonstration of tracking: the walk is one, and what would be wrong with an answer is said."""

import numpy as np
import pytest

from csgm_ros.demo.track import complaints, told
from csgm_ros.demo.walk import BLOCKED, KIDNAPPED, RATE, Walk, carried
from csgm_ros.types import Similarity
from csgm_ros.visual.paths import draw_paths


@pytest.fixture(scope='module')
def made():
    """The walk without what was seen."""
    times = np.arange(0.0, 24.0, 1.0 / RATE)
    times = times[(times < KIDNAPPED[0]) | (times >= sum(KIDNAPPED))]
    gauge = Similarity(3.0, np.eye(3), np.ones(3))
    blocked = (times >= BLOCKED[0]) & (times < BLOCKED[1])
    truth = [gauge @ carried(time) for time in times]
    return Walk(np.random.default_rng(0).normal(size=(100, 3)), times, np.empty(0), truth, blocked, gauge)


def answers(made, frames):
    """What a node would give out that knows the truth of these frames."""
    pytest.importorskip('rclpy')
    return told(made, [(round(1e9 * (1000.0 + made.stamps[k])), made.truth[k]) for k in frames])


def test_the_sensor_walks_and_is_put_elsewhere_once(made):
    places = np.array([made.gauge.inverse().apply(pose.translation[None])[0] for pose in made.truth])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    jump = np.argmax(np.diff(made.stamps))
    assert steps[jump] > 0.5
    assert np.delete(steps, jump).max() < 0.05


def test_a_right_answer_has_no_complaint_and_each_fault_has_its_own(made):
    seen = np.flatnonzero(~made.blocked)
    assert complaints(made, answers(made, seen)) == []
    assert complaints(made, answers(made, [])) == ['no pose was given out']
    assert 'blocked' in complaints(made, answers(made, range(len(made.stamps))))[0]
    late = [k for k in seen if made.stamps[k] < BLOCKED[0] or made.stamps[k] > BLOCKED[1] + 6]
    assert complaints(made, answers(made, late)) == ['not found again within 5 s of being blocked']
    found = answers(made, seen)
    found.metres[seen[3]] = 0.2
    assert complaints(made, found) == ['1 poses are wrong']


def test_the_picture_is_drawn(made, tmp_path):
    places = np.array([pose.translation for pose in made.truth])
    found = np.where(made.blocked[:, None], np.nan, places + 0.01)
    draw_paths(tmp_path / 'paths.png', made.map_points, made.stamps, places, found, made.blocked, 'as an example')
    assert (tmp_path / 'paths.png').read_bytes().startswith(b'\x89PNG')
