"""The other side of the node's topics and services, in the process of the test."""

import contextlib
import threading

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2

from ros_helpers.waiting import until

RELIABLE = QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE)
BEST_EFFORT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Inbox(list):
    """Messages heard on one topic, in order."""

    def wait(self, count=1, timeout=30.0):
        """Return the newest message once there are ``count``."""
        until(lambda: len(self) >= count, f'{count} messages, {len(self)} so far', timeout)
        return self[-1]


class Peer:
    """A node with its own context and a thread that spins it."""

    def __init__(self):
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node('peer', context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self):
        with contextlib.suppress(ExternalShutdownException):
            self._executor.spin()

    def close(self):
        self._executor.shutdown(timeout_sec=5)
        self._thread.join(5)
        self.node.destroy_node()
        self.context.try_shutdown()
        assert not self._thread.is_alive()

    def listen(self, topic, kind, qos=LATCHED):
        """Return the list that fills with what is heard on a topic."""
        inbox = Inbox()
        self.node.create_subscription(kind, topic, inbox.append, qos)
        return inbox

    def publisher(self, topic, qos=RELIABLE, kind=PointCloud2):
        return self.node.create_publisher(kind, topic, qos)

    def send(self, topic, message, qos=LATCHED):
        """Publish one message; with the default QoS it does not matter who subscribes when."""
        publisher = self.publisher(topic, qos, type(message))
        publisher.publish(message)
        return publisher
