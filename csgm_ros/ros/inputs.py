"""One input topic: received whatever QoS its publishers offer, newest messages kept, silence explained."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2

from csgm_ros.errors import InputError
from csgm_ros.io.pointcloud2 import check_layout
from csgm_ros.ros.lifecycle import guarded
from csgm_ros.ros.monitor import Listener, problem_of
from csgm_ros.ros.qos import declare_overrides, subscription_qos

RECENT = 64  # messages among which one that comes through two subscriptions is found again


@dataclass(frozen=True)
class Window:
    """How much of an input is kept: the newest messages, and the points that they may hold."""

    messages: int
    points: int


class CloudInput:
    """The newest clouds of one topic.

    By default the subscription follows what the publishers offer: reliable where all of them are, best effort
    where one is not, both while there is none, and a second one for latched publishers, so that a map sent before
    the node was started is not missed. The ``qos_overrides`` parameters fix it instead.

    It owns its subscriptions, its messages and its counts, and changes them under its lock alone. What a
    subscription receives counts for the session, from :meth:`open` to :meth:`close`, in which it was made.

    Attributes
    ----------
    received, rejected : int
        Messages since :meth:`open`, and those of them that cannot be used.
    last_error : str
        Why the last message was rejected.
    problem : str
        Why nothing is received and the remedy; empty when all is well.
    delay : float
        Longest time from the arrival of a message to its callback, seconds.
    last_received : float or None
        ``time.monotonic()`` of the last message.
    """

    def __init__(self, node: Node, name: str, window: Callable[[], Window], on_cloud: Callable[[], None]):
        self._node, self._window, self._on_cloud = node, window, on_cloud
        self.name, self.topic = name, node.resolve_topic_name(name)
        self._overrides = declare_overrides(node, self.topic)
        self._group = MutuallyExclusiveCallbackGroup()
        self._lock = threading.Lock()
        self._session: object | None = None
        self._subscriptions: dict[tuple[ReliabilityPolicy, DurabilityPolicy], Any] = {}
        self._stale: set[tuple] = set()
        self._reset()

    def _reset(self) -> None:
        self._messages: list[PointCloud2] = []
        self._seen: deque[tuple] = deque(maxlen=RECENT)
        self.received = self.rejected = 0
        self.delay = 0.0
        self.last_error, self._waiting_since = '', time.monotonic()
        self.last_received: float | None = None
        self._offered = False
        self.problem = ''

    def open(self) -> None:
        """Subscribe, and keep the newest messages."""
        with self._lock:
            self._reset()
            self._session = object()
        self.follow_offers()

    def close(self) -> None:
        """Unsubscribe and forget the clouds."""
        with self._lock:
            self._session = None
            while self._subscriptions:
                self._node.destroy_subscription(self._subscriptions.popitem()[1])
            self._messages, self._stale = [], set()

    @property
    def messages(self) -> list[PointCloud2]:
        """The newest usable messages, oldest first, as many as the window holds."""
        return newest(self._messages, self._window())

    @property
    def profiles(self) -> list[str]:
        """The QoS of the present subscriptions, for people."""
        return [
            f'{reliability.name}/{durability.name}'.lower() for reliability, durability in list(self._subscriptions)
        ]

    @property
    def explanation(self) -> str:
        """Why there may be no cloud, for whoever asks for a registration."""
        return f'last message unusable: {self.last_error}' if self.last_error else self.problem or 'nothing received'

    def monitor(self, timeout: float) -> None:
        """Adapt to the publishers, and log when the input falls silent for ``timeout`` seconds or speaks again."""
        self.follow_offers()
        silent = time.monotonic() - (self.last_received or self._waiting_since)
        requested = [self._qos(*key) for key in list(self._subscriptions)]
        listener = Listener(self.name, self.topic, self.received, silent, requested)
        before, self.problem = self.problem, problem_of(self._node, listener, timeout)
        if self.problem and not before:
            self._node.get_logger().warning(self.problem)
        elif before and not self.problem:
            self._node.get_logger().info(f'clouds on {self.topic} again')

    def follow_offers(self) -> None:
        """Adapt the subscriptions to the publishers there are; nothing where the input is closed.

        One that is no longer wanted lives until the next call, so that nothing is lost between the two; a message
        received twice is counted once.
        """
        offers = self._node.get_publishers_info_by_topic(self.topic)
        wanted = subscription_qos(offers, self._overrides)
        with self._lock:
            if self._session is None:
                return
            if offers and not self._offered:
                self._waiting_since = time.monotonic()
            self._offered = bool(offers)
            for key in wanted - self._subscriptions.keys():
                self._subscriptions[key] = self._subscribe(key, self._session)
            unwanted = self._subscriptions.keys() - wanted
            for key in unwanted & self._stale:
                self._node.destroy_subscription(self._subscriptions.pop(key))
            self._stale = unwanted

    def _qos(self, reliability: ReliabilityPolicy, durability: DurabilityPolicy) -> QoSProfile:
        depth, history = self._overrides['depth'], self._overrides['history']
        return QoSProfile(depth=depth, history=history, reliability=reliability, durability=durability)

    def _subscribe(self, key: tuple, session: object):
        def receive(message: PointCloud2, info: dict) -> None:
            self._receive(message, info, key, session)

        return self._node.create_subscription(
            PointCloud2,
            self.topic,
            guarded(receive, self._node),
            self._qos(*key),
            callback_group=self._group,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
        )

    def _receive(self, message: PointCloud2, info: dict, key: tuple, session: object) -> None:
        complaint = fault(message, self._window())
        with self._lock:
            if session is not self._session or self._is_repeated(message, info, key):
                return
            self.received += 1
            self.last_received = time.monotonic()
            self.delay = max(self.delay, (time.time_ns() - info['received_timestamp']) / 1e9)
            news = bool(complaint) and complaint != self.last_error
            if complaint:
                self.rejected += 1
                self.last_error = complaint
            else:  # a new list: the worker may hold the old one
                self._messages = newest([*self._messages, message], self._window())
        if news:
            self._node.get_logger().warning(f'unusable message on {self.topic}: {complaint}')
        if not complaint:
            self._on_cloud()

    def _is_repeated(self, message: PointCloud2, info: dict, key: tuple) -> bool:
        """Tell whether the other subscription has brought the same message of the same publisher already.

        A stamp alone does not tell: two publishers may send at the same time.
        """
        stamp = message.header.stamp
        mark = (
            *(info['source_timestamp'], info['publication_sequence_number'], stamp.sec, stamp.nanosec),
            *(message.header.frame_id, message.width, message.height),
        )
        if any(mark == known and key != via for known, via in self._seen):
            return True
        self._seen.append((mark, key))
        return False


def fault(message: PointCloud2, window: Window) -> str:
    """Return why a message cannot be used, empty when it can."""
    try:
        check_layout(message, window.points)
    except InputError as error:
        return str(error)
    return ''


def newest(messages: list[PointCloud2], window: Window) -> list[PointCloud2]:
    """Return the newest messages that the window holds, oldest first; at least one."""
    kept: list[PointCloud2] = []
    points = 0
    for message in reversed(messages[-window.messages :]):
        points += message.width * message.height
        if kept and points > window.points:
            break
        kept.append(message)
    return kept[::-1]
