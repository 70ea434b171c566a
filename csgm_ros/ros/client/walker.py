"""A process that stands for a sensor on its way through a map: publishes the map once, then frame after frame."""

from __future__ import annotations

import sys
import time

from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2

from csgm_ros.ros.client.standin import publish_file
from csgm_ros.ros.cloud_msgs import cloud_message, header
from csgm_ros.ros.qos import LATCHED

SENSOR, MAP = 'camera_depth_optical_frame', 'map'
BEGIN = 1000.0  # seconds: stamp of what was seen at time 0
LOOK = 0.005


class Walker(Node):
    """Publishes ``map`` and, once somebody listens, the ``frames`` at their ``stamps``.

    Parameters
    ----------
    recorded : mapping of str to ndarray
        ``map`` (N, 3), ``frames`` (F, H, W, 3) in metres, ``stamps`` (F,) in seconds, and the ``rate``: 1 is real
        time, less suits a machine that is too slow for it.
    """

    def __init__(self, recorded):
        super().__init__('walker')
        self._frames, self._stamps, self._rate = recorded['frames'], recorded['stamps'], float(recorded['rate'])
        self._map = self.create_publisher(PointCloud2, 'map', LATCHED)
        self._map.publish(cloud_message(header(MAP, int(1e9 * BEGIN)), recorded['map']))
        self._points = self.create_publisher(PointCloud2, 'points', QoSProfile(depth=5))
        self._next, self._started = 0, 0.0
        self.create_timer(LOOK, self._walk)

    def _walk(self) -> None:
        if not self._started:
            if self._points.get_subscription_count():
                self._started = time.monotonic() + 1.0  # in which the node sees what this publisher offers
            return
        walked = self._rate * (time.monotonic() - self._started)
        if self._next < len(self._stamps) and walked >= self._stamps[self._next]:
            head = header(SENSOR, int(1e9 * (BEGIN + self._stamps[self._next])))
            self._points.publish(cloud_message(head, self._frames[self._next]))
            self._next += 1


def main(arguments: list[str] | None = None) -> int:
    """Publish what an .npz file holds until SIGINT or SIGTERM."""
    return publish_file(Walker, arguments)


if __name__ == '__main__':
    sys.exit(main())
