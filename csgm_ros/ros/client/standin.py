"""A process that publishes what a file holds, in place of a sensor."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from csgm_ros.ros.dds import use_large_buffers


def publish_file(kind: Callable[[dict[str, np.ndarray]], Node], arguments: list[str] | None) -> int:
    """Spin a node made of the arrays of an .npz file, the first argument, until SIGINT or SIGTERM."""
    path = (sys.argv[1:] if arguments is None else arguments)[0]
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    use_large_buffers()
    rclpy.init()
    node = kind(arrays)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    node.destroy_node()
    rclpy.try_shutdown()
    return 0
