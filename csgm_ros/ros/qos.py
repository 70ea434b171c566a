"""Which QoS an input asks for, given what its publishers offer and what the user fixed."""

from __future__ import annotations

from collections.abc import Iterable

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from csgm_ros.errors import ConfigError

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
RELIABILITIES = (ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT)
POLICIES = {'reliability': ReliabilityPolicy, 'durability': DurabilityPolicy, 'history': HistoryPolicy}
# With a depth of 1, clouds of a publisher that catches up are lost, and so are those that come while Python is busy.
DEFAULTS = {'reliability': 'best_available', 'durability': 'best_available', 'history': 'keep_last', 'depth': 5}


def declare_overrides(node: Node, topic: str) -> dict:
    """Declare the standard ``qos_overrides.TOPIC.subscription.*`` parameters and return their values.

    ``best_available``, the default of reliability and durability, follows the publishers.

    Raises
    ------
    ConfigError
        For a value that is no policy; the message names the parameter and the choices.
    """
    values = {}
    for policy, default in DEFAULTS.items():
        name = f'qos_overrides.{topic}.subscription.{policy}'
        described = ParameterDescriptor(description=f'{policy} of the subscription to {topic}', read_only=True)
        value = node.declare_parameter(name, default, described).value
        if policy in POLICIES:
            choices = [member.name.lower() for member in POLICIES[policy] if member.name.lower() != 'unknown']
            if value not in choices:
                raise ConfigError(f'{name} must be one of {", ".join(choices)}, not {value!r}')
            value = POLICIES[policy][value.upper()]
        values[policy] = value
    return values


def subscription_qos(offers: Iterable, overrides: dict) -> set[tuple[ReliabilityPolicy, DurabilityPolicy]]:
    """Return the (reliability, durability) of the subscriptions that hear every publisher as well as it can be heard.

    While there is no publisher these are two: one of best effort alone would miss what a reliable publisher sends
    at once, as ``ros2 topic pub --once`` does, and a reliable one does not hear a sensor.

    Parameters
    ----------
    offers : iterable of rclpy.endpoint_info.TopicEndpointInfo
        The publishers of the topic.
    overrides : dict
        As of :func:`declare_overrides`.
    """
    offers = [offer.qos_profile for offer in offers]
    reliable = [offer.reliability == ReliabilityPolicy.RELIABLE for offer in offers]
    latched = [
        sure and offer.durability == DurabilityPolicy.TRANSIENT_LOCAL
        for sure, offer in zip(reliable, offers, strict=True)
    ]
    wanted = set()
    if any(latched):
        wanted.add((ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL))
    if not all(latched):
        wanted.add((RELIABILITIES[not all(reliable)], DurabilityPolicy.VOLATILE))
    if not offers:
        wanted = {(reliability, DurabilityPolicy.VOLATILE) for reliability in RELIABILITIES}
    fixed_reliability, fixed_durability = overrides['reliability'], overrides['durability']
    return {
        (
            reliability if fixed_reliability == ReliabilityPolicy.BEST_AVAILABLE else fixed_reliability,
            durability if fixed_durability == DurabilityPolicy.BEST_AVAILABLE else fixed_durability,
        )
        for reliability, durability in wanted
    }
