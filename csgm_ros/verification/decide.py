"""Is a transform right at all: a verdict that fails closed.

A wrong transform that is given out as right costs a robot more than none. What can make the best transform wrong that
was found: the clouds do not belong together, they overlap too little, or the scene allows several transforms (a
corridor, a symmetry, a scene without a length of its own). Each shows in what was found out about it, and each has its
words.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from csgm_ros.config import ScaleConfig, VerificationConfig
from csgm_ros.types import Term, Undetermined, Verdict
from csgm_ros.verification.evidence import Evidence
from csgm_ros.verification.findings import OTHER_SCALE, Findings, Rival

SAME_AXIS = 0.95  # cosine from which two directions are one
MIN_INLIERS = 20
LOGISTIC = (-2.9, 1.4)  # bias, and slope over the margin in its own uncertainty; other terms added nothing
LACKING, CONTRADICTED, AMBIGUOUS = 0.02, 0.1, 0.5  # most confidence in what is rejected, by why
CLEAR = 20.0  # logarithm of the margin, in its own uncertainty, from which what fits mirrored too is no chance
SAYS_MORE = 1.15  # times as well a turn must fit as a slide, to be told of first: one wall slides, and is turned by 180
NOTHING = 0.05  # the least score, relative to the winner's, that something different has
NEARBY = 6.0  # cells of displacement up to which a transform is the same but for bent clouds and noise ...
NEARBY_MARGIN = 1.15  # ... and need not be so much worse


@dataclass(frozen=True)
class Units:
    """What turns findings into words: lengths in the target's own unit, scales in target units per source unit.

    Attributes
    ----------
    length : float
        Own units per unit of the findings.
    scale : float
        Of the winner.
    """

    length: float = 1.0
    scale: float = 1.0


def margin(findings: Findings) -> float:
    """Return the winner's score over that of the best different transform."""
    return 1.0 / max([NOTHING, *(rival.ratio for rival in findings.rivals if rival.displacement > NEARBY)])


def needed_margin(findings: Findings, limits: VerificationConfig) -> float:
    """Return the margin that is asked for: the wider, the fewer independent surfaces agree.

    The logarithm of a score that n of them make up is uncertain by about the square root of 1/n.
    """
    return float(max(limits.min_margin, np.exp(limits.min_significance * _deviation(findings))))


def most_mirrored(findings: Findings, limits: VerificationConfig) -> float:
    """Return how well the mirrored source may fit: a mirror image is never right, so that is what chance makes fit.

    What has an answer fits better than that, by more than its score is uncertain by. Chance would make something else
    fit as it does mirrored: where nothing does by far, the object is its own mirror image, as animals are.
    """
    deviation = _deviation(findings)
    symmetric = np.log(margin(findings)) >= CLEAR * deviation
    return limits.max_mirrored * (1.0 if symmetric else float(np.exp(-deviation)))


def _deviation(findings: Findings) -> float:
    return 1.0 / np.sqrt(max(findings.agreement.planes, 1.0))


def decide(
    evidence: Evidence, findings: Findings, limits: VerificationConfig, units: Units, *, estimate_scale: bool
) -> Verdict:
    """Accept or reject a transform, given what was found out about it."""
    doubts = list(_doubts(findings, limits, units, estimate_scale=estimate_scale))
    sure = confidence(findings)
    planes = findings.agreement.planes
    reason = (
        doubts[0]
        if doubts
        else f'{planes:.0f} independent surfaces agree, {margin(findings):.1f} times as well as under any different '
        'transform'
    )
    return Verdict(
        not doubts,
        reason,
        evidence.fitness_source,
        evidence.fitness_target,
        evidence.rmse,
        margin(findings),
        _terms(findings, limits),
        sure if not doubts else min(sure, _most_confidence(findings, limits)),
        undetermined(findings, limits, units) if doubts else None,
    )


def _lacking(findings: Findings, limits: VerificationConfig) -> bool:
    return findings.agreement.inliers < MIN_INLIERS or findings.agreement.planes < limits.min_planes


def _most_confidence(findings: Findings, limits: VerificationConfig) -> float:
    """Return the most confidence in a rejected transform: the margin says nothing where there is little to compare."""
    if _lacking(findings, limits):
        return LACKING
    near = any(rival.displacement <= NEARBY and rival.ratio > 1.0 for rival in findings.rivals)
    measured = (
        (findings.seen_through, limits.max_seen_through),
        (findings.mirrored, most_mirrored(findings, limits)),
        (findings.half_shift, limits.max_half_shift),
        (_other_scale_ratio(findings), limits.max_scale_ratio),
    )
    return CONTRADICTED if near or any(value > limit for value, limit in measured) else AMBIGUOUS


def _terms(findings: Findings, limits: VerificationConfig) -> tuple[Term, ...]:
    """Return what was measured beside its limits; what was not is left out: it is probed only before acceptance."""
    probed, seen = bool(findings.scale_curve), findings.seen_through > 0.0
    planes, coverage = findings.agreement.planes, findings.agreement.coverage
    lead, needed = margin(findings), needed_margin(findings, limits)
    most = vars(limits) | {'max_mirrored': most_mirrored(findings, limits)}
    return (
        Term('independent surfaces that agree', planes, limits.min_planes, True, 'verification.min_planes'),
        Term('share of all surfaces that agree', coverage, limits.min_coverage, True, 'verification.min_coverage'),
        Term('score over that of the best different one', lead, needed, True, 'verification.min_margin'),
        *(
            Term(name, value, most[parameter], False, f'verification.{parameter}')
            for name, value, parameter, measured in (
                ('score at another scale', _other_scale_ratio(findings), 'max_scale_ratio', probed),
                ('score of the mirrored source', findings.mirrored, 'max_mirrored', probed),
                ('cells between refinements on halves', findings.half_shift, 'max_half_shift', probed),
                ('share that a sensor has looked through', findings.seen_through, 'max_seen_through', seen),
            )
            if measured
        ),
    )


def _doubts(findings: Findings, limits: VerificationConfig, units: Units, *, estimate_scale: bool) -> Iterator[str]:
    """Yield what speaks against a transform, in words a user can act on."""
    agreement = findings.agreement
    if agreement.inliers < MIN_INLIERS:
        yield f'too little overlap: only {agreement.inliers} points lie on the other cloud, {MIN_INLIERS} are needed'
    elif agreement.planes < limits.min_planes:
        yield (
            f'too little overlap or structure: {agreement.planes:.1f} independent surfaces agree, '
            f'{limits.min_planes:g} are asked for by verification.min_planes'
        )
    elif agreement.coverage < limits.min_coverage:  # so little was never right on the test bed and else believed
        yield (
            f'too little overlap: {agreement.coverage:.1%} of the surfaces of the smaller cloud agree, '
            f'{limits.min_coverage:.1%} are asked for by verification.min_coverage'
        )
    if findings.seen_through > limits.max_seen_through:
        yield (
            f'contradicted: a sensor has looked through {findings.seen_through:.0%} of the other cloud '
            f'(verification.max_seen_through is {limits.max_seen_through:.0%})'
        )
    open_ = _competing(findings, limits)
    if open_:
        yield f'ambiguous: {_words(open_[0], units)}'
    elif margin(findings) < (needed := needed_margin(findings, limits)):
        yield f'ambiguous: a margin of {needed:.3g} is asked for by verification.min_margin, none is that wide'
    if findings.mirrored > most_mirrored(findings, limits):
        yield (
            f'ambiguous: the source fits {findings.mirrored:.2f} times as well mirrored: '
            + (
                'is it a mirror image?'
                if findings.mirrored > limits.max_mirrored
                else 'a fit by chance, or a symmetric scene'
            )
        )
    ratio = _other_scale_ratio(findings)
    if ratio > limits.max_scale_ratio:
        low, high = scale_range(findings, limits)
        if estimate_scale:
            yield f'ambiguous: scale not determined, between {low * units.scale:.3g} and {high * units.scale:.3g}'
        else:
            yield f'ambiguous: it fits {ratio:.2f} times as well {low:.2g} to {high:.2g} times as large'
    elif estimate_scale and findings.scale_curve:
        factor, ratio = max(findings.scale_curve, key=lambda point: point[1])
        if ratio > NEARBY_MARGIN:
            yield f'not settled: it fits {ratio:.2f} times as well {factor:.2f} times as large'
    if findings.half_shift > limits.max_half_shift:
        yield (
            'ambiguous: the halves of the overlap put it in different places '
            f'({findings.half_shift:.2f} cells apart; verification.max_half_shift is {limits.max_half_shift:g})'
        )


def _competing(findings: Findings, limits: VerificationConfig) -> list[Rival]:
    """Return the rivals that fit so well that they leave a doubt, what fits best first; slides, for they say more."""
    needed = needed_margin(findings, limits)
    return sorted(
        (
            rival
            for rival in findings.rivals
            if rival.ratio * (needed if rival.displacement > NEARBY else NEARBY_MARGIN) > 1.0
        ),
        key=lambda rival: -rival.ratio * (SAYS_MORE if rival.motion and rival.motion.kind == 'slide' else 1.0),
    )


def _words(rival: Rival, units: Units) -> str:
    well = f'{rival.ratio:.2f} times as well'
    if rival.motion is None:
        return f'a different transform fits {well} (unrelated clouds, little overlap, a symmetric or a flat scene)'
    axis = ', '.join(f'{value:.2f}' for value in rival.motion.axis.round(2) + 0.0)
    if rival.motion.kind == 'slide':
        return f'slides along ({axis}) by {rival.motion.amount * units.length:.3g}: it fits {well} there'
    return f'fits {well} turned by {rival.motion.amount:.0f} degrees about ({axis})'


def scale_range(findings: Findings, limits: VerificationConfig) -> tuple[float, float]:
    """Return the factors on the scale between which the winner fits as well."""
    open_ = [factor for factor, ratio in findings.scale_curve if ratio > limits.max_scale_ratio]
    return min([1.0, *open_]), max([1.0, *open_])


def undetermined(findings: Findings, limits: VerificationConfig, units: Units) -> Undetermined | None:
    """Return the one direction in which different transforms fit as well, None where there are several or none.

    None too where something says that the transform is wrong altogether.
    """
    if (
        findings.agreement.planes < limits.min_planes
        or findings.seen_through > limits.max_seen_through
        or findings.mirrored > most_mirrored(findings, limits)
    ):
        return None
    open_ = _competing(findings, limits)
    low, high = scale_range(findings, limits)
    if low * np.exp(OTHER_SCALE) < 1.0 or high > np.exp(OTHER_SCALE):
        return None if open_ else Undetermined('scale', np.zeros(3), low * units.scale, high * units.scale)
    motions = [rival.motion for rival in open_ if rival.motion is not None]
    if not motions or len(motions) < len(open_) or any(motion.kind != motions[0].kind for motion in motions):
        return None
    axis = motions[0].axis
    if any(abs(motion.axis @ axis) < SAME_AXIS for motion in motions):
        return None
    amounts = [motion.amount * np.sign(motion.axis @ axis) for motion in motions]
    unit = units.length if motions[0].kind == 'slide' else 1.0
    return Undetermined(motions[0].kind, axis, min(0.0, *amounts) * unit, max(0.0, *amounts) * unit)


def confidence(findings: Findings) -> float:
    """Return the probability that a transform with such findings is right: logistic, fitted on labelled cases."""
    bias, slope = LOGISTIC
    return float(1.0 / (1.0 + np.exp(-bias - slope * np.log(margin(findings)) / _deviation(findings))))


def _other_scale_ratio(findings: Findings) -> float:
    return max((ratio for factor, ratio in findings.scale_curve if _other(factor)), default=0.0)


def _other(factor: float) -> bool:
    return abs(np.log(factor)) > OTHER_SCALE


def within_bounds(verdict: Verdict, scale: float, bounds: ScaleConfig) -> Verdict:
    """Return the verdict; rejected, where refinement has left the bounds of the scale (target per source unit)."""
    low, high = bounds.bounds
    if not bounds.estimate_scale or low <= scale <= high:
        return verdict
    allowed = 'scale.scale_min..scale_max' if bounds.prior == 0.0 else 'the bounds of scale.prior'
    reason = f'scale {scale:.4g} is not in {allowed} ({low:g}..{high:g})'
    return replace(verdict, accepted=False, reason=reason, confidence=0.0)


NO_HYPOTHESIS = 'no hypothesis: no three correspondences keep their mutual distances and angles in both clouds'
NOT_EXPECTED = 'nothing that fits lies near the prior; check it, widen its sigma, or leave it out'


def no_hypothesis(reason: str = NO_HYPOTHESIS) -> Verdict:
    """Return the verdict where no transform was proposed."""
    return Verdict(False, reason, 0.0, 0.0, float('inf'), 0.0)
