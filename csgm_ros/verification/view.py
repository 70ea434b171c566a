"""Two clouds as verification sees them, and all that was measured on them."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from csgm_ros.config import Config
from csgm_ros.types import NormalizedPair, Similarity, Surface, Verdict
from csgm_ros.verification.decide import competing, decide, thresholds, within_bounds
from csgm_ros.verification.evidence import Evidence, measure
from csgm_ros.verification.surfaces import attainable_fitness, normal_angle, surface


class View:
    """The pair at one smoothing, and all that was measured on it so far; belongs to one registration.

    Attributes
    ----------
    pair : NormalizedPair
    measured : list of Evidence
        What the verdict compares a transform with, over all attempts.
    """

    def __init__(self, pair: NormalizedPair, config: Config, rng: np.random.Generator, *, retried: bool):
        self.pair, self.measured = pair, []
        self._config, self._rng = config, rng
        # how many were measured in the first attempt; None: it goes on
        self._first: int | None = 0 if retried else None

    @cached_property
    def surfaces(self) -> tuple[Surface, Surface]:
        """Source and target, finely sampled."""
        sides = zip(self.pair.clouds, self.pair.normalizations, strict=True)
        return tuple(surface(cloud, unit, self._config, self._rng) for cloud, unit in sides)

    @cached_property
    def max_angle(self) -> float:
        """Degrees that the normals of two points in one place may differ by."""
        if self._first == 0:
            # smoothing makes the normals of neighbours agree more than they can with the other cloud's
            return self._config.verification.max_normal_angle
        return normal_angle(*self.surfaces, self._config)

    def end_attempt(self) -> None:
        """What is found from here on was not found in the first attempt and needs a wider margin."""
        if self._first is None:
            self._first = len(self.measured)

    def measure(self, transform: Similarity) -> Evidence:
        """Return the evidence for one transform between the normalised clouds."""
        return measure(transform, *self.surfaces, self._config.verification.inlier_distance, self.max_angle)

    def judge(self, best: Evidence) -> Verdict:
        """Return the verdict on a transform, all that was measured before competing with it."""
        part, probe = self._config.verification, self.surfaces[0].probe
        first = self.measured[: self._first]
        retried = all(best.transform.displacement(seen.transform, probe) > part.different for seen in first)
        fewest = min(len(side.sample) for side in self.surfaces)
        attainable = attainable_fitness(*self.surfaces, self.max_angle)
        limits = thresholds(part, attainable, fewest, retried=retried and self._first is not None)
        verdict = decide(best, competing(best, self.measured, probe, part), limits)
        verdict = within_bounds(verdict, self.pair.in_own_units(best.transform).scale, self._config.scale)
        return replace(verdict, inlier_rmse=verdict.inlier_rmse / self.pair.normalizations[1].scale)
