"""The scale of the map while it is tracked in: found once, then believed better and better, never jumping."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

FIRST = 0.03  # sigma of a scale that was just found, relative
MEASURED = 0.03  # sigma of what one frame says, with what it has in common with the frames before
LEAST = 0.005  # sigma below which nothing is believed: the map is not quite a similarity of the scene
LARGEST_STEP = 0.003  # of the scale at a time
APART = 0.06  # logarithms of the scales that are compared
HELD = 0.05  # share of its score that the middle scale must lose on both sides together, for the scale to be seen


@dataclass(frozen=True)
class Scale:
    """Map units a metre.

    Attributes
    ----------
    value : float
        NaN while unknown.
    sigma : float
        Relative standard deviation, NaN while unknown.
    """

    value: float = np.nan
    sigma: float = np.nan

    @classmethod
    def found(cls, value: float) -> Scale:
        """Return a scale that a search has found."""
        return cls(value, FIRST)

    @property
    def known(self) -> bool:
        """Whether there is a value."""
        return bool(np.isfinite(self.value))

    @property
    def unconfirmed(self) -> bool:
        """Whether it was found and no frame has corrected it since."""
        return self.sigma >= FIRST

    def corrected(self, error: float, *, smoothly: bool = True) -> Scale:
        """Return the scale after a frame that says the logarithm is off by ``error``: a Kalman filter's step.

        A short one where it is to go ``smoothly``, as poses are given out.
        """
        gain = self.sigma**2 / (self.sigma**2 + MEASURED**2)
        most = LARGEST_STEP if smoothly else np.inf
        step = float(np.clip(gain * error, -most, most))
        return Scale(self.value * np.exp(step), max(self.sigma * np.sqrt(1.0 - gain), LEAST))


def vertex(scores: Sequence[float]) -> float | None:
    """Return where a parabola through the scores at logarithms ``-APART``, 0 and ``APART`` is highest.

    No further out than ``APART``; None where the scores say nothing of the scale, as of a single wall.
    """
    low, middle, high = scores
    bend = low - 2.0 * middle + high
    if -bend <= HELD * middle:  # also where nothing fits
        return None
    return float(np.clip(0.5 * (low - high) / bend, -1.0, 1.0)) * APART
