"""Fast DDS with buffers that hold a whole cloud: the default ones lose most best-effort clouds of a few MB."""

from __future__ import annotations

import os
from pathlib import Path

from csgm_ros.errors import InputError
from csgm_ros.io.resources import config_file

PROFILE_VARIABLE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
OTHER_CHOICES = ('FASTDDS_DEFAULT_PROFILES_FILE', 'FASTDDS_BUILTIN_TRANSPORTS')
BUFFER_BYTES = 4 * 2**20
BUFFER_LIMIT = Path('/proc/sys/net/core/rmem_max')
REMEDY = (
    f'best-effort clouds of several MB are lost where buffers are small: start the publisher with {PROFILE_VARIABLE} '
    f'set to the fastdds.xml of this package, between machines also sudo sysctl -w net.core.rmem_max={BUFFER_BYTES}; '
    'or let it publish reliably'
)


def use_large_buffers() -> str:
    """Select the shipped profile for this process unless the user chose transports; return what holds, for the log.

    Must be called before ``rclpy.init``.
    """
    for variable in (PROFILE_VARIABLE, *OTHER_CHOICES):
        if variable in os.environ:
            return f'transports as {variable}={os.environ[variable]} says'
    if os.environ.get('RMW_IMPLEMENTATION', 'rmw_fastrtps_cpp') != 'rmw_fastrtps_cpp':
        return f'transports of {os.environ["RMW_IMPLEMENTATION"]}'
    try:
        profile = config_file('fastdds.xml')
    except InputError as error:
        return f'transports of Fast DDS by default: {error}'
    os.environ[PROFILE_VARIABLE] = str(profile)
    return f'transports with large buffers from {profile}'


def buffer_limit() -> int:
    """Return the largest receive buffer the kernel grants, bytes; 0 where it does not say."""
    try:
        return int(BUFFER_LIMIT.read_text())
    except (OSError, ValueError):
        return 0


def connection_error(error: Exception) -> str:
    """Return in one line why ROS cannot be joined, and the remedy."""
    reason = str(error).splitlines()[0].strip()
    if os.environ.get('ROS_SECURITY_ENABLE', '').lower() != 'true':
        return reason
    return (
        f'security (SROS 2) is on, and {reason}. The Fast DDS of the Python wheels has no security: use a ROS install '
        'with a keystore (see the README), or unset ROS_SECURITY_ENABLE'
    )
