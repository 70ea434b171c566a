"""A process around the node: signals end it in under a second, whatever it is doing."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NoReturn

import rclpy
from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.logging import get_logger

from csgm_ros.errors import ConfigError
from csgm_ros.ros.dds import connection_error, use_large_buffers
from csgm_ros.ros.memory import share_pools
from csgm_ros.ros.shared_memory import remove_own, remove_stale

THREADS = 6  # inputs, monitor, transitions, and a waiting ~/register beside a second caller
PATIENCE = 0.1  # seconds that the worker and the executor may each take to stop
CANNOT_START = 2
PAUSE = 0.1  # seconds before the next message is taken, once memory was short


class SteadyExecutor(MultiThreadedExecutor):
    """Executor that lives on when there is no memory for a message: it is left out, and said.

    That of rclpy ends ``spin()``, and with it the node, and blocks the callback group of the message for ever.
    """

    def _take_subscription(self, entity):
        return self._taken(super()._take_subscription, entity)

    def _take_service(self, entity):
        return self._taken(super()._take_service, entity)

    @staticmethod
    def _taken(take: Callable, entity):
        try:
            return take(entity)
        except (MemoryError, RCLError) as error:
            what = 'out of memory' if isinstance(error, MemoryError) else str(error).splitlines()[0]
            get_logger('csgm').error(f'a message could not be taken and is left out: {what}')
            time.sleep(PAUSE)
            return None


@dataclass
class Parts:
    """What has been made so far, as a signal may come before all of it is there."""

    node: Any = None  # of the type that live() is given
    executor: MultiThreadedExecutor | None = None


def run_node(node_type: type, args: list[str] | None = None) -> int:
    """Spin ``node_type()`` until SIGINT or SIGTERM; return 2 where it cannot start, else end the process with 0."""
    parts, refused = Parts(), ''
    try:
        refused = live(parts, node_type, args)
    except KeyboardInterrupt:
        pass
    finally:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
    if refused:
        get_logger('csgm').fatal(f'cannot start: {refused}')
        rclpy.try_shutdown()
        return CANNOT_START
    return leave(parts)


def live(parts: Parts, node_type: type, args: list[str] | None) -> str:
    """Make the node and spin it until a signal; return why it cannot start, else an empty string."""
    share_pools()
    transports = use_large_buffers()
    remove_stale()
    try:
        rclpy.init(args=args)
        parts.node = node_type()
        parts.node.get_logger().info(transports)
        parts.executor = SteadyExecutor(THREADS)
        parts.executor.add_node(parts.node)
        spin(parts.executor)
    except ExternalShutdownException:
        return ''
    except (InvalidParameterTypeException, InvalidParameterValueException, ConfigError) as error:
        return str(error)
    except Exception as error:
        if ended_by_signal():
            return ''
        if isinstance(error, (RCLError, UnknownROSArgsError)):
            return connection_error(error)
        raise
    return ''


def spin(executor: MultiThreadedExecutor) -> None:
    """Spin until the context is shut down, through shortness of memory."""
    while rclpy.ok():
        try:
            executor.spin()
        except MemoryError:
            get_logger('csgm').error('out of memory; the node goes on')
            time.sleep(PAUSE)


def ended_by_signal() -> bool:
    """Tell whether the context was taken down: a signal does that at any time, and what needs it raises."""
    return rclpy.get_default_context().handle is not None and not rclpy.ok()


def leave(parts: Parts) -> NoReturn:
    """Take everything down that lets itself be taken down, and end the process.

    Without the interpreter's own teardown: it waits for threads inside a computation, and with Open3D and numba
    loaded it takes a second even when there is none.
    """
    idle = parts.node is not None and parts.node.stop(PATIENCE)
    if parts.executor is not None:
        idle &= parts.executor.shutdown(timeout_sec=PATIENCE)
    if idle and parts.node is not None:
        parts.node.destroy_node()
    rclpy.try_shutdown()
    remove_own()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)
