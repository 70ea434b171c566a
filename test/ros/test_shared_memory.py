"""Segments of Fast DDS in /dev/shm: those of the dead go, those of the living stay."""

import fcntl
import os
import signal
import time

import pytest

pytest.importorskip('rclpy')

from ros_helpers.restarts import restarts

from csgm_ros.ros.shared_memory import FOLDER, remove_stale

pytestmark = pytest.mark.ros


def segment(folder, name, age=60.0):
    """Make a segment and its lock, as Fast DDS does."""
    lock = folder / f'fastrtps_{name}_el'
    for path in (folder / f'fastrtps_{name}', lock):
        path.touch()
        os.utime(path, (time.time() - age,) * 2)
    return lock


def test_what_nobody_holds_is_removed_and_nothing_else(tmp_path):
    segment(tmp_path, 'a' * 16)
    segment(tmp_path, 'c' * 16, age=0.0)  # its process may be about to lock it
    segment(tmp_path, 'port7411')  # the next process of the domain takes it over
    (tmp_path / 'somebody_else_el').touch()
    with segment(tmp_path, 'b' * 16).open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert remove_stale(tmp_path) == 1
    left = {path.name.removesuffix('_el') for path in tmp_path.iterdir()}
    assert left == {f'fastrtps_{"b" * 16}', f'fastrtps_{"c" * 16}', 'fastrtps_port7411', 'somebody_else'}


@pytest.mark.slow
def test_starts_and_stops_leave_no_shared_memory_behind():
    """By SIGTERM, by SIGINT, and by SIGKILL, which only the next start can mend."""
    if not FOLDER.is_dir():
        pytest.skip('no /dev/shm here')

    for sent, code, used, left, later in restarts(3):
        assert used > 0.0
        assert code == (0 if sent != signal.SIGKILL else -signal.SIGKILL)
        assert sent == signal.SIGKILL or left == 0.0, sent
        assert later == 0.0, sent
