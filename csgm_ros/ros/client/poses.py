"""The poses that a node in mode tracking gives out, as they come."""

from __future__ import annotations

import threading
from contextlib import suppress
from dataclasses import replace

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import QoSProfile
from std_msgs.msg import Float64

from csgm_ros.io.pointcloud2 import stamp_of
from csgm_ros.ros.client.connection import NODE
from csgm_ros.ros.frames import pose
from csgm_ros.ros.qos import LATCHED
from csgm_ros.types import Similarity


class Listener:
    """Keeps every pose; use as a context manager.

    Attributes
    ----------
    heard : list of (int, Similarity)
        Stamp in nanoseconds, and from the sensor's metres to the map's unit.
    """

    def __init__(self, node: str = NODE):
        self._name = f'/{node.strip("/")}'
        self._scale = float('nan')
        self._waiting: list[tuple[int, Similarity]] = []
        self.heard: list[tuple[int, Similarity]] = []

    def __enter__(self) -> Listener:
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node('csgm_poses', context=self._context, start_parameter_services=False)
        for kind, name, keep, qos in (
            (PoseWithCovarianceStamped, 'pose', self._keep, QoSProfile(depth=100)),
            (Float64, 'scale', self._measure, LATCHED),
        ):
            self._node.create_subscription(kind, f'{self._name}/{name}', keep, qos)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._thread.join(5.0)
        self._node.destroy_node()
        self._context.try_shutdown()

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            self._executor.spin()

    def _keep(self, message: PoseWithCovarianceStamped) -> None:
        given = message.pose.pose
        metric = Similarity.from_quaternion(*pose(given.orientation, given.position))
        self._waiting.append((stamp_of(message), metric))
        self._scaled()

    def _measure(self, message: Float64) -> None:
        self._scale = message.data
        self._scaled()

    def _scaled(self) -> None:
        """Keep in the map's unit what came before the first scale, too."""
        if self._scale == self._scale:
            for stamp, metric in self._waiting:
                place = replace(metric, scale=self._scale, translation=self._scale * metric.translation)
                self.heard.append((stamp, place))
            self._waiting.clear()
