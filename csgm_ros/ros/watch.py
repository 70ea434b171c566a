"""Why an input is silent, and what to do about it."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from rclpy.qos import DurabilityPolicy, QoSCompatibility, QoSProfile, qos_check_compatible

from csgm_ros.ros.dds import BUFFER_BYTES, REMEDY, buffer_limit

if TYPE_CHECKING:
    from csgm_ros.ros.inputs import CloudInput

CLOUD_TYPE = 'sensor_msgs/msg/PointCloud2'


def problem_of(node, cloud_input: CloudInput, timeout: float) -> str:
    """Return one line on why no cloud has come for ``timeout`` seconds and the remedy; empty when all is well."""
    silent = time.monotonic() - (cloud_input.last_heard or cloud_input.opened)
    if silent < timeout:
        return ''
    topic, publishers = cloud_input.topic, node.get_publishers_info_by_topic(cloud_input.topic)
    if not publishers:
        return '' if cloud_input.heard == 1 else f'no publisher on {topic}; {suggestion(node, cloud_input)}'
    clouds = [publisher for publisher in publishers if publisher.topic_type == CLOUD_TYPE]
    if not clouds:
        return f'{topic} carries {publishers[0].topic_type}, not {CLOUD_TYPE}; {suggestion(node, cloud_input)}'
    reasons = [reason for publisher in clouds if (reason := incompatibility(cloud_input, publisher.qos_profile))]
    if len(reasons) == len(clouds):
        return f'QoS of {topic} is incompatible with its publisher ({reasons[0]}); remove the qos_overrides parameters'
    if cloud_input.heard == 1 or any(is_latched(publisher.qos_profile) for publisher in clouds):
        return ''  # published once, as maps are
    since = 'nothing heard yet' if cloud_input.heard == 0 else f'nothing heard for {silent:.0f} s'
    return f'{topic} has {len(clouds)} publisher(s) but {since}; {loss_remedy()}'


def suggestion(node, cloud_input: CloudInput) -> str:
    """Return how to reach the clouds that there are."""
    others = [
        name
        for name, kinds in node.get_topic_names_and_types()
        if CLOUD_TYPE in kinds
        and name != cloud_input.topic
        and node.count_publishers(name)
        and not name.startswith(f'{node.get_fully_qualified_name()}/')
    ]
    if not others:
        return 'nothing publishes a PointCloud2 in this ROS domain'
    return f'remap it, for example --ros-args -r {cloud_input.name}:={others[0]} (clouds are on {", ".join(others)})'


def incompatibility(cloud_input: CloudInput, offered: QoSProfile) -> str:
    """Return why no present subscription can hear a publisher; empty when one can."""
    reason = ''
    for qos in cloud_input.requested:
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
