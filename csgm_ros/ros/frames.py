"""Where a frame was at a time: the little of TF that merging clouds of a moving sensor needs.

Listens to /tf and /tf_static itself, as tf2_ros may not be installed where tf2_msgs is.
"""

from __future__ import annotations

import bisect
import threading
from collections import defaultdict

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from csgm_ros.errors import InputError
from csgm_ros.ros.lifecycle import guarded
from csgm_ros.types import Similarity

KEPT = 1000  # transforms kept of each moving frame, half a minute at 30 Hz
SLACK = 10**8  # nanoseconds that a cloud may be older or newer than the transforms known
STATIC = 'static'


class Frames:
    """The tree of frames as /tf and /tf_static tell it."""

    def __init__(self, node: Node):
        self._node = node
        self._group = MutuallyExclusiveCallbackGroup()
        self._subscriptions: list = []
        self._lock = threading.Lock()
        self._forget()

    def _forget(self) -> None:
        self._parents: dict[str, str] = {}
        self._stamps: dict[str, list] = defaultdict(list)
        self._transforms: dict[str, list[tuple[np.ndarray, np.ndarray]]] = defaultdict(list)

    def listen(self) -> None:
        """Subscribe, once.

        Raises
        ------
        InputError
            When tf2_msgs is not installed.
        """
        if self._subscriptions:
            return
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            raise InputError('fixed_frame needs TF, and tf2_msgs is not installed') from None
        moving = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
        fixed = QoSProfile(
            depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
        )
        for topic, qos, static in (('/tf', moving, False), ('/tf_static', fixed, True)):
            self._subscriptions.append(self._subscribe(TFMessage, topic, qos, static))

    def _subscribe(self, kind: type, topic: str, qos: QoSProfile, static: bool):
        def receive(message) -> None:
            for transform in message.transforms:
                self.add(transform, static=static)

        return self._node.create_subscription(
            kind, topic, guarded(receive, self._node), qos, callback_group=self._group
        )

    def close(self) -> None:
        """Unsubscribe and forget."""
        while self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.pop())
        with self._lock:
            self._forget()

    def add(self, transform: TransformStamped, *, static: bool) -> None:
        """Remember one transform."""
        child, stamp = transform.child_frame_id, transform.header.stamp
        rotation, translation = transform.transform.rotation, transform.transform.translation
        quaternion = np.array([rotation.x, rotation.y, rotation.z, rotation.w])
        entry = quaternion / np.linalg.norm(quaternion), np.array([translation.x, translation.y, translation.z])
        with self._lock:
            self._parents[child] = transform.header.frame_id
            stamps, transforms = self._stamps[child], self._transforms[child]
            if static:
                stamps[:], transforms[:] = [STATIC], [entry]
                return
            nanoseconds = stamp.sec * 10**9 + stamp.nanosec
            at = bisect.bisect(stamps, nanoseconds)
            stamps.insert(at, nanoseconds)
            transforms.insert(at, entry)
            del stamps[:-KEPT], transforms[:-KEPT]

    def lookup(self, fixed: str, frame: str, stamp: int) -> Similarity:
        """Return the rigid transform that moves points of ``frame`` into ``fixed`` at a time in nanoseconds.

        Raises
        ------
        InputError
            When the two are not connected, or the time is beyond what was heard.
        """
        with self._lock:
            down, up = self._chain(frame, stamp), self._chain(fixed, stamp)
        common = next((name for name in down if name in up), None)
        if common is None:
            raise InputError(
                f'TF does not connect {frame} with {fixed}; known are {", ".join(self._parents) or "none"}'
            )
        return up[common].inverse() @ down[common]

    def _chain(self, frame: str, stamp: int) -> dict[str, Similarity]:
        """Return the ancestors of a frame, itself first, with the transform from the frame into each."""
        chain = {frame: Similarity.identity()}
        while frame in self._parents and self._parents[frame] not in chain:
            chain[self._parents[frame]] = self._at(frame, stamp) @ chain[frame]
            frame = self._parents[frame]
        return chain

    def _at(self, child: str, stamp: int) -> Similarity:
        """Interpolate the transform from ``child`` into its parent."""
        stamps, transforms = self._stamps[child], self._transforms[child]
        if stamps[0] == STATIC:
            return rigid(*transforms[0])
        if not stamps[0] - SLACK <= stamp <= stamps[-1] + SLACK:
            off = max(stamps[0] - stamp, stamp - stamps[-1]) / 1e9
            raise InputError(f'the cloud is {off:.2f} s off the transforms heard of {child}')
        at = bisect.bisect(stamps, stamp)
        if at in (0, len(stamps)):
            return rigid(*transforms[min(at, len(stamps) - 1)])
        (q0, t0), (q1, t1) = transforms[at - 1], transforms[at]
        weight = (stamp - stamps[at - 1]) / (stamps[at] - stamps[at - 1])
        turned = (1 - weight) * q0 + weight * (q1 if q0 @ q1 >= 0 else -q1)
        return rigid(turned / np.linalg.norm(turned), (1 - weight) * t0 + weight * t1)


def rigid(quaternion: np.ndarray, translation: np.ndarray) -> Similarity:
    """Return the transform of a unit quaternion (x, y, z, w) and a translation."""
    x, y, z, w = quaternion
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    return Similarity(1.0, rotation, translation)
