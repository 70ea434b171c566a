"""A process around the node: signals end it in under a second, whatever it is doing."""

from __future__ import annotations

import os
import signal
import sys
from typing import NoReturn

import rclpy
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.logging import get_logger

from csgm_ros.errors import ConfigError
from csgm_ros.ros.dds import use_large_buffers

THREADS = 6  # inputs, watch, transitions, and a waiting ~/register beside a second caller
PATIENCE = 0.1  # seconds that the worker and the executor may each take to stop


def run_node(node_type: type, args: list[str] | None = None) -> int:
    """Spin ``node_type()`` until SIGINT or SIGTERM; return 2 where it cannot start, else end the process with 0."""
    transports = use_large_buffers()
    rclpy.init(args=args)
    try:
        node = node_type()
    except (InvalidParameterTypeException, InvalidParameterValueException, ConfigError) as error:
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
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
    return leave(node, executor)


def leave(node, executor) -> NoReturn:
    """Take everything down that lets itself be taken down, and end the process.

    Without the interpreter's own teardown: it waits for threads inside a computation, and with Open3D and numba
    loaded it takes a second even when there is none.
    """
    idle = node.stop(PATIENCE)
    idle &= executor.shutdown(timeout_sec=PATIENCE)
    if idle:
        node.destroy_node()
    rclpy.try_shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)
