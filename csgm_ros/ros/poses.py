"""What tracking publishes: the pose in the map in metres, for every frame that has one."""

from __future__ import annotations

import threading
from collections import deque

import numpy as np
from geometry_msgs.msg import Pose, PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Path
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64

from csgm_ros.ros.cloud_msgs import cloud_message, header, quaternion, transform_message
from csgm_ros.ros.qos import LATCHED
from csgm_ros.ros.tf import MOVING, Broadcaster
from csgm_ros.tracking.maps import PreparedMap
from csgm_ros.types import Similarity, rotation_angle

EACH = QoSProfile(depth=10)
TOPICS = {
    'pose': (PoseWithCovarianceStamped, EACH),
    'scale': (Float64, LATCHED),
    'path': (Path, LATCHED),
    'map': (PointCloud2, LATCHED),
}
STEP = 0.03, 3.0  # metres or degrees between two poses of the path
LONGEST = 2000  # poses of the path
GROWN = 0.002  # relative change of the scale from which the map in metres is sent again


def metric_frame(map_frame: str) -> str:
    """Return the name of the frame in which a map is measured in metres."""
    return f'{map_frame}_metric'


class Poses:
    """The publishers of tracking. It owns them and the path, and uses them under its lock alone."""

    def __init__(self, node: LifecycleNode):
        self._node = node
        self._lock = threading.Lock()
        self._publishers = {
            name: node.create_lifecycle_publisher(kind, f'~/{name}', qos) for name, (kind, qos) in TOPICS.items()
        }
        self._tf = Broadcaster(node, MOVING)
        self._path: deque[PoseStamped] = deque(maxlen=LONGEST)
        self._last: Similarity | None = None
        self._grown = False
        self._map: tuple[PreparedMap, str] | None = None
        self._scale = np.nan  # that the map was sent with

    def destroy(self) -> None:
        """Take the publishers down."""
        with self._lock:
            for publisher in self._publishers.values():
                self._node.destroy_lifecycle_publisher(publisher)
            self._publishers = {}
            self._tf.destroy()

    def advertise_tf(self) -> None:
        """Let listeners know the publisher of /tf: what it sends before they do is lost to them."""
        with self._lock:
            self._tf.advertise()

    def use_map(self, prepared: PreparedMap, frame_id: str) -> None:
        """Begin a path in another map."""
        with self._lock:
            self._map, self._scale, self._last = (prepared, frame_id), np.nan, None
            self._path.clear()

    def publish(self, stamp: int, pose: Similarity, covariance: np.ndarray, scale: float) -> None:
        """Publish one pose.

        Parameters
        ----------
        stamp : int
            Nanoseconds.
        pose : Similarity
            Rigid, in the map in metres.
        covariance : (6, 6) ndarray
            Of translation and rotation along and about the axes of the map.
        scale : float
            Map units a metre.
        """
        with self._lock:
            if not self._publishers or self._map is None:
                return
            head = header(metric_frame(self._map[1]), stamp)
            message = PoseWithCovarianceStamped(header=head)
            message.pose.pose = pose_message(pose)
            message.pose.covariance = covariance.ravel().tolist()
            self._publishers['pose'].publish(message)
            self._publishers['scale'].publish(Float64(data=float(scale)))
            self._send_map(stamp, scale)
            if self._last is None or _apart(self._last, pose):
                self._last, self._grown = pose, True
                self._path.append(PoseStamped(header=head, pose=message.pose.pose))

    def broadcast(self, stamp: int, child_frame: str, transform: Similarity) -> None:
        """Send where a frame is in the map in metres to /tf."""
        with self._lock:
            if self._publishers and self._map is not None:
                head = header(metric_frame(self._map[1]), stamp)
                self._tf.publish(transform_message(head, child_frame, transform))

    def publish_path(self) -> None:
        """Publish the path where it has grown: seldom, as it is long."""
        with self._lock:
            if self._publishers and self._grown:
                self._grown = False
                self._publishers['path'].publish(Path(header=self._path[-1].header, poses=list(self._path)))

    def _send_map(self, stamp: int, scale: float) -> None:
        assert self._map is not None
        prepared, frame_id = self._map
        if abs(scale / self._scale - 1.0) < GROWN:
            return
        self._scale = scale
        points = (prepared.points / scale).astype(np.float32)
        self._publishers['map'].publish(cloud_message(header(metric_frame(frame_id), stamp), points))


def pose_message(pose: Similarity) -> Pose:
    """Return a rigid transform as a pose."""
    message = Pose()
    position, turn = message.position, message.orientation
    position.x, position.y, position.z = map(float, pose.translation)
    turn.x, turn.y, turn.z, turn.w = quaternion(pose.rotation)
    return message


def _apart(one: Similarity, other: Similarity) -> bool:
    shift, angle = np.linalg.norm(one.translation - other.translation), rotation_angle(one.rotation.T @ other.rotation)
    return bool(shift > STEP[0] or angle > np.radians(STEP[1]))
