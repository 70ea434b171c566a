"""Transforms to /tf and /tf_static, straight through their message.

The static broadcaster of tf2_ros in Jazzy keeps the first transform of a child frame and ignores every later
one; a registration that is repeated has to replace it.
"""

from __future__ import annotations

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from csgm_ros.ros.qos import LATCHED

MOVING, STATIC = ('/tf', QoSProfile(depth=100)), ('/tf_static', LATCHED)


class Broadcaster:
    """Sends one transform at a time, in place of the last one; says once where tf2_msgs is not installed.

    Parameters
    ----------
    node : Node
    kind : tuple
        MOVING or STATIC.
    """

    def __init__(self, node: Node, kind: tuple[str, QoSProfile]):
        self._node = node
        self._topic, self._qos = kind
        self._publisher: Publisher | None = None
        self._missing = False

    def advertise(self) -> Publisher | None:
        """Make the publisher, so that listeners know it by its first transform; None without tf2_msgs."""
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            if not self._missing:
                self._node.get_logger().warning(f'tf2_msgs is not installed: nothing on {self._topic}')
            self._missing = True
            return None
        if self._publisher is None:
            self._publisher = self._node.create_publisher(TFMessage, self._topic, self._qos)
        return self._publisher

    def publish(self, transform: TransformStamped) -> None:
        """Send one transform."""
        publisher = self.advertise()
        if publisher is not None:
            from tf2_msgs.msg import TFMessage

            publisher.publish(TFMessage(transforms=[transform]))

    def destroy(self) -> None:
        """Take the publisher down."""
        if self._publisher is not None:
            self._node.destroy_publisher(self._publisher)
            self._publisher = None
