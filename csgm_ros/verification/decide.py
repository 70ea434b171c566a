"""Is a transform right at all: a verdict that fails closed.

A wrong transform that is given out as right costs a robot more than none. Three things can make a transform wrong
though it is the best one found: the clouds do not belong together, they overlap too little, or the scene allows
several transforms (a plane, a symmetry). All three show in how much better it fits than the best *different* one.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from csgm_ros.config import ScaleConfig, VerificationConfig
from csgm_ros.types import Term, Verdict
from csgm_ros.verification.evidence import Evidence


@dataclass(frozen=True)
class Thresholds:
    """What a transform has to reach on two clouds to be accepted.

    Attributes
    ----------
    min_fitness : float
        Smaller fitness of the two sides.
    min_margin : float
        Score over that of the best competing hypothesis.
    min_lead : float
        Score above that of the best competing hypothesis.
    chance : float
        Score of chance, the least that a competing hypothesis has.
    """

    min_fitness: float
    min_margin: float
    min_lead: float
    chance: float


def thresholds(
    config: VerificationConfig, attainable_fitness: float, fewest_samples: int, *, retried: bool
) -> Thresholds:
    """Return the thresholds for two clouds.

    Parameters
    ----------
    attainable_fitness : float
        What noise would leave two clouds of one surface.
    fewest_samples : int
        Points that were measured on the smaller side: a share counted on few points is known less well.
    retried : bool
        The transform was not found in the first attempt: many tries find more by chance.
    """
    doubt = np.sqrt(config.fine_samples / min(config.fine_samples, fewest_samples))
    return Thresholds(
        config.min_fitness * attainable_fitness,
        config.min_margin_retried if retried else config.min_margin,
        config.min_lead * doubt,
        config.chance,
    )


def competing(
    best: Evidence, measured: Iterable[Evidence], probe: np.ndarray, config: VerificationConfig
) -> list[Evidence]:
    """Return what competes with a transform: all *different* ones, and those so much better that it cannot be right.

    Parameters
    ----------
    best : Evidence
    measured : iterable of Evidence
        Everything measured so far.
    probe : (P, 3) ndarray
        Source points; transforms that move them alike are one.
    """
    better = config.min_margin * best.score
    return [
        other
        for other in measured
        if other.score > better or best.transform.displacement(other.transform, probe) > config.different
    ]


def decide(best: Evidence, competing: Iterable[Evidence], limits: Thresholds) -> Verdict:
    """Accept or reject a measured transform, given the evidence of all that competes with it."""
    strongest = max([limits.chance, *(other.score for other in competing)])
    margin, lead = best.score / strongest, best.score - strongest
    if best.fitness < limits.min_fitness:
        accepted, reason = (
            False,
            (
                f'too little overlap: only {best.fitness:.0%} of one cloud lies on the other '
                f'({limits.min_fitness:.0%} are asked for by verification.min_fitness, for clouds of this noise)'
            ),
        )
    elif margin < limits.min_margin or lead < limits.min_lead:
        accepted, reason = (
            False,
            (
                f'ambiguous: it fits only {margin:.2f} times as well as a different transform, or as chance does '
                '(unrelated clouds, a symmetric or a flat scene)'
            ),
        )
    else:
        accepted, reason = (
            True,
            (f'{best.fitness:.0%} of the smaller side fits, {margin:.2f} times as well as any different transform'),
        )
    terms = (
        Term('smaller fitness', best.fitness, limits.min_fitness, True, 'verification.min_fitness'),
        Term(
            'score over that of the best different transform',
            margin,
            limits.min_margin,
            True,
            'verification.min_margin',
        ),
        Term('score above that of the best different transform', lead, limits.min_lead, True, 'verification.min_lead'),
    )
    return Verdict(accepted, reason, best.fitness_source, best.fitness_target, best.rmse, margin, terms)


def within_bounds(verdict: Verdict, scale: float, bounds: ScaleConfig) -> Verdict:
    """Return the verdict; rejected, where refinement has left the bounds of the scale (target per source unit)."""
    low, high = bounds.bounds
    if not bounds.estimate_scale or low <= scale <= high:
        return verdict
    allowed = 'scale.scale_min..scale_max' if bounds.prior == 0.0 else 'the bounds of scale.prior'
    reason = f'scale {scale:.4g} is not in {allowed} ({low:g}..{high:g})'
    return replace(verdict, accepted=False, reason=reason)


def no_hypothesis() -> Verdict:
    """Return the verdict where no transform was proposed."""
    reason = 'no hypothesis: no three correspondences keep their mutual distances and angles in both clouds'
    return Verdict(False, reason, 0.0, 0.0, float('inf'), 0.0)
