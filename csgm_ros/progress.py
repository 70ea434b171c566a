"""Progress, timings and the time budget of one registration."""

from __future__ import annotations

import time
from collections.abc import Callable

Progress = Callable[[str, float], None]
Look = Callable[[], None]  # asked between two steps; raises where there is no time left


def unhurried() -> None:
    """Look at no clock."""


STAGES = ('scale normalization', 'structure extraction', 'graph matching', 'transformation estimation')


class TimeUp(Exception):
    """The time budget is spent."""


class Clock:
    """Names the running stage to the caller, keeps the wall seconds of each stage, and knows when time is up."""

    def __init__(self, on_progress: Progress | None = None, time_budget: float = 0.0):
        self.timings: dict[str, float] = {}
        self._on_progress = on_progress
        self._stage, self._fraction, self._since = '', 0.0, time.perf_counter()
        self._low, self._high = 0.0, 0.0
        self._deadline = self._since + time_budget if time_budget > 0.0 else float('inf')

    def begin(self, attempt: int) -> None:
        """Give the next attempt half of what is left of the progress: how many will follow is not known."""
        self._low, self._high = 1.0 - 0.5**attempt, 1.0 - 0.5 ** (attempt + 1)

    def enter(self, stage: str) -> None:
        """End the running stage and begin another of :data:`STAGES`."""
        self._end()
        self._stage = stage
        self._fraction = self._low + (self._high - self._low) * STAGES.index(stage) / len(STAGES)
        self.report()

    def report(self) -> None:
        """Tell the caller that work goes on; whatever its callback raises ends the registration."""
        if self._on_progress:
            self._on_progress(self._stage, self._fraction)

    def check(self) -> None:
        """Tell the caller that work goes on, and raise :class:`TimeUp` once the time budget is spent."""
        self.report()
        if self.expired:
            raise TimeUp

    @property
    def expired(self) -> bool:
        """True once the time budget is spent."""
        return time.perf_counter() >= self._deadline

    def finish(self) -> None:
        """End the last stage and report that all is done."""
        self._end()
        self._stage, self._fraction = 'done', 1.0
        self.report()

    def _end(self) -> None:
        now = time.perf_counter()
        if self._stage:
            self.timings[self._stage] = self.timings.get(self._stage, 0.0) + now - self._since
        self._since = now
