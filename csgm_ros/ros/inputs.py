"""One input topic: heard whatever QoS its publishers offer, newest messages kept, silence explained."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2

from csgm_ros.errors import InputError
from csgm_ros.io.pointcloud2 import check_layout
from csgm_ros.ros.lifecycle import guarded
from csgm_ros.ros.qos import declare_overrides, subscription_qos
from csgm_ros.ros.watch import problem_of


class CloudInput:
    """The newest clouds of one topic.

    By default the subscription follows what the publishers offer: reliable where all of them are, best effort
    where one is not, and a second one for latched publishers, so that a map sent before the node was started
    is not missed. The ``qos_overrides`` parameters fix it instead.

    Attributes
    ----------
    heard, rejected : int
        Messages since :meth:`open`, and those of them that cannot be used.
    last_error : str
        Why the last message was rejected.
    problem : str
        Why nothing is heard and the remedy; empty when all is well.
    delay : float
        Longest time from the arrival of a message to its callback, seconds.
    last_heard : float or None
        ``time.monotonic()`` of the last message.
    """

    def __init__(self, node: Node, name: str, window: Callable[[], int], on_cloud: Callable[[], None]):
        self._node, self._window, self._on_cloud = node, window, on_cloud
        self.name, self.topic = name, node.resolve_topic_name(name)
        self._overrides = declare_overrides(node, self.topic)
        self._group = MutuallyExclusiveCallbackGroup()
        self._subscriptions: dict[tuple[ReliabilityPolicy, DurabilityPolicy], object] = {}
        self._stale: set[tuple] = set()
        self._reset()

    def _reset(self) -> None:
        self._messages: list[PointCloud2] = []
        self._seen: deque[int] = deque(maxlen=64)
        self.heard = self.rejected = 0
        self.delay = 0.0
        self.last_error, self.last_heard, self.opened = '', None, time.monotonic()
        self.problem = ''

    def open(self) -> None:
        """Subscribe, and keep the newest messages."""
        self._reset()
        self.follow_offers()

    def close(self) -> None:
        """Unsubscribe and forget the clouds."""
        while self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.popitem()[1])
        self._messages = []

    @property
    def messages(self) -> list[PointCloud2]:
        """The newest usable messages, oldest first, as many as the window holds."""
        return self._messages[-self._window() :]

    @property
    def requested(self) -> list[QoSProfile]:
        """The QoS of the present subscriptions."""
        return [self._qos(*key) for key in list(self._subscriptions)]

    @property
    def profiles(self) -> list[str]:
        """The QoS of the present subscriptions, for people."""
        return [
            f'{reliability.name}/{durability.name}'.lower() for reliability, durability in list(self._subscriptions)
        ]

    @property
    def explanation(self) -> str:
        """Why there may be no cloud, for whoever asks for a registration."""
        return f'last message unusable: {self.last_error}' if self.last_error else self.problem or 'nothing heard'

    def watch(self, timeout: float) -> None:
        """Adapt to the publishers, and log when the input falls silent for ``timeout`` seconds or speaks again."""
        self.follow_offers()
        before, self.problem = self.problem, problem_of(self._node, self, timeout)
        if self.problem and not before:
            self._node.get_logger().warning(self.problem)
        elif before and not self.problem:
            self._node.get_logger().info(f'clouds on {self.topic} again')

    def follow_offers(self) -> None:
        """Adapt the subscriptions to the publishers there are.

        One that is no longer wanted lives until the next call, so that nothing is lost between the two; a message
        heard twice is counted once.
        """
        wanted = subscription_qos(self._node.get_publishers_info_by_topic(self.topic), self._overrides)
        for key in wanted - self._subscriptions.keys():
            self._subscriptions[key] = self._subscribe(self._qos(*key))
        unwanted = self._subscriptions.keys() - wanted
        for key in unwanted & self._stale:
            self._node.destroy_subscription(self._subscriptions.pop(key))
        self._stale = unwanted

    def _qos(self, reliability: ReliabilityPolicy, durability: DurabilityPolicy) -> QoSProfile:
        depth, history = self._overrides['depth'], self._overrides['history']
        return QoSProfile(depth=depth, history=history, reliability=reliability, durability=durability)

    def _subscribe(self, qos: QoSProfile):
        return self._node.create_subscription(
            PointCloud2,
            self.topic,
            guarded(self._receive, self._node),
            qos,
            callback_group=self._group,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
        )

    def _receive(self, message: PointCloud2, info: dict) -> None:
        stamp = info['source_timestamp']
        if stamp in self._seen:
            return  # the same message through the other subscription
        self._seen.append(stamp)
        self.heard += 1
        self.last_heard = time.monotonic()
        self.delay = max(self.delay, (time.time_ns() - info['received_timestamp']) / 1e9)
        try:
            check_layout(message)
        except InputError as error:
            self.rejected += 1
            if str(error) != self.last_error:
                self._node.get_logger().warning(f'unusable message on {self.topic}: {error}')
            self.last_error = str(error)
            return
        self._messages = [*self.messages, message][-self._window() :]  # a new list: the worker may hold the old one
        self._on_cloud()
