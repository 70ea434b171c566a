"""What the node does in mode pair: two inputs, the triggers, the services, one registration at a time."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from dataclasses import replace

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.callback_groups import ReentrantCallbackGroup
from std_srvs.srv import Trigger

from csgm_ros.config import NodeConfig
from csgm_ros.errors import InputError
from csgm_ros.ros.diagnostics import registration_status
from csgm_ros.ros.frames import Frames
from csgm_ros.ros.inputs import CloudInput, Window
from csgm_ros.ros.lifecycle import SafeLifecycleNode, answering
from csgm_ros.ros.outputs import Outputs
from csgm_ros.ros.parameters import Parameters
from csgm_ros.ros.registration import Outcome, Registration, Request, describe, explain
from csgm_ros.ros.worker import Job
from csgm_ros.types import Cloud


class Pairing:
    """Registers the newest source cloud to the newest target cloud: ``x_target = s R x_source + t``."""

    def __init__(self, node: SafeLifecycleNode, settings: Parameters, frames: Frames):
        self._node, self._settings, self._frames = node, settings, frames
        self._frames_complaint = ''
        self._registration = Registration(node, self._publish)
        self._source, self._target = (
            CloudInput(node, name, functools.partial(self._window, name), self._on_cloud)
            for name in ('source', 'target')
        )
        self.inputs = [self._source, self._target]
        self._outputs: Outputs | None = None
        self._pairing = threading.Lock()  # the two inputs are received in different threads
        self._paired: tuple[int, int] | None = None  # clouds received of each input at the last automatic request
        busy = ReentrantCallbackGroup()  # a waiting ~/register must not keep a second one from its answer
        for name, method in (
            ('register', self._on_register),
            ('cancel', self._on_cancel),
            ('save_report', self._on_save_report),
        ):
            node.create_service(Trigger, f'~/{name}', answering(method, node), callback_group=busy)

    def _window(self, name: str) -> Window:
        settings = self._settings.node_config
        return Window(getattr(settings, f'{name}_window'), settings.max_points)

    def configure(self) -> None:
        """Compile the kernels and create the outputs."""
        warm_up_once()
        self._registration.forget()
        self._outputs = Outputs(self._node)

    def open(self) -> str:
        """Listen; return what to, in one line."""
        settings = self._settings.node_config
        with self._pairing:
            self._paired = None
        if needs_tf(settings):
            self._frames.listen()
        self._registration.open()
        for cloud_input in self.inputs:
            cloud_input.open()
        return f'source {self._source.topic}, target {self._target.topic}, trigger {settings.trigger}'

    def close(self, reason: str) -> None:
        """Listen no more, cancel the work and forget the clouds."""
        for cloud_input in self.inputs:
            cloud_input.close()
        self._registration.close(reason)

    def release(self) -> None:
        """Take the outputs down."""
        if self._outputs is not None:
            self._outputs.destroy()
            self._outputs = None

    def stop(self, timeout: float) -> bool:
        """End the worker; False when a computation is still running."""
        return self._registration.stop(timeout)

    def status(self, name: str) -> DiagnosticStatus:
        """Return what is to be said of the registrations."""
        return registration_status(f'{name}: registration', self._node.state, self._registration)

    # Requests

    def _request(self) -> Request | str:
        """Return the newest pair with the present parameters, or why there is none."""
        if self._node.state != 'active':
            return f'the node is {self._node.state}; configure and activate it first'
        config, settings = self._settings.current
        source, target = self._source.messages, self._target.messages
        for cloud_input, messages in ((self._source, source), (self._target, target)):
            if not messages:
                return f'no cloud on {cloud_input.topic} yet ({cloud_input.explanation})'
        try:
            prior = self._settings.prior
        except InputError as error:
            return str(error)
        return Request(
            source,
            target,
            config,
            settings.seed,
            settings.window_voxel,
            self._placing(settings.fixed_frame),
            prior,
            (settings.source_viewpoint, settings.target_viewpoint),
            self._frames.lookup,
            bool(settings.report_folder),
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

    def _on_save_report(self) -> tuple[bool, str]:
        folder, outcome = self._settings.node_config.report_folder, self._registration.kept
        if not folder:
            return False, 'report_folder is empty; set it, register, and call again'
        if outcome is None:
            return False, 'nothing was registered since report_folder is set; call ~/register first'
        from csgm_ros.ros.reports import save_report

        try:
            return True, str(save_report(folder, outcome))
        except InputError as error:
            return False, str(error)

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

    def monitor(self) -> None:
        """Follow what changes: parameters, and who listens."""
        if self._node.state == 'active':
            self._follow_frames()
        outputs = self._outputs
        if outputs is not None:
            outputs.publish_graphs()

    def _follow_frames(self) -> None:
        """Listen to TF where a frame is set, also while the node is active; say once why that cannot be."""
        complaint = ''
        if needs_tf(self._settings.node_config):
            try:
                self._frames.listen()
            except InputError as error:
                complaint = str(error)
        if complaint and complaint != self._frames_complaint:
            self._node.get_logger().error(complaint)
        self._frames_complaint = complaint


def needs_tf(settings: NodeConfig) -> bool:
    """Return whether a parameter names a frame that only TF knows."""
    return bool(settings.fixed_frame or settings.source_viewpoint or settings.target_viewpoint)


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
