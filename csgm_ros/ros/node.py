"""The node: lifecycle, inputs, triggers and services, wired to one registration at a time."""

from __future__ import annotations

import functools
import sys
import threading
from collections.abc import Callable
from dataclasses import replace

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from std_srvs.srv import Trigger

from csgm_ros.errors import InputError
from csgm_ros.ros.diagnostics import diagnostics
from csgm_ros.ros.frames import Frames
from csgm_ros.ros.inputs import CloudInput, Window
from csgm_ros.ros.lifecycle import SafeLifecycleNode, guarded, transition
from csgm_ros.ros.outputs import Outputs
from csgm_ros.ros.parameters import Parameters
from csgm_ros.ros.registration import Outcome, Registration, Request, describe, explain
from csgm_ros.ros.worker import Job
from csgm_ros.types import Cloud

SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
ERROR = TransitionCallbackReturn.ERROR


class CsgmNode(SafeLifecycleNode):
    """Registers the newest source cloud to the newest target cloud: ``x_target = s R x_source + t``."""

    def __init__(self, **kwargs):
        super().__init__('csgm', **kwargs)
        self._settings = Parameters(self)
        self._registration = Registration(self, self._publish)
        self._source, self._target = (
            CloudInput(self, name, functools.partial(self._window, name), self._on_cloud)
            for name in ('source', 'target')
        )
        self._inputs = [self._source, self._target]
        self._outputs: Outputs | None = None
        self._frames, self._frames_complaint = Frames(self), ''
        self._pairing = threading.Lock()  # the two inputs are received in different threads
        self._paired: tuple[int, int] | None = None  # clouds received of each input at the last automatic request
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        busy = ReentrantCallbackGroup()  # a waiting ~/register must not keep a second one from its answer
        self.create_service(Trigger, '~/register', self._answering(self._on_register), callback_group=busy)
        self.create_service(Trigger, '~/cancel', self._answering(self._on_cancel), callback_group=busy)
        steady, monitor = Clock(clock_type=ClockType.STEADY_TIME), MutuallyExclusiveCallbackGroup()
        self.create_timer(0.5, guarded(self._on_monitor, self), clock=steady, callback_group=monitor)
        period = self._settings.node_config.diagnostics_period
        self.create_timer(period, guarded(self._on_diagnostics, self), clock=steady, callback_group=monitor)
        if self._settings.node_config.autostart:
            self._autostart = self.create_timer(0.0, guarded(self._on_autostart, self), clock=steady)

    def _window(self, name: str) -> Window:
        settings = self._settings.node_config
        return Window(getattr(settings, f'{name}_window'), settings.max_points)

    # Lifecycle

    @transition(FAILURE, undo='_release')
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Create the outputs and compile the kernels; to inactive, or back to unconfigured on FAILURE."""
        self.get_logger().info('configuring: compiling and loading the kernels, the first time takes a minute')
        warm_up_once()
        self._registration.forget()
        self._outputs = Outputs(self)
        self.get_logger().info(f'configured, profile {self._settings.config.profile}')
        return super().on_configure(state)

    @transition(FAILURE, undo='_stop_work')
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe; to active, or back to inactive on FAILURE."""
        super().on_activate(state)
        settings = self._settings.node_config
        with self._pairing:
            self._paired = None
        self._frames.open()
        if settings.fixed_frame:
            self._frames.listen()
        self._registration.open()
        self._source.open()
        self._target.open()
        topics = f'source {self._source.topic}, target {self._target.topic}'
        self.get_logger().info(f'active: {topics}, trigger {settings.trigger}')
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
        for cloud_input in self._inputs:
            cloud_input.close()
        self._frames.close()
        self._registration.close(reason)

    def _release(self) -> None:
        if self._outputs is not None:
            self._outputs.destroy()
            self._outputs = None

    def _on_autostart(self) -> None:
        self.destroy_timer(self._autostart)
        if self.trigger_configure() == SUCCESS:
            self.trigger_activate()

    def stop(self, timeout: float) -> bool:
        """Stop without a transition, as signals do; False when a computation is still running."""
        self._stop_work('the node stops')
        return self._registration.stop(timeout)

    # Requests

    def _request(self) -> Request | str:
        """Return the newest pair with the present parameters, or why there is none."""
        if self.state != 'active':
            return f'the node is {self.state}; configure and activate it first'
        config, settings = self._settings.current
        source, target = self._source.messages, self._target.messages
        for cloud_input, messages in ((self._source, source), (self._target, target)):
            if not messages:
                return f'no cloud on {cloud_input.topic} yet ({cloud_input.explanation})'
        return Request(
            source, target, config, settings.seed, settings.window_voxel, self._placing(settings.fixed_frame)
        )

    def _placing(self, fixed: str) -> Callable[[Cloud], Cloud] | None:
        """Return what moves a cloud into the fixed frame, None where there is none."""
        if not fixed:
            return None

        def place(cloud: Cloud) -> Cloud:
            moved = self._frames.lookup(fixed, cloud.frame_id, cloud.stamp).apply(cloud.points)
            return replace(cloud, points=moved, frame_id=fixed)

        return place

    def _on_register(self) -> tuple[bool, str]:
        request = self._request()
        if isinstance(request, str):
            return False, request
        job, ours = self._registration.submit_if_idle(request)
        if not ours:
            return False, f'busy: {job.stage}, {job.seconds:.1f} s so far; wait, or call ~/cancel'
        del request  # or its clouds live until the answer
        job.done.wait()
        return answer(job)

    def _on_cancel(self) -> tuple[bool, str]:
        cancelled = self._registration.cancel('asked by ~/cancel')
        return cancelled, 'cancelled' if cancelled else 'no registration is running'

    def _answering(self, method):
        """Make a Trigger callback of a method that returns (success, message)."""
        safe = guarded(method, self, (False, 'internal error; the traceback is in the log of the node'))

        def callback(_, response: Trigger.Response) -> Trigger.Response:
            response.success, response.message = safe()
            return response

        return callback

    def _on_cloud(self) -> None:
        """Start a registration where the trigger parameter asks for one."""
        trigger = self._settings.node_config.trigger
        if trigger == 'on_request':
            return
        with self._pairing:
            counts = self._source.received, self._target.received
            wanted = {
                'on_first_pair': self._paired is None,
                'on_new_source': self._paired is None or self._paired[0] != counts[0],
                'on_every_pair': True,
            }[trigger]
            request = self._request() if wanted else ''
            if isinstance(request, Request):
                self._paired = counts
                self._registration.submit(request)

    # Outputs

    def _publish(self, outcome: Outcome) -> None:
        settings = self._settings.node_config
        child = settings.child_frame or f'{outcome.source.frame_id}_scaled'
        outputs = self._outputs
        if outputs is not None:
            outputs.publish(outcome.result, outcome.source, outcome.target, child, tf=settings.publish_tf)

    def _on_monitor(self) -> None:
        if self.state == 'active':
            self._follow_frames()
            for cloud_input in self._inputs:
                cloud_input.monitor(self._settings.node_config.input_timeout)
        outputs = self._outputs
        if outputs is not None:
            outputs.publish_graphs()

    def _follow_frames(self) -> None:
        """Listen to TF where a fixed frame is set, also while the node is active; say once why that cannot be."""
        complaint = ''
        if self._settings.node_config.fixed_frame:
            try:
                self._frames.listen()
            except InputError as error:
                complaint = str(error)
        if complaint and complaint != self._frames_complaint:
            self.get_logger().error(complaint)
        self._frames_complaint = complaint

    def _on_diagnostics(self) -> None:
        self._diagnostics.publish(diagnostics(self, self._inputs, self._registration))


@functools.cache
def warm_up_once() -> None:
    """Import and compile what a registration needs, so that the first one is as fast as the others."""
    from csgm_ros.registration import warm_up

    warm_up()


def answer(job: Job) -> tuple[bool, str]:
    """Return what ~/register says of a finished job."""
    if job.error is not None:
        return False, explain(job.error)
    return job.result.result.accepted, describe(job.result.result)


def main(args: list[str] | None = None) -> int:
    """Run the node until a signal; return 0, or 2 when a start-up parameter is not usable."""
    from csgm_ros.ros.runtime import run_node

    return run_node(CsgmNode, args)


if __name__ == '__main__':
    sys.exit(main())
