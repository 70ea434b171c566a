"""The scale of the map while it is tracked in: found once, then believed better and better, never jumping."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

FIRST, LOOK = 0.015, 0.01  # relative sigma of a scale that was just found, and of what one look says of it: measured
LEAST = 0.006  # sigma below which nothing is believed: the map is not quite a similarity of the scene
LEFT = 2.5  # sigmas that it may be off: steps to and fro would be worse
LARGEST_STEP = 0.002  # of the scale that is given out, from one frame to the next


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
    moving : bool
        Whether the one is on its way to the other.
    """

    value: float = np.nan
    sigma: float = np.nan
    ahead: float = 0.0
    moving: bool = False

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

    def told(self, value: float) -> Scale:
        """Return the scale after a look that found ``value``; what is given out stays."""
        before, now = self.sigma**-2.0, LOOK**-2.0
        ahead = self.ahead + now / (before + now) * (np.log(value / self.value) - self.ahead)
        sigma = max((before + now) ** -0.5, LEAST)
        return replace(self, sigma=sigma, ahead=ahead, moving=self.moving or abs(ahead) > LEFT * sigma)

    def followed(self) -> Scale:
        """Return the scale a frame later: one that was far off comes nearer to what is believed, until it is there."""
        if not self.moving:
            return self
        step = float(np.clip(self.ahead, -LARGEST_STEP, LARGEST_STEP))
        ahead = self.ahead - step
        return replace(self, value=self.value * np.exp(step), ahead=ahead, moving=ahead != 0.0)
