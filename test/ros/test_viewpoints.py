"""From where the clouds of a request were seen: the origin of an organised message's frame, or one that TF knows."""

import numpy as np
import pytest

import csgm_ros
from csgm_ros.config import profile
from csgm_ros.errors import InputError
from csgm_ros.ros.cloud_msgs import cloud_message, header
from csgm_ros.ros.registration import Request, run, viewpoint_of
from csgm_ros.types import Similarity

PLACE = np.array([0.1, 0.2, 0.3])
POINTS = np.random.default_rng(0).normal(size=(12, 3))


def message(frame='camera', *, organised=False, points=POINTS):
    found = cloud_message(header(frame, 5 * 10**9), points)
    if organised:
        found.width, found.height = len(points) // 2, 2
        found.row_step = found.width * found.point_step
    return found


def request(*target, sensor='', lookup=None):
    return Request([message()], list(target), profile(), 0, 0.0, sensors=('', sensor), lookup=lookup)


def told(fixed, frame, stamp):
    assert (fixed, frame, stamp) == ('map', 'lidar', 5 * 10**9)
    return Similarity(1.0, np.eye(3), PLACE)


def unknown(*_):
    raise InputError('TF does not connect them')


@pytest.mark.parametrize(
    ('given', 'expected'),
    [
        (request(message()), None),  # a map may be in any frame
        (request(message(organised=True)), np.zeros(3)),
        (request(message(organised=True), message(organised=True)), None),  # two frames, two places
        (request(message('lidar'), sensor='lidar'), np.zeros(3)),
        (request(message('map'), sensor='lidar', lookup=told), PLACE),
        (request(message('map', organised=True), sensor='lidar', lookup=told), PLACE),
    ],
)
def test_the_viewpoint_is_the_origin_of_the_sensors_frame(given, expected):
    found = viewpoint_of(given, 'target')
    assert (found is None) == (expected is None)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize('lookup', [None, unknown])
def test_a_frame_that_nobody_knows_is_named(lookup):
    with pytest.raises(InputError, match='target_viewpoint'):
        viewpoint_of(request(message('map'), sensor='lidar', lookup=lookup), 'target')


def test_a_registration_is_told_the_viewpoints(monkeypatch):
    told_of = {}
    monkeypatch.setattr(csgm_ros, 'register', lambda *_, **options: told_of.update(options))
    run(request(message(organised=True)), lambda *_: None)
    assert told_of['source_viewpoint'] is None
    np.testing.assert_array_equal(told_of['target_viewpoint'], np.zeros(3))
