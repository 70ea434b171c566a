"""A process that stands for two sensors: publishes a source and a target cloud until it is told to stop."""

from __future__ import annotations

import sys

import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2

from csgm_ros.ros.client.standin import publish_file
from csgm_ros.ros.cloud_msgs import cloud_message, header
from csgm_ros.ros.qos import LATCHED

PERIOD = 0.5  # seconds between two frames of the target


class Sensors(Node):
    """Publishes the source once, latched, as a map; and the target again and again, as a camera does.

    Parameters
    ----------
    clouds : mapping of str to ndarray
        ``source`` and ``target``, (N, 3) or organised (H, W, 3), and optionally ``source_colors`` and
        ``target_colors`` in uint8.
    """

    def __init__(self, clouds):
        super().__init__('sensors')
        frames = {'source': 'sfm', 'target': 'camera_depth_optical_frame'}
        now = self.get_clock().now().nanoseconds
        self._messages: dict[str, PointCloud2] = {}
        for name, frame in frames.items():
            colors = clouds.get(f'{name}_colors')
            self._messages[name] = cloud_message(header(frame, now), np.asarray(clouds[name]), colors)
        self._source = self.create_publisher(PointCloud2, 'source', LATCHED)
        self._target = self.create_publisher(PointCloud2, 'target', QoSProfile(depth=2))
        self._source.publish(self._messages['source'])
        self.create_timer(PERIOD, self._publish_frame)

    def _publish_frame(self) -> None:
        message = self._messages['target']
        message.header.stamp = self.get_clock().now().to_msg()
        self._target.publish(message)


def main(arguments: list[str] | None = None) -> int:
    """Publish the clouds of an .npz file until SIGINT or SIGTERM."""
    return publish_file(Sensors, arguments)


if __name__ == '__main__':
    sys.exit(main())
