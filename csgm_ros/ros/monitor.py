"""Why an input is silent, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass

from rclpy.qos import DurabilityPolicy, QoSCompatibility, QoSProfile, qos_check_compatible

from csgm_ros.ros.dds import BUFFER_BYTES, REMEDY, buffer_limit

CLOUD_TYPE = 'sensor_msgs/msg/PointCloud2'


@dataclass(frozen=True)
class Listener:
    """What is to be known of an input to tell why it is silent.

    Attributes
    ----------
    name, topic : str
        Of the input, and what it is resolved to.
    received : int
        Messages so far.
    silent : float
        Seconds since the last message; before the first one, since the input was opened or its publishers came.
    requested : list of QoSProfile
        QoS of the present subscriptions.
    """

    name: str
    topic: str
    received: int
    silent: float
    requested: list[QoSProfile]


def problem_of(node, listener: Listener, timeout: float) -> str:
    """Return one line on why no cloud has come for ``timeout`` seconds and the remedy; empty when all is well."""
    if listener.silent < timeout:
        return ''
    topic, publishers = listener.topic, node.get_publishers_info_by_topic(listener.topic)
    if not publishers:
        return '' if listener.received == 1 else f'no publisher on {topic}; {suggestion(node, listener)}'
    clouds = [publisher for publisher in publishers if publisher.topic_type == CLOUD_TYPE]
    if not clouds:
        return f'{topic} carries {publishers[0].topic_type}, not {CLOUD_TYPE}; {suggestion(node, listener)}'
    reasons = [reason for publisher in clouds if (reason := incompatibility(listener, publisher.qos_profile))]
    if len(reasons) == len(clouds):
        return f'QoS of {topic} is incompatible with its publisher ({reasons[0]}); remove the qos_overrides parameters'
    if listener.received == 1 or any(is_latched(publisher.qos_profile) for publisher in clouds):
        return ''  # published once, as maps are
    since = 'nothing received yet' if listener.received == 0 else f'nothing received for {listener.silent:.0f} s'
    return f'{topic} has {len(clouds)} publisher(s) but {since}; {loss_remedy()}'


def suggestion(node, listener: Listener) -> str:
    """Return how to reach the clouds that there are."""
    others = [
        name
        for name, kinds in node.get_topic_names_and_types()
        if CLOUD_TYPE in kinds
        and name != listener.topic
        and node.count_publishers(name)
        and not name.startswith(f'{node.get_fully_qualified_name()}/')
    ]
    if not others:
        return 'nothing publishes a PointCloud2 in this ROS domain'
    return f'remap it, for example --ros-args -r {listener.name}:={others[0]} (clouds are on {", ".join(others)})'


def incompatibility(listener: Listener, offered: QoSProfile) -> str:
    """Return why no present subscription can hear a publisher; empty when one can."""
    reason = ''
    for qos in listener.requested:
        compatible, reason = qos_check_compatible(offered, qos)
        if compatible != QoSCompatibility.ERROR:
            return ''
    return reason.strip()


def is_latched(offered: QoSProfile) -> bool:
    """Return True for a publisher that keeps its last message for late joiners."""
    return offered.durability == DurabilityPolicy.TRANSIENT_LOCAL


def loss_remedy() -> str:
    """Return the remedy for lost clouds, with what this kernel allows."""
    limit = buffer_limit()
    allowed = f' (this kernel allows {limit} bytes)' if 0 < limit < BUFFER_BYTES else ''
    return f'is the sensor running? If it is: {REMEDY}{allowed}'
