"""What a bag may name: message types that are installed, and nothing that lies about."""

import subprocess
import sys

import pytest

pytest.importorskip('rclpy')

from sensor_msgs.msg import PointCloud2

from csgm_ros.ros.client.player import message_type

pytestmark = pytest.mark.ros


def test_installed_messages_are_found():
    assert message_type('sensor_msgs/msg/PointCloud2') is PointCloud2


@pytest.mark.parametrize(
    'name',
    [
        *('os/msg/Path', 'sensor_msgs/msg/Nothing', 'sensor_msgs/srv/SetCameraInfo', 'nowhere_msgs/msg/Cloud'),
        *('../evil/msg/Cloud', 'sensor_msgs/msg/__doc__', 'sensor_msgs.msg/msg/Image', '', '/msg/', 'PointCloud2'),
    ],
)
def test_nothing_else_is(name):
    with pytest.raises((ImportError, AttributeError, ValueError)):
        message_type(name)


@pytest.mark.parametrize('package', ['evil_msgs', 'nav_msgs'])
def test_code_beside_the_bag_is_not_run(tmp_path, package):
    """Neither under a name of its own nor under that of an installed package."""
    (tmp_path / package / 'msg').mkdir(parents=True)
    for folder in (package, f'{package}/msg'):
        (tmp_path / folder / '__init__.py').write_text(
            f'print("run"); open({str(tmp_path / "ran")!r}, "w")\nPath = int'
        )
    script = f"""
import sys
from csgm_ros.ros.client.player import message_type
sys.path.insert(0, '')  # as `python -m` has it
try:
    print(message_type('{package}/msg/Path'))
except Exception as error:
    print(error)
"""
    done = subprocess.run(
        [sys.executable, '-c', script], cwd=tmp_path, capture_output=True, text=True, timeout=60, env=None
    )
    assert 'no installed ROS interface package' in done.stdout, done.stderr
    assert not (tmp_path / 'ran').exists()
