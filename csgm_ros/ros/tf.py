"""The rigid part on /tf_static, straight through its message.

The static broadcaster of tf2_ros in Jazzy keeps the first transform of a child frame and ignores every later
one; a registration that is repeated has to replace it.
"""

from __future__ import annotations

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.publisher import Publisher

from csgm_ros.ros.qos import LATCHED


class StaticTransform:
    """Publishes the newest transform, latched; says once where tf2_msgs is not installed."""

    def __init__(self, node: Node):
        self._node = node
        self._publisher: Publisher | None = None
        self._missing = False

    def publish(self, transform: TransformStamped) -> None:
        """Send one transform to /tf_static in place of the last one."""
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            if not self._missing:
                self._node.get_logger().warning(
                    'publish_tf is on, but tf2_msgs is not installed: nothing on /tf_static'
                )
            self._missing = True
            return
        if self._publisher is None:
            self._publisher = self._node.create_publisher(TFMessage, '/tf_static', LATCHED)
        self._publisher.publish(TFMessage(transforms=[transform]))

    def destroy(self) -> None:
        """Take the publisher down."""
        if self._publisher is not None:
            self._node.destroy_publisher(self._publisher)
            self._publisher = None
