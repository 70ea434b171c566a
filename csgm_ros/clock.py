"""Progress, timings and the time budget of one registration."""

from __future__ import annotations

import time
from collections.abc import Callable

Progress = Callable[[str, float], None]


class Clock:
    """Names the running stage to the caller, keeps the wall seconds of each stage, and knows when time is up."""

    def __init__(self, on_progress: Progress | None = None, time_budget: float = 0.0):
        self.timings: dict[str, float] = {}
        self._on_progress = on_progress
        self._stage, self._fraction, self._since = '', 0.0, time.perf_counter()
        self._deadline = self._since + time_budget if time_budget > 0.0 else float('inf')

    def enter(self, stage: str, fraction: float) -> None:
        """End the running stage and begin another, ``fraction`` of the whole being done."""
        now = time.perf_counter()
        if self._stage:
            self.timings[self._stage] = self.timings.get(self._stage, 0.0) + now - self._since
        self._stage, self._since = stage, now
        self.tick(fraction)

    def tick(self, fraction: float | None = None) -> bool:
        """Report that work goes on (this is where the caller can cancel); False once the time budget is spent."""
        self._fraction = self._fraction if fraction is None else fraction
        if self._on_progress:
            self._on_progress(self._stage, self._fraction)
        return time.perf_counter() < self._deadline
