"""A process around the node: signals end it in under a second, whatever it is doing."""

from __future__ import annotations

import os
import signal
import sys
import threading

import rclpy
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.logging import get_logger

from csgm_ros.errors import ConfigError
from csgm_ros.ros.dds import use_large_buffers

THREADS = 6  # inputs, watch, transitions, and a waiting ~/register beside a second caller
PATIENCE = 0.3  # seconds that each of the last steps may take


def run_node(node_type: type, args: list[str] | None = None) -> int:
    """Spin ``node_type()`` until SIGINT or SIGTERM; return the exit code."""
    transports = use_large_buffers()
    rclpy.init(args=args)
    try:
        node = node_type()
    except (InvalidParameterTypeException, InvalidParameterValueException, ConfigError, ValueError) as error:
        get_logger('csgm').fatal(f'cannot start: {error}')
        rclpy.try_shutdown()
        return 2
    node.get_logger().info(transports)
    executor = MultiThreadedExecutor(THREADS)
    executor.add_node(node)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        finish(node, executor)
    return 0


def finish(node, executor) -> None:
    """Take everything down; leave at once where a computation in C does not let its thread go."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    clean = node.stop(PATIENCE)
    clean &= executor.shutdown(timeout_sec=PATIENCE)
    if clean:
        node.destroy_node()
    rclpy.try_shutdown()
    clean &= not any(thread.name.startswith('ThreadPoolExecutor') and False for thread in threading.enumerate())
    if not clean:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)
