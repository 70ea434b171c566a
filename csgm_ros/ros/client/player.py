"""Play a rosbag2 bag into ROS with its original timing and /clock, where ``ros2 bag play`` is not installed."""

from __future__ import annotations

import argparse
import os
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import rclpy
from builtin_interfaces.msg import Time
from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from rosgraph_msgs.msg import Clock

from csgm_ros.errors import CsgmError, InputError
from csgm_ros.io.bags import CLOUD_TYPE, open_bag, require_topics
from csgm_ros.ros.client.commands import space
from csgm_ros.ros.dds import connection_error, use_large_buffers

CLOCK_RATE = 50.0  # Hz
INTERFACES = Path('share', 'ament_index', 'resource_index', 'rosidl_interfaces')


@dataclass(frozen=True)
class Played:
    """What was played: messages by published topic, and the largest delay behind the bag's timing in seconds."""

    counts: dict[str, int] = field(default_factory=dict)
    latest: float = 0.0


class Player:
    """Plays one bag.

    Parameters
    ----------
    node : Node
        Publishes; needs no executor.
    bag : str or Path
        Folder of the bag, mcap or sqlite3.
    rate : float
        Bag seconds per second, > 0.
    remap : mapping of str to str
        Recorded topic to published topic.
    clock : bool
        Publish the bag's time on /clock.
    """

    def __init__(
        self,
        node: Node,
        bag: str | Path,
        *,
        rate: float = 1.0,
        remap: Mapping[str, str] | None = None,
        clock: bool = True,
    ):
        if not rate > 0.0:
            raise InputError(f'rate must be above 0, not {rate}')
        self._node, self._bag, self._rate, self._remap = node, bag, rate, dict(remap or {})
        self._clock = node.create_publisher(Clock, '/clock', 10) if clock else None
        self._publishers: dict = {}
        self._awaited: set[int] = set()
        self._stopped = threading.Event()
        self.counts: dict[str, int] = {}
        self.latest = 0.0
        with open_bag(bag) as reader:
            require_topics(bag, reader, self._remap)
            for connection in reader.connections:
                self._advertise(connection)

    def _advertise(self, connection) -> None:
        topic = self._remap.get(connection.topic, connection.topic)
        if topic == '/clock' and self._clock is not None:
            return  # ours is the one that fits the rate
        try:
            kind = message_type(connection.msgtype)
        except (ImportError, AttributeError, ValueError):
            self._node.get_logger().warning(f'{topic} is left out: {connection.msgtype} is not installed')
            return
        try:
            publisher = self._node.create_publisher(kind, topic, offered_qos(connection))
        except InvalidTopicNameException:
            raise InputError(f'{self._bag}: holds the topic {topic[:60]!r}, which no ROS topic is called') from None
        if connection.topic in self._remap or (not self._remap and connection.msgtype == CLOUD_TYPE):
            self._awaited.add(connection.id)
        self._publishers[connection.id] = publisher
        self.counts[topic] = 0

    def wait_for_subscribers(self, timeout: float) -> list[str]:
        """Wait until somebody listens to the clouds; return their topics nobody listens to after ``timeout`` seconds.

        The clouds are those of the remapped topics, of all topics where none is remapped. Others are not waited for:
        the node would take the silence of what it listens to for a fault.
        """
        end = time.monotonic() + timeout
        awaited = [self._publishers[number] for number in self._awaited]
        while True:
            alone = [each.topic_name for each in awaited if not each.get_subscription_count()]
            if not alone or time.monotonic() > end or self._stopped.wait(0.02):
                return alone

    def stop(self) -> None:
        """End :meth:`play` from another thread."""
        self._stopped.set()

    def play(self, *, loop: bool = False) -> Played:
        """Play the bag once, or until :meth:`stop`."""
        while not self._stopped.is_set():
            with open_bag(self._bag) as reader:
                self._play_once(reader)
            if not loop:
                break
        for publisher in self._publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=3))
        return Played(dict(self.counts), self.latest)

    def _play_once(self, reader) -> None:
        first, started = reader.start_time, time.monotonic()
        for connection, stamp, raw in reader.messages():
            self._wait_until(first, stamp, started)
            if self._stopped.is_set():
                return
            publisher = self._publishers.get(connection.id)
            if publisher is not None:
                self.latest = max(self.latest, time.monotonic() - started - (stamp - first) / 1e9 / self._rate)
                publisher.publish(bytes(raw))
                self.counts[self._remap.get(connection.topic, connection.topic)] += 1

    def _wait_until(self, first: int, stamp: int, started: float) -> None:
        """Sleep to a message's time, ticking the clock meanwhile and at that time."""
        while not self._stopped.is_set():
            elapsed = time.monotonic() - started
            left = (stamp - first) / 1e9 / self._rate - elapsed
            self._tick(stamp if left <= 0.0 else first + int(elapsed * self._rate * 1e9))
            if left <= 0.0:
                return
            self._stopped.wait(min(left, 1.0 / CLOCK_RATE))

    def _tick(self, stamp: int) -> None:
        if self._clock is not None:
            self._clock.publish(Clock(clock=Time(sec=stamp // 10**9, nanosec=stamp % 10**9)))


def message_type(name: str) -> type:
    """Return the Python type of, say, ``sensor_msgs/msg/PointCloud2``.

    Only installed ROS interface packages are looked into, as the ament index lists them: a bag must not choose what is
    imported from elsewhere, say from a folder beside it.

    Raises
    ------
    ImportError
        When no such package is installed.
    """
    package, kind, message = name.split('/')
    if kind != 'msg' or not (package.isidentifier() and message.isidentifier()):
        raise ImportError(f'{name} is no message type')
    if package not in sys.modules:  # what is there already runs no code
        spec = find_spec(package)
        places = [Path(place).resolve() for place in (spec.submodule_search_locations or ()) if place] if spec else []
        roots = [prefix.resolve() for prefix in ament_prefixes() if (prefix / INTERFACES / package).is_file()]
        if not places or not all(any(place.is_relative_to(root) for root in roots) for place in places):
            raise ImportError(f'{package} is no installed ROS interface package')
    found = getattr(import_module(f'{package}.{kind}'), message)
    if not hasattr(found, '_TYPE_SUPPORT'):
        raise ImportError(f'{name} is no message type')
    return found


def ament_prefixes() -> list[Path]:
    """Return the prefixes of installed ROS packages: those of a sourced install, and this environment's own."""
    named = [Path(prefix) for prefix in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if prefix]
    return [*named, Path(sys.prefix)]


def offered_qos(connection) -> QoSProfile:
    """Return the QoS a topic was recorded with, reliable and volatile where the bag does not say."""
    offered = connection.ext.offered_qos_profiles
    best_effort = bool(offered) and all(each.reliability.name == 'BEST_EFFORT' for each in offered)
    latched = any(each.durability.name == 'TRANSIENT_LOCAL' for each in offered)
    return QoSProfile(
        depth=max([each.depth for each in offered] + [10]),
        reliability=ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def parser() -> argparse.ArgumentParser:
    """Return the arguments of ``csgm replay``."""
    made = argparse.ArgumentParser(prog='csgm replay', description='Play a rosbag2 bag into the live node.')
    made.add_argument('bag', help='folder of the bag, mcap or sqlite3')
    made.add_argument('--rate', type=float, default=1.0, metavar='R', help='bag seconds per second; default: 1')
    made.add_argument('--loop', action='store_true', help='start again at the end')
    made.add_argument('--source-topic', metavar='T', help='recorded topic that is played as /source')
    made.add_argument('--target-topic', metavar='T', help='recorded topic that is played as /target')
    made.add_argument('--namespace', default='', metavar='N', help='of the node, where it is not in the root')
    made.add_argument('--no-clock', action='store_true', help='do not publish /clock')
    made.add_argument('--wait', type=float, default=5.0, metavar='S', help='seconds to wait for somebody to listen')
    return made


def main(arguments: list[str] | None = None) -> int:
    """Run ``csgm replay``; return 0, or 2 for a bag that cannot be played."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = parser().parse_args(remove_ros_args(['csgm', *arguments])[1:])
    chosen = {'source': options.source_topic, 'target': options.target_topic}
    remap = {topic: f'{space(options.namespace)}/{name}' for name, topic in chosen.items() if topic}
    use_large_buffers()
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node('csgm_player')
    except (RCLError, UnknownROSArgsError) as error:
        print(f'csgm: ROS cannot be joined: {connection_error(error)}', file=sys.stderr)
        return 2
    try:
        player = Player(node, options.bag, rate=options.rate, remap=remap, clock=not options.no_clock)
        for topic in player.wait_for_subscribers(options.wait):
            node.get_logger().warning(f'nobody listens to {topic}')
        played = player.play(loop=options.loop)
    except CsgmError as error:
        print(f'csgm: {error}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 0
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    counts = ', '.join(f'{topic} {count}' for topic, count in played.counts.items())
    print(f'played {counts}; at most {1000 * played.latest:.0f} ms late')
    return 0


if __name__ == '__main__':
    sys.exit(main())
