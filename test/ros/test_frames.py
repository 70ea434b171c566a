"""Where a frame was at a time: the stand-in has the semantics of tf2, and tf2 is what is used where it is there."""

import sys
import threading
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy')

from hypothesis import given
from hypothesis import strategies as st

from csgm_ros.errors import InputError
from csgm_ros.ros.cloud_msgs import header, transform_message
from csgm_ros.ros.frames import CACHE, Frames, Tree
from csgm_ros.types import Similarity

SECOND = 10**9


def shifted(x):
    return Similarity(1.0, np.eye(3), np.array([x, 0.0, 0.0]))


def turned(angle):
    c, s = np.cos(angle), np.sin(angle)
    return Similarity(1.0, np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))


def tree(*transforms):
    """Return a tree of (parent, child, stamp in s or None for static, transform)."""
    made = Tree()
    for parent, child, stamp, transform in transforms:
        at = 0 if stamp is None else round(stamp * SECOND)
        made.add(transform_message(header(parent, at), child, transform), static=stamp is None)
    return made


def test_only_the_frames_between_the_two_have_to_be_known_at_the_time():
    """map -> odom comes late and is not asked for: clouds are merged in odom all the same."""
    known = tree(
        ('map', 'odom', 1.0, shifted(100.0)),
        ('odom', 'base', 1.0, shifted(1.0)),
        ('odom', 'base', 3.0, shifted(3.0)),
        ('base', 'camera', None, shifted(0.5)),
    )
    np.testing.assert_allclose(known.lookup('odom', 'camera', 2 * SECOND).translation, [2.5, 0.0, 0.0])
    np.testing.assert_allclose(known.lookup('camera', 'odom', 2 * SECOND).translation, [-2.5, 0.0, 0.0])
    with pytest.raises(InputError, match=r'1.00 s off the transforms received of odom'):
        known.lookup('map', 'camera', 2 * SECOND)


def test_siblings_are_connected_through_their_parent():
    known = tree(('base', 'left', None, shifted(1.0)), ('base', 'right', None, shifted(-1.0)))
    np.testing.assert_allclose(known.lookup('left', 'right', 0).translation, [-2.0, 0.0, 0.0])
    np.testing.assert_array_equal(known.lookup('left', 'left', 0).matrix, np.eye(4))
    with pytest.raises(InputError, match='does not connect left with odom; known are left, right'):
        known.lookup('odom', 'left', 0)


@given(st.floats(0.0, 1.0))
def test_between_two_transforms_the_rotation_follows_the_shorter_arc(weight):
    known = tree(('map', 'camera', 1.0, turned(0.1)), ('map', 'camera', 2.0, turned(0.3)))
    found = known.lookup('map', 'camera', round((1.0 + weight) * SECOND))
    np.testing.assert_allclose(found.matrix, turned(0.1 + 0.2 * weight).matrix, atol=2e-3)


def test_nothing_is_extrapolated_and_stamp_0_is_the_newest():
    known = tree(('map', 'camera', 1.0, shifted(1.0)), ('map', 'camera', 2.0, shifted(2.0)))
    for stamp in (SECOND - 1, 2 * SECOND + 1):
        with pytest.raises(InputError, match='off the transforms'):
            known.lookup('map', 'camera', stamp)
    for stamp, x in ((SECOND, 1.0), (2 * SECOND, 2.0), (0, 2.0)):
        assert known.lookup('map', 'camera', stamp).translation[0] == x


def test_a_transform_that_is_late_is_waited_for():
    known = tree(('map', 'camera', 1.0, shifted(1.0)))
    timer = threading.Timer(
        0.05, known.add, [transform_message(header('map', 2 * SECOND), 'camera', shifted(3.0))], {'static': False}
    )
    timer.start()
    np.testing.assert_allclose(known.lookup('map', 'camera', SECOND + SECOND // 2, 10.0).translation, [2.0, 0.0, 0.0])
    with pytest.raises(InputError):
        known.lookup('map', 'camera', 9 * SECOND, 0.01)


def test_loops_and_impossible_transforms_do_no_harm():
    known = tree(('a', 'b', None, shifted(1.0)), ('b', 'a', None, shifted(1.0)))
    with pytest.raises(InputError, match='does not connect'):
        known.lookup('c', 'a', 0)
    broken = transform_message(header('a', 0), 'd', shifted(1.0))
    broken.transform.rotation.w = 0.0
    known.add(broken, static=True)
    with pytest.raises(InputError, match='does not connect'):
        known.lookup('a', 'd', 0)


def test_the_past_is_forgotten():
    known = Tree()
    for second in range(round(3 * CACHE)):
        known.add(transform_message(header('map', second * SECOND), 'camera', shifted(second)), static=False)
    assert len(known._stamps['camera']) == CACHE + 1


@pytest.fixture
def tf2(monkeypatch):
    """As much of tf2_ros as is used, with its names, keywords and errors, on top of the tree tested above."""
    pytest.importorskip('tf2_msgs.msg', reason='test/build_tf2_msgs.sh was not run')
    module = ModuleType('tf2_ros')

    class TransformException(Exception):
        pass

    class Buffer(Tree):
        def __init__(self, cache_time=None, node=None):
            super().__init__()
            assert cache_time.nanoseconds == CACHE * 1e9

        def lookup_transform(self, target_frame, source_frame, time, timeout):
            try:
                found = self.lookup(target_frame, source_frame, time.nanoseconds, timeout.nanoseconds / 1e9)
            except InputError as error:
                raise TransformException(error) from None
            return transform_message(header(target_frame, time.nanoseconds), source_frame, found)

    class TransformListener:
        def __init__(self, buffer, node):
            module.listeners.append((self, buffer))

        def unregister(self):
            module.listeners.remove(next(pair for pair in module.listeners if pair[0] is self))

    module.TransformException, module.Buffer, module.TransformListener = TransformException, Buffer, TransformListener
    module.listeners = []
    monkeypatch.setitem(sys.modules, 'tf2_ros', module)
    return module


def test_tf2_is_used_where_it_is_installed(tf2):
    frames = Frames(SimpleNamespace())
    frames.listen()
    assert not tf2.listeners, 'it is closed'
    frames.open()
    frames.listen()
    frames.listen()
    ((_, buffer),) = tf2.listeners
    buffer.add(transform_message(header('map', SECOND), 'camera', turned(0.5)), static=False)
    np.testing.assert_allclose(frames.lookup('map', 'camera', SECOND).matrix, turned(0.5).matrix, atol=1e-12)
    with pytest.raises(InputError, match=r'TF does not tell where camera was in map: .* 3\.00 s off'):
        frames.lookup('map', 'camera', 4 * SECOND)
    with pytest.raises(InputError, match='TF does not tell'):
        frames.lookup('map', 'camera', -1)
    frames.close()
    frames.listen()
    assert not tf2.listeners, 'nothing comes back after the node is deactivated'
    with pytest.raises(InputError, match='not listened to'):
        frames.lookup('map', 'camera', SECOND)
