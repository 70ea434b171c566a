"""A lifecycle node that no client and no exception can end."""

from __future__ import annotations

import functools
import traceback
from collections.abc import Callable
from typing import Any

from rclpy._rclpy_pybind11 import RCLError
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.node import Node
from std_srvs.srv import Trigger

from csgm_ros.errors import CsgmError


def guarded(callback: Callable, node: Node, fallback: Any = None) -> Callable:
    """Return ``callback`` so wrapped that an exception is logged and ``fallback`` returned.

    rclpy lets an exception of any callback leave ``spin()``, which would end the node. One raised on purpose is
    one line, any other comes with its traceback.
    """

    @functools.wraps(callback)
    def call(*args, **kwargs):
        try:
            return callback(*args, **kwargs)
        except CsgmError as error:
            node.get_logger().error(str(error))
        except Exception:
            node.get_logger().error(f'{callback.__name__} failed:\n{traceback.format_exc()}')
        return fallback() if callable(fallback) else fallback

    return call


def answering(method: Callable[[], tuple[bool, str]], node: Node) -> Callable:
    """Make a Trigger callback of a method that returns (success, message)."""
    safe = guarded(method, node, (False, 'internal error; the traceback is in the log of the node'))

    def callback(_, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = safe()
        return response

    return callback


class SafeLifecycleNode(LifecycleNode):
    """LifecycleNode that answers an illegal transition with a failure instead of dying of it.

    rclpy 7.1 raises RCLError out of ``spin()`` when, say, an unconfigured node is activated, swallows exceptions of
    the transition callbacks without a word, and keeps the participant of a destroyed node alive.
    """

    def _LifecycleNodeMixin__change_state(self, transition_id: int) -> TransitionCallbackReturn:  # noqa: N802
        try:
            return LifecycleNode._LifecycleNodeMixin__change_state(self, transition_id)  # type: ignore[attr-defined]
        except RCLError as error:
            state = self._state_machine.current_state[1]
            self.get_logger().warning(f'transition {transition_id} is not possible while {state}: {error}')
            return TransitionCallbackReturn.FAILURE

    def destroy_node(self) -> None:
        """Destroy the node, its state machine too: that holds the node's handle, and with it the shared memory."""
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()

    @property
    def state(self) -> str:
        """Label of the current lifecycle state, such as ``active``."""
        return self._state_machine.current_state[1]


def transition(on_exception: TransitionCallbackReturn, undo: str = '') -> Callable:
    """Decorate an ``on_*`` method: log an exception and return ``on_exception``.

    ``undo`` names a method that takes back what was done up to the exception.
    """

    def decorate(method: Callable) -> Callable:
        @functools.wraps(method)
        def call(self, state):
            def fallback() -> TransitionCallbackReturn:
                if undo:
                    guarded(getattr(self, undo), self)()
                return on_exception

            return guarded(method.__get__(self), self, fallback)(state)

        return call

    return decorate
