"""Is a transform right at all: exact measures on finely sampled clouds, and a verdict that fails closed.

A wrong transform that is given out as right costs a robot more than none. Three things can make a transform wrong
though it is the best one found: the clouds do not belong together, they overlap too little, or the scene allows
several transforms (a plane, a symmetry). All three show in how much better it fits than the best *different* one.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from csgm_ros.cloud import nearest_grid
from csgm_ros.config import Config
from csgm_ros.transform import batch_icp, icp
from csgm_ros.transform.similarity import cosine, displacement
from csgm_ros.types import Similarity, Verdict
from csgm_ros.verification import fitness
from csgm_ros.verification.fitness import Fit, Surface, normal_angle, surface

CELL, REACH = 0.015, 0.045  # of the look-up table for the fine clouds, in radii
GATES = (0.03, 0.015)  # of the ICP on the fine clouds


class Judge:
    """Measures transforms between two clouds and passes the verdict on the best.

    Parameters
    ----------
    clouds : pair of (N, 3) ndarray
        Source and target, in their own units.
    normalizations : pair of Similarity
        Own unit to the frame the transforms are in.
    config : Config
    rng : numpy.random.Generator
        Draws the points that are measured.
    smoothed : bool, optional
        The clouds have been smoothed, so this is not the first look at them: ask for a wider margin.
    """

    def __init__(
        self,
        clouds: tuple[np.ndarray, np.ndarray],
        normalizations: tuple[Similarity, Similarity],
        config: Config,
        rng: np.random.Generator,
        *,
        smoothed: bool = False,
    ):
        self._clouds, self._normalizations = clouds, normalizations
        self._config, self._rng, self._smoothed = config, rng, smoothed
        self._measured: list[tuple[Similarity, Fit]] = []
        self._first_looks = 0 if smoothed else None  # how many were measured in the first look; None: it goes on

    def look_again(self) -> None:
        """End the first look: what is found from here on needs a wider margin."""
        if self._first_looks is None:
            self._first_looks = len(self._measured)

    @cached_property
    def _sides(self) -> tuple[Surface, ...]:
        pairs = zip(self._clouds, self._normalizations, strict=True)
        return tuple(surface(cloud, unit, self._config, self._rng) for cloud, unit in pairs)

    @cached_property
    def _grids(self) -> tuple[nearest_grid.NearestGrid, ...]:
        return tuple(nearest_grid.build(side.points, side.normals, CELL, REACH) for side in self._sides)

    @cached_property
    def _max_angle(self) -> float:
        # smoothing makes the normals of neighbours agree more than they can with the other cloud's
        return (
            self._config.verification.max_normal_angle if self._smoothed else normal_angle(*self._sides, self._config)
        )

    def consider(self, finalists: np.ndarray) -> tuple[Similarity, Verdict]:
        """Refine and measure (F, 4, 4) transforms, and judge the best of all considered so far."""
        scaled = self._config.scale.estimate_scale
        if len(finalists):
            samples = tuple(side.sample for side in self._sides)
            agree = cosine(self._config.verification.max_normal_angle)
            finalists = batch_icp.refine_all(finalists, *self._grids, samples, GATES, agree, estimate_scale=scaled)
        self._measured += [(found, self.fit(found)) for found in map(Similarity.from_matrix, finalists)]
        if not self._measured:
            reason = 'no hypothesis: no three matches keep their mutual distances and angles in both clouds'
            return Similarity.identity(), Verdict(False, reason, 0.0, 0.0, float('inf'), 0.0)
        best, fit = max(self._measured, key=lambda pair: pair[1].closeness)
        polished = self.polish(best, scaled)
        again = self.fit(polished)
        if again.closeness > fit.closeness:  # ICP can also make things worse
            best, fit = polished, again
        return best, self.verdict(best, fit)

    def polish(self, start: Similarity, estimate_scale: bool) -> Similarity:
        """Return the transform after the final ICP of the paper."""
        part = self._config.icp
        return icp.refine(
            self._probe,
            self._sides[1].points,
            start,
            part.gates,
            iterations=part.iterations,
            estimate_scale=estimate_scale,
        )

    def fit(self, transform: Similarity) -> Fit:
        """Measure one transform."""
        gate = self._config.verification.inlier_distance
        return fitness.fit(transform, *self._sides, gate, self._max_angle)

    def verdict(self, transform: Similarity, fit: Fit) -> Verdict:
        """Accept or reject a measured transform.

        Its rivals are all *different* ones considered so far, and those so much better that it cannot be right.
        """
        part = self._config.verification
        better = part.min_margin * fit.closeness
        rivals = [
            other.closeness
            for rival, other in self._measured
            if other.closeness > better or self._differ(transform, rival)
        ]
        rival = max([part.chance, *rivals])
        min_fitness = part.min_fitness * fitness.attainable(*self._sides, self._max_angle)
        min_margin = part.min_margin if self._seen_first(transform) else part.min_margin_again
        # a share counted on fewer points is known less well, with their root
        fewest = min(len(side.sample) for side in self._sides)
        doubt = np.sqrt(part.fine_samples / min(part.fine_samples, fewest))
        accepted, reason = _decide(fit, rival, min_fitness, min_margin, part.min_lead * doubt)
        scales, bounds = [unit.scale for unit in self._normalizations], self._config.scale
        own = transform.scale * scales[0] / scales[1]
        if bounds.estimate_scale and not bounds.scale_min <= own <= bounds.scale_max:  # refinement can leave them
            accepted = False
            reason = (
                f'scale {own:.4g} is not in scale.scale_min..scale_max ({bounds.scale_min:g}..{bounds.scale_max:g})'
            )
        rmse = float(fit.rmse / scales[1])
        return Verdict(accepted, reason, fit.fitness_source, fit.fitness_target, rmse, fit.closeness / rival)

    def _seen_first(self, transform: Similarity) -> bool:
        if self._first_looks is None:
            return True
        return any(not self._differ(transform, seen) for seen, _ in self._measured[: self._first_looks])

    def _differ(self, first: Similarity, second: Similarity) -> bool:
        return displacement(first, second, self._probe) > self._config.verification.different

    @property
    def _probe(self) -> np.ndarray:
        return self._sides[0].points[self._sides[0].sample]


def _decide(fit: Fit, rival: float, min_fitness: float, min_margin: float, min_lead: float) -> tuple[bool, str]:
    smaller = min(fit.fitness_source, fit.fitness_target)
    margin, lead = fit.closeness / rival, fit.closeness - rival
    if smaller < min_fitness:
        return False, (
            f'too little overlap: only {smaller:.0%} of one cloud lies on the other '
            f'({min_fitness:.0%} are asked for by verification.min_fitness, for clouds of this noise)'
        )
    if margin < min_margin or lead < min_lead:
        return False, (
            f'ambiguous: it fits only {margin:.2f} times as well as a different transform, or as chance does '
            '(unrelated clouds, a symmetric or a flat scene)'
        )
    return True, f'{smaller:.0%} of the smaller side fits, {margin:.2f} times as well as any different transform'
