"""What a registration publishes: one header for all of it, latched for late joiners."""

from __future__ import annotations

import threading

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.lifecycle import LifecycleNode
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64, Float64MultiArray, Header
from visualization_msgs.msg import MarkerArray

from csgm_ros.ros.cloud_msgs import cloud_message, header, matrix_message, transform_message
from csgm_ros.ros.markers import graph_markers
from csgm_ros.ros.qos import LATCHED
from csgm_ros.ros.tf import STATIC, Broadcaster
from csgm_ros.types import Cloud, RegistrationResult

TOPICS = {
    'transform': TransformStamped,
    'scale': Float64,
    'similarity': Float64MultiArray,
    'fused': PointCloud2,
    'aligned': PointCloud2,
    'graphs': MarkerArray,
}
TARGET_COLOR, SOURCE_COLOR = (120, 150, 190), (240, 150, 50)  # where a cloud has no colour of its own
TARGET_ID, SOURCE_ID = 0, 1


class Outputs:
    """The latched publishers of one configured node.

    It owns them, and the markers that wait for a listener; it publishes and takes them down under its lock alone.
    """

    def __init__(self, node: LifecycleNode):
        self._node = node
        self._lock = threading.Lock()
        self._publishers = {
            name: node.create_lifecycle_publisher(kind, f'~/{name}', LATCHED) for name, kind in TOPICS.items()
        }
        self._static_transform = Broadcaster(node, STATIC)
        self._pending_graphs: tuple[RegistrationResult, Header] | None = None

    def destroy(self) -> None:
        """Take the publishers down; latched results are gone."""
        with self._lock:
            for publisher in self._publishers.values():
                self._node.destroy_lifecycle_publisher(publisher)
            self._publishers, self._pending_graphs = {}, None
            self._static_transform.destroy()

    def publish(
        self, result: RegistrationResult, source: Cloud, target: Cloud, child_frame: str, *, tf: bool = False
    ) -> None:
        """Publish an accepted result; every message describes the same pair, stamped with the later cloud's stamp.

        Parameters
        ----------
        result : RegistrationResult
        source, target : Cloud
            What was registered.
        child_frame : str
            Frame of the scaled source.
        tf : bool
            Send the rigid part to /tf_static as well.
        """
        head = header(target.frame_id, max(source.stamp, target.stamp))
        messages = self._messages(result, source, target, head, child_frame)
        with self._lock:
            if not self._publishers:
                return  # the node was cleaned up meanwhile
            for name, message in messages.items():
                self._publishers[name].publish(message)
            if tf:
                self._static_transform.publish(messages['transform'])
            self._pending_graphs = (result, head)
        self.publish_graphs()

    @staticmethod
    def _messages(result: RegistrationResult, source: Cloud, target: Cloud, head: Header, child_frame: str) -> dict:
        aligned = result.transform.apply(source.points)
        source_colors, target_colors = colors_of(source, SOURCE_COLOR), colors_of(target, TARGET_COLOR)
        return {
            'fused': cloud_message(
                head,
                np.concatenate([target.points, aligned]),
                np.concatenate([target_colors, source_colors]),
                np.repeat(np.array([TARGET_ID, SOURCE_ID], np.uint8), [len(target.points), len(aligned)]),
            ),
            'aligned': cloud_message(head, aligned, source_colors),
            'scale': Float64(data=float(result.scale)),
            'similarity': matrix_message(result.T_target_source),
            'transform': transform_message(head, child_frame, result.transform),
        }

    def publish_graphs(self) -> None:
        """Publish the markers of the last result once somebody listens; they are costly and often unwatched."""
        with self._lock:
            pending, publisher = self._pending_graphs, self._publishers.get('graphs')
            if pending is not None and publisher is not None and publisher.get_subscription_count() > 0:
                self._pending_graphs = None
                publisher.publish(graph_markers(*pending))


def colors_of(cloud: Cloud, fallback: tuple[int, int, int]) -> np.ndarray:
    """Return the cloud's own (N, 3) uint8 colours, or one colour for all of it."""
    if cloud.colors is not None:
        return cloud.colors
    return np.tile(np.array(fallback, np.uint8), (len(cloud.points), 1))
