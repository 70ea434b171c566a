"""One registration from messages to messages: decoded, registered, published, remembered for diagnostics."""

from __future__ import annotations

import functools
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

import csgm_ros
from csgm_ros.cloud.merge import merge
from csgm_ros.config import Config
from csgm_ros.errors import Cancelled, CsgmError, InputError
from csgm_ros.io.pointcloud2 import decode, stamp_of
from csgm_ros.ros.lifecycle import guarded
from csgm_ros.ros.worker import Job, Worker
from csgm_ros.types import Cloud, Prior, RegistrationResult, Similarity


@dataclass(frozen=True)
class Request:
    """The newest messages of both inputs and the configuration at the time of the request."""

    source: list[PointCloud2]
    target: list[PointCloud2]
    config: Config
    seed: int
    window_voxel: float
    place: Callable[[Cloud], Cloud] | None = None  # moves a cloud that will be merged into the fixed frame
    prior: Prior | None = None
    sensors: tuple[str, str] = ('', '')  # frames in whose origins source and target were seen from
    lookup: Callable[[str, str, int], Similarity] | None = None  # what TF tells, see Frames.lookup
    details: bool = False  # keep the outcome for a report


@dataclass(frozen=True, eq=False)
class Outcome:
    """A result and the clouds it belongs to."""

    result: RegistrationResult
    source: Cloud
    target: Cloud
    decode_seconds: float


@dataclass(frozen=True)
class Record:
    """What is to be said of the registrations so far.

    Attributes
    ----------
    accepted, rejected, failed : int
        Registrations by their end.
    level, text : bytes, str
        The last one as a diagnostic level and one line.
    last : dict
        Facts about it, for diagnostics.
    """

    accepted: int = 0
    rejected: int = 0
    failed: int = 0
    level: bytes = DiagnosticStatus.OK
    text: str = 'no registration yet'
    last: dict[str, Any] = field(default_factory=dict)


class Registration:
    """Runs requests in the worker and keeps what is to be said about them.

    It owns the record, and replaces it as a whole under its lock alone; the worker owns the jobs.
    """

    def __init__(self, node: Node, publish: Callable[[Outcome], None]):
        self._node, self._publish = node, publish
        self._worker = Worker()
        self._lock = threading.Lock()
        self._record = Record()
        self._kept: Outcome | None = None

    @property
    def record(self) -> Record:
        """What is to be said now."""
        return self._record

    @property
    def kept(self) -> Outcome | None:
        """The last outcome, where its request asked for details."""
        return self._kept

    def forget(self) -> None:
        """Forget what was registered so far."""
        with self._lock:
            self._record, self._kept = Record(), None

    @property
    def job(self) -> Job | None:
        """The job that runs or waits."""
        return self._worker.current

    def submit(self, request: Request) -> Job:
        """Queue a request in place of one that still waits."""
        return self._worker.submit(*self._work(request))

    def submit_if_idle(self, request: Request) -> tuple[Job, bool]:
        """Queue a request and return its job with True; with a job in its way, return that one with False."""
        return self._worker.submit_if_idle(*self._work(request))

    def _work(self, request: Request) -> tuple[Callable, Callable]:
        return functools.partial(run, request), guarded(self._deliver, self._node)

    def open(self) -> None:
        """Take requests."""
        self._worker.open()

    def close(self, reason: str) -> None:
        """Cancel what runs and waits, and take no more requests."""
        self._note_cancelled(self._worker.close(reason), reason)

    def cancel(self, reason: str) -> bool:
        """Cancel what runs and waits; False when nothing does."""
        cancelled = self._worker.cancel(reason)
        self._note_cancelled(cancelled, reason)
        return cancelled

    def stop(self, timeout: float) -> bool:
        """End the worker; False when its thread is still inside a computation."""
        return self._worker.stop(timeout)

    def _note_cancelled(self, cancelled: bool, reason: str) -> None:
        if cancelled:
            self._note(level=DiagnosticStatus.WARN, text=f'cancelled: {reason}')
            self._node.get_logger().info(f'cancelled: {reason}')

    def _note(self, *, count: str = '', **news: Any) -> None:
        with self._lock:
            if count:
                news[count] = getattr(self._record, count) + 1
            self._record = replace(self._record, **news)

    def _deliver(self, job: Job) -> None:
        outcome: Outcome | None = job.result
        try:
            if outcome is not None and outcome.result.accepted:
                self._publish(outcome)
        except Exception as error:
            job.error = error
        if job.error is not None:
            self._note_failure(job.error)
        elif outcome is not None:
            self._note_result(outcome)

    def _note_result(self, outcome: Outcome) -> None:
        self._kept = None if outcome.result.details is None else outcome
        accepted, text = outcome.result.accepted, describe(outcome.result)
        level = DiagnosticStatus.OK if accepted else DiagnosticStatus.WARN
        self._note(count='accepted' if accepted else 'rejected', level=level, text=text, last=facts(outcome))
        log = self._node.get_logger()
        if accepted:
            log.info(text)
        else:
            log.warning(text)

    def _note_failure(self, error: BaseException) -> None:
        text = explain(error)
        last = {'verdict': 'failed', 'reason': text}
        self._note(count='failed', level=DiagnosticStatus.ERROR, text=text, last=last)
        expected = isinstance(error, (CsgmError, MemoryError))
        detail = '' if expected else '\n' + ''.join(traceback.format_exception(error))
        self._node.get_logger().error(text + detail)


def run(request: Request, progress: Callable[[str, float], None]) -> Outcome:
    """Decode, merge and register one request; ``progress`` raises to cancel."""
    started = time.perf_counter()
    progress('decode', 0.0)
    source, target = (cloud_of(request, name) for name in ('source', 'target'))
    decode_seconds = time.perf_counter() - started
    result = csgm_ros.register(
        source.points,
        target.points,
        request.config,
        seed=request.seed,
        on_progress=progress,
        prior=request.prior,
        details=request.details,
        source_viewpoint=viewpoint_of(request, 'source'),
        target_viewpoint=viewpoint_of(request, 'target'),
    )
    return Outcome(result, source, target, decode_seconds)


def cloud_of(request: Request, name: str) -> Cloud:
    """Return the decoded and merged cloud of one input."""
    try:
        clouds = [decode(message) for message in getattr(request, name)]
        if request.place is not None and len(clouds) > 1:
            clouds = [request.place(cloud) for cloud in clouds]
        return merge(clouds, request.window_voxel)
    except InputError as error:
        raise InputError(f'{name}: {error}') from None


def viewpoint_of(request: Request, name: str) -> np.ndarray | None:
    """Return where the sensor of one input stood, in the cloud's frame; None where that is unknown or several places.

    Organised messages, as a depth camera's, are from the origin of their frame, unless another frame is configured.
    """
    messages, sensor = getattr(request, name), request.sensors[name == 'target']
    if len(messages) != 1:
        return None
    header = messages[0].header
    if not sensor:
        return np.zeros(3) if messages[0].height > 1 else None
    if sensor == header.frame_id:
        return np.zeros(3)
    if request.lookup is None:
        raise InputError(f'{name}_viewpoint is {sensor}, which needs TF')
    try:
        return request.lookup(header.frame_id, sensor, stamp_of(messages[0])).translation
    except InputError as error:
        raise InputError(f'{name}_viewpoint: {error}') from None


def describe(result: RegistrationResult) -> str:
    """Return verdict, scale, fitness and seconds, or the reason, in one line."""
    fitness = f'fitness {result.fitness_source:.2f}/{result.fitness_target:.2f}'
    matched = f'{matched_nodes(result)} supervoxels matched'
    if result.accepted:
        return f'accepted: scale {result.scale:.6g}, {fitness}, {matched}, {result.seconds:.2f} s'
    return f'rejected: {result.reason} ({fitness}, {matched}, {result.seconds:.2f} s)'


def matched_nodes(result: RegistrationResult) -> str:
    """Return how many nodes of the source have their match under the transform, of how many."""
    nodes = 0 if result.source_graph is None else len(result.source_graph.nodes)
    return f'{int(result.match_inliers.sum())}/{nodes}'


def explain(error: BaseException) -> str:
    """Return one line on why there is no result."""
    if isinstance(error, Cancelled):
        return f'cancelled: {error}'
    if isinstance(error, CsgmError):
        return f'failed: {error}'
    if isinstance(error, MemoryError):
        return 'failed: out of memory; send fewer points, or lower max_points and the windows'
    return f'failed: internal error, {type(error).__name__}: {error}; the traceback is in the log'


def facts(outcome: Outcome) -> dict[str, Any]:
    """Return what diagnostics say of a result, keys in a fixed order."""
    result = outcome.result
    stamp = max(outcome.source.stamp, outcome.target.stamp)
    return {
        'verdict': 'accepted' if result.accepted else 'rejected',
        'reason': result.reason,
        'stamp': f'{stamp // 10**9}.{stamp % 10**9:09d}',
        'frame': outcome.target.frame_id,
        'scale': f'{result.scale:.9g}',
        'fitness source': f'{result.fitness_source:.4f}',
        'fitness target': f'{result.fitness_target:.4f}',
        'inlier rmse': f'{result.verdict.inlier_rmse:.6g}',
        'confidence': f'{result.confidence:.3f}',
        'matches': matched_nodes(result),
        'matches unguided': f'{int(result.unguided_inliers.sum())}/{len(result.unguided_matches)}',
        'source points': len(outcome.source.points),
        'target points': len(outcome.target.points),
        'dropped points': outcome.source.dropped + outcome.target.dropped,
        'seed': result.seed,
        'seconds': f'{result.seconds:.3f}',
        'seconds decode': f'{outcome.decode_seconds:.3f}',
        **{f'seconds {stage}': f'{seconds:.3f}' for stage, seconds in result.timings.items()},
    }
