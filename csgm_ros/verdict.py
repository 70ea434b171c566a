"""Is a transform right at all: exact measures on finely sampled clouds, and a verdict that fails closed.

A wrong transform that is given out as right costs a robot more than none. Three things can make a transform wrong
though it is the best one found: the clouds do not belong together, they overlap too little, or the scene allows
several transforms (a plane, a symmetry). All three show in how much better it fits than the best *different* one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from csgm_ros import icp, nearest, refinement
from csgm_ros.config import Config
from csgm_ros.preprocess import prepare
from csgm_ros.similarity import displacement
from csgm_ros.types import Similarity, Verdict

CELL, REACH = 0.015, 0.045  # of the look-up table for the fine clouds, in radii
GATES = (0.03, 0.015)  # of the ICP on the fine clouds


@dataclass(frozen=True)
class Fit:
    """How two clouds lie on each other under one transform, with exact nearest points.

    Attributes
    ----------
    fitness_source, fitness_target : float
        Share of either side within the inlier distance of the other, normals agreeing.
    closeness : float
        The smaller side's mean closeness: 1 at distance 0, 0 at the inlier distance.
    rmse : float
        RMS distance of the inliers of both sides.
    """

    fitness_source: float
    fitness_target: float
    closeness: float
    rmse: float


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
    again : bool, optional
        Not the first look at these clouds: ask for a wider margin.
    """

    def __init__(
        self,
        clouds: tuple[np.ndarray, np.ndarray],
        normalizations: tuple[Similarity, Similarity],
        config: Config,
        rng: np.random.Generator,
        *,
        again: bool = False,
    ):
        part = config.verification
        self._min_margin = part.min_margin_again if again else part.min_margin
        self._config, self._target_radius = config, 1.0 / normalizations[1].scale
        self._own_unit = normalizations[0].scale / normalizations[1].scale
        self._source, self._target = self._sides = tuple(
            prepare(points, unit, part.fine_voxel_size, config.preprocess.normal_neighbors)
            for points, unit in zip(clouds, normalizations, strict=True)
        )
        self._trees = tuple(cKDTree(side.points) for side in self._sides)
        self._samples = tuple(rng.permutation(len(side.points))[: part.fine_samples] for side in self._sides)
        self._min_cosine = float(np.cos(np.radians(part.max_normal_angle)))
        self._measured: list[tuple[Similarity, Fit]] = []

    @cached_property
    def _grids(self) -> tuple[nearest.NearestGrid, ...]:
        return tuple(nearest.build(side.points, side.normals, CELL, REACH) for side in self._sides)

    def consider(self, finalists: np.ndarray) -> tuple[Similarity, Verdict]:
        """Refine and measure (F, 4, 4) transforms, and judge the best of all considered so far."""
        scaled = self._config.scale.estimate_scale
        if len(finalists):
            finalists = refinement.refine_all(
                finalists, *self._grids, self._samples, GATES, self._min_cosine, estimate_scale=scaled
            )
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
        source = self._source.points[self._samples[0]]
        return icp.refine(
            source, self._target.points, start, part.gates, iterations=part.iterations, estimate_scale=estimate_scale
        )

    def fit(self, transform: Similarity) -> Fit:
        """Measure one transform."""
        gate = self._config.verification.inlier_distance
        forth = self._distances(transform, 0)
        back = self._distances(transform.inverse(), 1) * transform.scale
        inliers = np.concatenate([side[side < gate] for side in (forth, back)])
        return Fit(
            float((forth < gate).mean()),
            float((back < gate).mean()),
            float(min(np.clip(1.0 - side / gate, 0.0, None).mean() for side in (forth, back))),
            float(np.sqrt((inliers**2).mean())) if len(inliers) else float('inf'),
        )

    def _distances(self, transform: Similarity, moving: int) -> np.ndarray:
        # from the moved sample of one side to the other, infinite where the normals disagree
        side, other, sample = self._sides[moving], self._sides[1 - moving], self._samples[moving]
        distance, near = self._trees[1 - moving].query(transform.apply(side.points[sample]))
        cosine = np.abs(((side.normals[sample] @ transform.rotation.T) * other.normals[near]).sum(1))
        return np.where(cosine >= self._min_cosine, distance, np.inf)

    def verdict(self, transform: Similarity, fit: Fit) -> Verdict:
        """Accept or reject a measured transform; every *different* one considered so far is its rival."""
        part = self._config.verification
        rivals = [other.closeness for rival, other in self._measured if self._differ(transform, rival)]
        rival = max([part.chance, *rivals])
        # a share counted on fewer points is known less well, with their root
        doubt = np.sqrt(part.fine_samples / min(part.fine_samples, *map(len, self._samples)))
        accepted, reason = _decide(fit, rival, part.min_fitness, self._min_margin, part.min_lead * doubt)
        own, bounds = transform.scale * self._own_unit, self._config.scale
        if bounds.estimate_scale and not bounds.scale_min <= own <= bounds.scale_max:  # refinement can leave them
            accepted = False
            reason = (
                f'scale {own:.4g} is not in scale.scale_min..scale_max ({bounds.scale_min:g}..{bounds.scale_max:g})'
            )
        rmse = fit.rmse * self._target_radius
        return Verdict(accepted, reason, fit.fitness_source, fit.fitness_target, rmse, fit.closeness / rival)

    def _differ(self, first: Similarity, second: Similarity) -> bool:
        points = self._source.points[self._samples[0]]
        return displacement(first, second, points) > self._config.verification.different


def _decide(fit: Fit, rival: float, min_fitness: float, min_margin: float, min_lead: float) -> tuple[bool, str]:
    smaller = min(fit.fitness_source, fit.fitness_target)
    margin, lead = fit.closeness / rival, fit.closeness - rival
    if smaller < min_fitness:
        return False, (
            f'too little overlap: only {smaller:.0%} of one cloud lies on the other '
            f'(verification.min_fitness asks for {min_fitness:.0%})'
        )
    if margin < min_margin or lead < min_lead:
        return False, (
            f'ambiguous: it fits only {margin:.2f} times as well as a different transform, or as chance does '
            '(unrelated clouds, a symmetric or a flat scene)'
        )
    return True, f'{smaller:.0%} of the smaller side fits, {margin:.2f} times as well as any different transform'
