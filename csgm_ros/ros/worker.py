"""One thread that does one job at a time; a newer job replaces the one that waits."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from csgm_ros.errors import Cancelled
from csgm_ros.ros.memory import give_back


class Job:
    """One piece of work and, once ``done`` is set, its ``result`` or its ``error``.

    Its worker owns it and changes it under its lock alone; everybody else reads.

    Attributes
    ----------
    stage, fraction : str, float
        Last progress that the work reported.
    started : float or None
        ``time.monotonic()`` of the start.
    """

    def __init__(self, work: Callable[[Callable], Any], deliver: Callable[[Job], None]):
        self.work, self.deliver = work, deliver
        self.done = threading.Event()
        self.result: Any = None
        self.error: BaseException | None = None
        self.committed = False  # the outcome stands, a cancellation comes too late
        self.stage, self.fraction = 'waiting', 0.0
        self.started: float | None = None

    @property
    def seconds(self) -> float:
        """Seconds since it started."""
        return 0.0 if self.started is None else time.monotonic() - self.started

    @property
    def seconds_left(self) -> float:
        """Seconds that it will take if it goes on as it did; infinite while nothing is done."""
        return self.seconds * (1.0 - self.fraction) / self.fraction if self.fraction > 0.0 else float('inf')

    def progress(self, stage: str, fraction: float) -> None:
        """Note the progress; raise :class:`Cancelled` where the job was cancelled."""
        if self.error is not None:
            raise self.error
        self.stage, self.fraction = stage, fraction


class Worker:
    """Run submitted jobs in one daemon thread, which forgets each of them when it is done.

    ``deliver`` of a job is called in that thread, and only for a job that was not cancelled before its work
    returned; who waits for ``done`` is woken after it. It owns the jobs, and whether new ones are taken; both
    change under its condition alone.
    """

    def __init__(self):
        self._condition = threading.Condition()
        self._running: Job | None = None
        self._queued: Job | None = None
        self._closed = ''  # why no job is taken; empty when they are
        self._stopped = False
        self._thread = threading.Thread(target=self._loop, name='csgm_worker', daemon=True)
        self._thread.start()

    @property
    def current(self) -> Job | None:
        """The job that runs or waits, None when a new one would start at once."""
        with self._condition:
            return self._current()

    def _current(self) -> Job | None:
        for job in (self._running, self._queued):
            if job is not None and not job.done.is_set():
                return job
        return None

    def submit(self, work: Callable[[Callable], Any], deliver: Callable[[Job], None]) -> Job:
        """Queue a job in place of one that still waits; that one ends as cancelled."""
        with self._condition:
            return self._submit(Job(work, deliver))

    def submit_if_idle(self, work: Callable[[Callable], Any], deliver: Callable[[Job], None]) -> tuple[Job, bool]:
        """Queue a job and return it with True; with a job in its way, return that one with False."""
        with self._condition:
            busy = self._current()
            return (busy, False) if busy is not None else (self._submit(Job(work, deliver)), True)

    def _submit(self, job: Job) -> Job:
        if self._closed:
            self._end(job, Cancelled(self._closed))
            return job
        if self._queued is not None:
            self._end(self._queued, Cancelled('replaced by a newer pair of clouds'))
        self._queued = job
        self._condition.notify()
        return job

    def open(self) -> None:
        """Take jobs again, unless stopped."""
        with self._condition:
            if not self._stopped:
                self._closed = ''

    def close(self, reason: str) -> bool:
        """Cancel what runs and waits, and end every later job with the same reason until :meth:`open`."""
        with self._condition:
            self._closed = reason
            return self._cancel(reason)

    def cancel(self, reason: str) -> bool:
        """End the running and the waiting job at once; False when there was none.

        The running work itself stops at its next progress call. A job submitted meanwhile waits for that.
        """
        with self._condition:
            return self._cancel(reason)

    def _cancel(self, reason: str) -> bool:
        jobs = [job for job in (self._running, self._queued) if job is not None and not job.committed]
        for job in jobs:
            self._end(job, Cancelled(reason))
        self._queued = None
        return bool(jobs)

    def stop(self, timeout: float) -> bool:
        """Cancel everything and end the thread; True when it ended within ``timeout`` seconds."""
        with self._condition:
            self._closed, self._stopped = 'the node stops', True
            self._cancel(self._closed)
            self._condition.notify()
        self._thread.join(timeout)
        return not self._thread.is_alive()

    @staticmethod
    def _end(job: Job, error: BaseException) -> None:
        job.error, job.committed = error, True
        job.done.set()

    def _loop(self) -> None:
        while self._run_next():
            give_back()

    def _run_next(self) -> bool:
        """Do the next job; a frame of its own, so that nothing of a job outlives it here."""
        job = self._next()
        if job is None:
            return False
        result, error = None, None
        try:
            result = job.work(job.progress)
        except BaseException as raised:  # whoever waits for the job is told; the thread lives on
            error = raised
        with self._condition:
            fresh = not job.committed
            if fresh:
                job.result, job.error, job.committed = result, error, True
        try:
            if fresh:
                job.deliver(job)
        except Exception as raised:
            job.error = raised
        for each in (job.error, error):
            if each is not None:  # its frames hold the clouds
                each.__traceback__ = each.__context__ = each.__cause__ = None
        job.work = job.deliver = None  # type: ignore[assignment]  # asked for no more
        with self._condition:
            self._running = None
        job.done.set()
        return True

    def _next(self) -> Job | None:
        with self._condition:
            self._condition.wait_for(lambda: self._queued is not None or self._stopped)
            if self._stopped or self._queued is None:
                return None
            self._running, self._queued = self._queued, None
            self._running.started = time.monotonic()
            return self._running
