"""The node: its lifecycle and diagnostics, around what one mode does."""

from __future__ import annotations

import sys
from typing import Protocol

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn

from csgm_ros.ros.diagnostics import diagnostics
from csgm_ros.ros.frames import Frames
from csgm_ros.ros.inputs import CloudInput
from csgm_ros.ros.lifecycle import SafeLifecycleNode, guarded, transition
from csgm_ros.ros.pairing import Pairing
from csgm_ros.ros.parameters import Parameters
from csgm_ros.ros.tracking import Tracking

SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
ERROR = TransitionCallbackReturn.ERROR
MODES = {'pair': Pairing, 'tracking': Tracking}


class Mode(Protocol):
    """What the node does between its transitions."""

    inputs: list[CloudInput]

    def configure(self) -> None:
        """Get ready; raise where that cannot be."""

    def open(self) -> str:
        """Listen; return what to, in one line."""

    def close(self, reason: str) -> None:
        """Listen no more, and end the work."""

    def release(self) -> None:
        """Take down what :meth:`configure` made."""

    def stop(self, timeout: float) -> bool:
        """End every thread; False when a computation is still running."""

    def status(self, name: str) -> DiagnosticStatus:
        """Return what is to be said of the work; ``name`` is the node's."""

    def monitor(self) -> None:
        """Do what is to be done twice a second."""


class CsgmNode(SafeLifecycleNode):
    """One mode with a lifecycle."""

    def __init__(self, **kwargs):
        super().__init__('csgm', **kwargs)
        self._settings = Parameters(self)
        self._frames = Frames(self)
        self._mode: Mode = MODES[self._settings.node_config.mode](self, self._settings, self._frames)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        steady, monitor = Clock(clock_type=ClockType.STEADY_TIME), MutuallyExclusiveCallbackGroup()
        self.create_timer(0.5, guarded(self._on_monitor, self), clock=steady, callback_group=monitor)
        period = self._settings.node_config.diagnostics_period
        self.create_timer(period, guarded(self._on_diagnostics, self), clock=steady, callback_group=monitor)
        if self._settings.node_config.autostart:
            self._autostart = self.create_timer(0.0, guarded(self._on_autostart, self), clock=steady)

    # Lifecycle

    @transition(FAILURE, undo='_release')
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Create the outputs and compile the kernels; to inactive, or back to unconfigured on FAILURE."""
        self.get_logger().info('configuring: compiling and loading the kernels, the first time takes a minute')
        self._mode.configure()
        mode = self._settings.node_config.mode
        self.get_logger().info(f'configured, profile {self._settings.config.profile}, mode {mode}')
        return super().on_configure(state)

    @transition(FAILURE, undo='_stop_work')
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe; to active, or back to inactive on FAILURE."""
        super().on_activate(state)
        self._frames.open()
        self.get_logger().info(f'active: {self._mode.open()}')
        return SUCCESS

    @transition(ERROR)
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Unsubscribe, cancel the work, forget the clouds; to inactive."""
        self._stop_work('the node was deactivated')
        return super().on_deactivate(state)

    @transition(ERROR)
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take the outputs down; to unconfigured."""
        self._release()
        return SUCCESS

    @transition(ERROR)
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop everything, from any state; to finalized."""
        self._stop_work('the node was shut down')
        self._release()
        return SUCCESS

    @transition(FAILURE)
    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Bring everything down after a failed transition; to unconfigured, or to finalized when that fails too."""
        self.get_logger().error(f'a transition from {state.label} failed; the node is unconfigured now')
        self._stop_work('a transition failed')
        self._release()
        return SUCCESS

    def _stop_work(self, reason: str = 'the node is not active') -> None:
        self._frames.close()
        self._mode.close(reason)

    def _release(self) -> None:
        self._mode.release()

    def _on_autostart(self) -> None:
        self.destroy_timer(self._autostart)
        if self.trigger_configure() == SUCCESS:
            self.trigger_activate()

    def stop(self, timeout: float) -> bool:
        """Stop without a transition, as signals do; False when a computation is still running."""
        self._stop_work('the node stops')
        return self._mode.stop(timeout)

    # Timers

    def _on_monitor(self) -> None:
        if self.state == 'active':
            for cloud_input in self._mode.inputs:
                cloud_input.monitor(self._settings.node_config.input_timeout)
        self._mode.monitor()

    def _on_diagnostics(self) -> None:
        self._diagnostics.publish(diagnostics(self, self._mode))


def main(args: list[str] | None = None) -> int:
    """Run the node until a signal; return 0, or 2 when a start-up parameter is not usable."""
    from csgm_ros.ros.runtime import run_node

    return run_node(CsgmNode, args)


if __name__ == '__main__':
    sys.exit(main())
