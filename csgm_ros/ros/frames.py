"""Where a frame was at a time: the little of TF that merging clouds of a moving sensor needs.

``tf2_ros.Buffer`` where that is installed. Where only tf2_msgs is, a stand-in with its semantics: no extrapolation,
a transform that is late is waited for, only the frames between the two asked for have to be known.
"""

from __future__ import annotations

import bisect
import threading
import time
from collections import defaultdict
from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import Quaternion, TransformStamped, Vector3
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.time import Time

from csgm_ros.errors import InputError
from csgm_ros.ros.lifecycle import guarded
from csgm_ros.types import Similarity

CACHE = 60.0  # seconds of transforms kept of each moving frame
PATIENCE = 0.5  # seconds that a transform may come later than the cloud that needs it
STATIC = 'static'
LATEST = 0  # the stamp that stands for the newest transform there is, as in tf2


class Frames:
    """The tree of frames as /tf and /tf_static tell it, from :meth:`open` to :meth:`close`.

    It owns its listener and changes it under its lock alone.
    """

    def __init__(self, node: Node):
        self._node = node
        self._lock = threading.Lock()
        self._open = False
        self._listener: TfListener | Tf2Listener | None = None

    def open(self) -> None:
        """Allow :meth:`listen`."""
        with self._lock:
            self._open = True

    def listen(self) -> None:
        """Subscribe, once, and unless closed.

        Raises
        ------
        InputError
            When tf2_msgs is not installed.
        """
        with self._lock:
            if self._open and self._listener is None:
                self._listener = listener(self._node)

    def close(self) -> None:
        """Unsubscribe and forget."""
        with self._lock:
            self._open, old, self._listener = False, self._listener, None
        if old is not None:
            old.close()

    def lookup(self, fixed: str, frame: str, stamp: int) -> Similarity:
        """Return the rigid transform that moves points of ``frame`` into ``fixed`` at a time in nanoseconds.

        Raises
        ------
        InputError
            When the two are not connected, or the time is beyond what was received, even after some waiting.
        """
        heard = self._listener
        if heard is None:
            raise InputError(f'TF is not listened to, so {frame} has no place in {fixed}; is tf2_msgs installed?')
        return heard.lookup(fixed, frame, stamp)


def listener(node: Node) -> TfListener | Tf2Listener:
    """Return what listens to TF on this machine."""
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError:
        raise InputError(
            'a viewpoint, fixed_frame, odom_frame and base_frame need TF, and tf2_msgs is not installed'
        ) from None
    try:
        return Tf2Listener(node)
    except ImportError:
        return TfListener(node, TFMessage)


class Tf2Listener:
    """``tf2_ros.Buffer`` and its listener."""

    def __init__(self, node: Node):
        import tf2_ros

        self._errors = tf2_ros.TransformException, ValueError  # the latter for a stamp before 1970
        self._buffer = tf2_ros.Buffer(cache_time=Duration(seconds=CACHE))
        self._listener = tf2_ros.TransformListener(self._buffer, node)

    def close(self) -> None:
        """Unsubscribe."""
        self._listener.unregister()

    def lookup(self, fixed: str, frame: str, stamp: int) -> Similarity:
        """As :meth:`Frames.lookup`."""
        try:
            found = self._buffer.lookup_transform(
                fixed, frame, Time(nanoseconds=stamp), timeout=Duration(seconds=PATIENCE)
            )
        except self._errors as error:
            raise InputError(f'TF does not tell where {frame} was in {fixed}: {error}') from None
        return Similarity.from_quaternion(*pose(found.transform.rotation, found.transform.translation))


class TfListener:
    """Subscribes to /tf and /tf_static itself."""

    def __init__(self, node: Node, kind: type):
        self._node, self._tree = node, Tree()
        moving = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
        fixed = QoSProfile(
            depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
        )
        group = MutuallyExclusiveCallbackGroup()
        self._subscriptions = [
            node.create_subscription(kind, topic, guarded(self._adding(static), node), qos, callback_group=group)
            for topic, qos, static in (('/tf', moving, False), ('/tf_static', fixed, True))
        ]

    def _adding(self, static: bool) -> Callable:
        def receive(message) -> None:
            for transform in message.transforms:
                self._tree.add(transform, static=static)

        return receive

    def close(self) -> None:
        """Unsubscribe."""
        while self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.pop())

    def lookup(self, fixed: str, frame: str, stamp: int) -> Similarity:
        """As :meth:`Frames.lookup`."""
        return self._tree.lookup(fixed, frame, stamp, PATIENCE)


class Tree:
    """Transforms by child frame and time. It owns them and changes them under its condition alone."""

    def __init__(self):
        self._changed = threading.Condition()
        self._parents: dict[str, str] = {}
        self._stamps: dict[str, list] = defaultdict(list)
        self._poses: dict[str, list[tuple[np.ndarray, np.ndarray]]] = defaultdict(list)

    def add(self, transform: TransformStamped, *, static: bool) -> None:
        """Remember one transform; one whose rotation is no rotation is left out."""
        child = transform.child_frame_id
        entry = pose(transform.transform.rotation, transform.transform.translation)
        if not all(np.isfinite(part).all() for part in entry):
            return
        with self._changed:
            self._parents[child] = transform.header.frame_id
            stamps, poses = self._stamps[child], self._poses[child]
            if static or (stamps and stamps[0] == STATIC):
                stamps[:], poses[:] = [STATIC], [entry]
            else:
                stamp = transform.header.stamp.sec * 10**9 + transform.header.stamp.nanosec
                at = bisect.bisect(stamps, stamp)
                stamps.insert(at, stamp)
                poses.insert(at, entry)
                old = bisect.bisect_left(stamps, stamps[-1] - int(CACHE * 1e9))
                del stamps[:old], poses[:old]
            self._changed.notify_all()

    def lookup(self, fixed: str, frame: str, stamp: int, patience: float = 0.0) -> Similarity:
        """As :meth:`Frames.lookup`; wait up to ``patience`` seconds for what is not there yet."""
        end = time.monotonic() + patience
        with self._changed:
            while True:
                try:
                    return self._between(fixed, frame, stamp)
                except InputError:
                    left = end - time.monotonic()
                    if left <= 0.0 or not self._changed.wait(left):
                        raise

    def _between(self, fixed: str, frame: str, stamp: int) -> Similarity:
        up = self._ancestors(fixed)
        down = self._ancestors(frame)
        common = next((name for name in down if name in up), None)
        if common is None:
            known = ', '.join(self._parents) or 'none'
            raise InputError(f'TF does not connect {frame} with {fixed}; known are {known}')
        return self._chain(up[: up.index(common)], stamp).inverse() @ self._chain(down[: down.index(common)], stamp)

    def _ancestors(self, frame: str) -> list[str]:
        """Return a frame and those above it, up to the root or to where a loop closes."""
        chain = [frame]
        while (parent := self._parents.get(chain[-1])) is not None and parent not in chain:
            chain.append(parent)
        return chain

    def _chain(self, frames: list[str], stamp: int) -> Similarity:
        """Return the transform from the first of the frames into the parent of the last."""
        total = Similarity.identity()
        for frame in frames:
            total = self._at(frame, stamp) @ total
        return total

    def _at(self, child: str, stamp: int) -> Similarity:
        """Interpolate the transform from ``child`` into its parent."""
        stamps, poses = self._stamps[child], self._poses[child]
        if stamps[0] == STATIC or stamp == LATEST:
            return Similarity.from_quaternion(*poses[-1])
        if not stamps[0] <= stamp <= stamps[-1]:
            off = max(stamps[0] - stamp, stamp - stamps[-1]) / 1e9
            raise InputError(f'the cloud is {off:.2f} s off the transforms received of {child}')
        at = bisect.bisect(stamps, stamp)
        if at == len(stamps) or stamps[at - 1] == stamp:
            return Similarity.from_quaternion(*poses[at - 1])
        (q0, t0), (q1, t1) = poses[at - 1], poses[at]
        weight = (stamp - stamps[at - 1]) / (stamps[at] - stamps[at - 1])
        turned = (1 - weight) * q0 + weight * (q1 if q0 @ q1 >= 0 else -q1)
        return Similarity.from_quaternion(turned, (1 - weight) * t0 + weight * t1)


def pose(rotation: Quaternion, translation: Vector3) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit quaternion (x, y, z, w), NaN for a zero one, and the translation of two messages."""
    quaternion = np.array([rotation.x, rotation.y, rotation.z, rotation.w])
    with np.errstate(invalid='ignore'):
        return quaternion / np.linalg.norm(quaternion), np.array([translation.x, translation.y, translation.z])
