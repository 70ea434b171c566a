"""Frames to poses in one thread: the newest frame wins, those it overtakes are counted."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from csgm_ros.config import Config
from csgm_ros.errors import Cancelled, CsgmError, InputError
from csgm_ros.io.pointcloud2 import decode, stamp_of
from csgm_ros.ros.lifecycle import guarded
from csgm_ros.ros.worker import Job, Worker
from csgm_ros.tracking.maps import PreparedMap, prepare_map
from csgm_ros.tracking.session import Session
from csgm_ros.types import Cloud, Estimate, Prior, Similarity

RECENT = 50  # frames that rate and latency are told of
SPAN = 5.0  # seconds that the rate is told of

Odometry = Callable[[str, int], Similarity | None]


@dataclass(frozen=True, eq=False)
class Tracked:
    """One frame and what the session said of it.

    Attributes
    ----------
    estimate : Estimate
    frame_id, stamp : str, int
        Of the frame; nanoseconds.
    map_frame : str
        Frame of the map.
    odometry : Similarity or None
        From the sensor to the odometry's frame at that time, where known.
    """

    estimate: Estimate
    frame_id: str
    stamp: int
    map_frame: str
    odometry: Similarity | None


@dataclass(frozen=True)
class Record:
    """What is to be said of the frames so far.

    Attributes
    ----------
    frames, dropped, failed : int
        Frames that were worked on, overtaken by a newer one or ahead of the map, and not usable.
    last : Estimate or None
    complaint : str
        Why the last frame was not usable, or why there is no map.
    """

    frames: int = 0
    dropped: int = 0
    failed: int = 0
    last: Estimate | None = None
    complaint: str = ''


def seen(message: PointCloud2) -> Cloud:
    """Return the points of a frame: none where the sensor is covered, which is no fault of the message."""
    try:
        return decode(message)
    except InputError:  # its layout was checked when it came
        return Cloud(np.empty((0, 3)), None, message.header.frame_id, stamp_of(message))


class Tracker:
    """Owns the session and its map; the worker's thread alone touches them.

    The record is replaced as a whole under the lock, and so is what the other threads ask for.
    """

    def __init__(self, node: Node, publish: Callable[[Tracked], None], on_map: Callable[[PreparedMap, str], None]):
        self._node, self._publish, self._on_map = node, publish, on_map
        self._worker = Worker()
        self._lock = threading.Lock()
        self._record = Record()
        self._done: deque[tuple[float, float]] = deque(maxlen=RECENT)  # when, and seconds since the frame came
        self._session: Session | None = None
        self._map_frame = self._sensor_frame = ''
        self._new_map: tuple[PointCloud2 | PreparedMap, str] | None = None
        self._asked: list[Callable[[Session], None]] = []
        self._last: Job | None = None
        self._executor: ThreadPoolExecutor | None = None

    @property
    def record(self) -> Record:
        """What is to be said now."""
        return self._record

    @property
    def map_frame(self) -> str:
        """Frame of the present map, empty where there is none."""
        return self._map_frame

    @property
    def sensor_frame(self) -> str:
        """Frame of the last frame, empty before the first."""
        return self._sensor_frame

    @property
    def pace(self) -> tuple[float, float, float]:
        """Frames a second lately, and the median and 95th percentile of the seconds from a frame to its pose."""
        done = [item for item in list(self._done) if item[0] > time.monotonic() - SPAN]
        if len(done) < 2:
            return 0.0, 0.0, 0.0
        waits = np.quantile([wait for _, wait in done], (0.5, 0.95))
        return (len(done) - 1) / max(done[-1][0] - done[0][0], 1e-3), float(waits[0]), float(waits[1])

    def open(self) -> None:
        """Take frames."""
        with self._lock:
            self._record = Record()
            self._executor = ThreadPoolExecutor(1, thread_name_prefix='csgm_search')
        self._done.clear()
        self._worker.open()

    def close(self, reason: str) -> None:
        """Take no more frames, and forget where the sensor was."""
        self._worker.close(reason)
        with self._lock:
            session, self._session, executor, self._executor = self._session, None, self._executor, None
            self._asked, self._new_map = [], None
        if session is not None:
            session.close()
        if executor is not None:
            executor.shutdown(wait=False, cancel_futures=True)

    def stop(self, timeout: float) -> bool:
        """End the thread; False when it is still inside a computation."""
        return self._worker.stop(timeout)

    def use_map(self, map_: PointCloud2 | PreparedMap, frame_id: str) -> None:
        """Follow the sensor in another map, from the next frame on."""
        with self._lock:
            self._new_map = map_, frame_id

    def ask(self, request: Callable[[Session], None]) -> bool:
        """Ask something of the session before the next frame; False where there is no map."""
        with self._lock:
            if self._session is None and self._new_map is None:
                return False
            self._asked.append(request)
            return True

    def submit(
        self, message: PointCloud2, config: Config, seed: int, odometry: Odometry, prior: Prior | None = None
    ) -> None:
        """Take a frame in place of one that still waits; ``prior`` is for the first one in a map."""
        came = time.monotonic()

        def work(_) -> Tracked | None:
            return self._track(message, config, seed, odometry, prior)

        def deliver(job: Job) -> None:
            self._deliver(job, came)

        with self._lock:
            before, self._last = self._last, self._worker.submit(work, deliver)
        if before is not None and isinstance(before.error, Cancelled):
            self._note_dropped()

    def _track(
        self, message: PointCloud2, config: Config, seed: int, odometry: Odometry, prior: Prior | None
    ) -> Tracked | None:
        self._take_map(config, seed, prior)
        with self._lock:
            session, asked, self._asked = self._session, self._asked, []
        if session is None:
            return None
        for request in asked:
            guarded(request, self._node)(session)
        cloud = seen(message)
        self._sensor_frame = cloud.frame_id
        moved = odometry(cloud.frame_id, cloud.stamp)
        pose = None if moved is None else moved.matrix
        estimate = session.add(cloud.points, cloud.stamp / 1e9, odometry=pose)
        return Tracked(estimate, cloud.frame_id, cloud.stamp, self._map_frame, moved)

    def _take_map(self, config: Config, seed: int, prior: Prior | None) -> None:
        with self._lock:
            news, self._new_map, old, executor = self._new_map, None, self._session, self._executor
        if news is None or executor is None:
            return
        prepared = news[0] if isinstance(news[0], PreparedMap) else prepare_map(decode(news[0]).points)
        if old is not None:
            old.close()
        session = Session(prepared, config, seed=seed, executor=executor)
        if prior is not None:
            session.relocalize(prior)
        with self._lock:
            self._session, self._map_frame = session, news[1]
        self._on_map(prepared, news[1])

    def _deliver(self, job: Job, came: float) -> None:
        tracked: Tracked | None = job.result
        if job.error is None and tracked is not None:
            guarded(self._publish, self._node)(tracked)
            self._done.append((time.monotonic(), time.monotonic() - came))
            self._note(tracked.estimate)
        elif job.error is not None:
            self._note_failure(job.error)
        else:  # there is no map yet
            self._note_dropped()

    def _note(self, estimate: Estimate) -> None:
        with self._lock:
            before = self._record.last
            self._record = replace(self._record, frames=self._record.frames + 1, last=estimate, complaint='')
        if before is None or before.state != estimate.state:
            self._node.get_logger().info(f'{estimate.state}: {estimate.reason}')

    def _note_dropped(self) -> None:
        with self._lock:
            self._record = replace(self._record, dropped=self._record.dropped + 1)

    def _note_failure(self, error: BaseException) -> None:
        text = str(error) if isinstance(error, CsgmError) else f'{type(error).__name__}: {error}'
        with self._lock:
            news = text != self._record.complaint
            self._record = replace(self._record, failed=self._record.failed + 1, complaint=text)
        if news:
            self._node.get_logger().error(f'frame left out: {text}')
