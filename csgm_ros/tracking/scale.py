"""The scale of the map while it is tracked in: found once, then believed better and better, never jumping."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

FIRST, LOOK = 0.02, 0.015  # sigma of a scale that was just found, and of what one look says of it, relative
HELD = 0.01  # share of the best score that the outermost scales must lose, for the scale to be seen
LEAST = 0.004  # sigma below which nothing is believed: the map is not quite a similarity of the scene
LARGEST_STEP = 0.005  # of the scale that is given out, at a time
LEFT = 1.5  # sigmas that it may be off: steps to and fro would be worse
STEPS = 0.04 * np.arange(-2, 3)  # logarithms of the scales that are compared


@dataclass(frozen=True)
class Scale:
    """Map units a metre.

    Attributes
    ----------
    value : float
        What is given out, NaN while unknown.
    sigma : float
        Relative standard deviation, NaN while unknown.
    ahead : float
        By how much what is believed lies ahead of what is given out, in its logarithm.
    """

    value: float = np.nan
    sigma: float = np.nan
    ahead: float = 0.0

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
        """Whether it was found and no look has told of it since."""
        return self.sigma >= FIRST

    def corrected(self, scores: np.ndarray, *, smoothly: bool = True) -> Scale:
        """Return the scale after a look that scored ``value`` times the exponentials of :data:`STEPS`, (5,).

        Looks that say nothing, as those on a single wall, change nothing of what is believed. Where poses are given out
        the value follows ``smoothly``, in short steps and only where it is off by more than :data:`LEFT` sigma, and
        loses nothing of what is believed.
        """
        error, ahead, sigma = vertex(STEPS, scores), self.ahead, self.sigma
        if error is not None:
            before, told = sigma**-2.0, LOOK**-2.0
            ahead += told / (before + told) * (error - ahead)
            sigma = max((before + told) ** -0.5, LEAST)
        step = ahead
        if smoothly:
            step = float(np.clip(ahead, -LARGEST_STEP, LARGEST_STEP)) if abs(ahead) > LEFT * sigma else 0.0
        return Scale(self.value * np.exp(step), sigma, ahead - step)


def vertex(steps: np.ndarray, scores: np.ndarray) -> float | None:
    """Return where a parabola through (S,) scores at (S,) logarithms, even about 0, is highest, within them.

    None where the scores say nothing of the scale, as of a single wall.
    """
    bend, slope, _ = np.polyfit(steps, scores, 2)
    if -bend * steps[-1] ** 2 <= HELD * np.max(scores):  # also where nothing fits
        return None
    return float(np.clip(-0.5 * slope / bend, steps[0], steps[-1]))
