"""The decision as a pure function: tables of findings and what must come of them."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from csgm_ros.cloud.agreement import Agreement
from csgm_ros.config import ScaleConfig, VerificationConfig
from csgm_ros.types import Similarity
from csgm_ros.verification.decide import Units, confidence, decide, margin, no_hypothesis, within_bounds
from csgm_ros.verification.evidence import Evidence
from csgm_ros.verification.findings import Findings, Motion, Rival, motion
from csgm_ros.verification.probes import SCALES

LIMITS = VerificationConfig()
EVIDENCE = Evidence(Similarity.identity(), 0.5, 0.9, 0.4, 0.01)
UNITS = Units(length=2.0, scale=10.0)
X, Y = np.eye(3)[:2]
SHARP = tuple((factor, 0.1) for factor in SCALES)


def agreement(planes=20.0, inliers=500, coverage=0.5):
    return Agreement(0.5, coverage, planes, inliers)


def found(ratio):
    return Rival(ratio, 20.0)


def slid(ratio, amount, axis=X):
    return Rival(ratio, 20.0, Motion('slide', axis * np.sign(amount), abs(amount)))


def turned(ratio, amount, axis=X):
    return Rival(ratio, 20.0, Motion('turn', axis, amount))


def findings(*rivals, curve=SHARP, **rest):
    return Findings(rest.pop('agreement', agreement()), rivals, curve, half_shift=rest.pop('half_shift', 0.01), **rest)


def judged(found, *, estimate_scale=True):
    return decide(EVIDENCE, found, LIMITS, UNITS, estimate_scale=estimate_scale)


@pytest.mark.parametrize(
    ('given', 'said'),
    [
        (findings(), '20 independent surfaces'),
        (findings(found(0.2), slid(0.1, 1.0)), '5.0 times as well'),
        (findings(seen_through=0.1), 'independent surfaces'),
        (findings(Rival(0.8, 3.0)), 'independent surfaces'),  # nearby, but worse
        (findings(found(0.45), agreement=agreement(planes=60.0)), '2.2 times as well'),
        (findings(mirrored=0.79), 'independent surfaces'),
        (findings(agreement=agreement(planes=80.0), mirrored=0.98), '20.0 times as well'),  # its own mirror image
        (findings(found(0.4), agreement=agreement(planes=60.0), mirrored=0.85), '2.5 times as well'),
        (findings(curve=()), 'independent surfaces'),
        (findings(curve=((0.94, 1.0), (1.06, 1.0), (1.14, 0.1))), 'independent surfaces'),  # the same answer
    ],
)
def test_what_nothing_speaks_against_is_accepted(given, said):
    verdict = judged(given)
    assert verdict.accepted
    assert said in verdict.reason
    assert (verdict.fitness_source, verdict.fitness_target, verdict.inlier_rmse) == (0.5, 0.9, 0.01)
    assert verdict.undetermined is None


@pytest.mark.parametrize(
    ('given', 'said'),
    [
        (findings(found(0.95)), 'a different transform fits 0.95 times as well'),
        (findings(found(1.4)), 'a different transform'),  # better than the winner itself
        (findings(slid(0.97, 0.6)), 'slides along (1.00, 0.00, 0.00) by 1.2'),
        (findings(slid(0.97, -0.6)), 'by 1.2'),
        (findings(turned(1.0, 180.0), slid(0.95, 0.6)), 'slides along'),  # which says more, at nearly as much
        (findings(turned(1.2, 180.0), slid(0.95, 0.6)), 'turned by 180 degrees'),
        (findings(turned(0.9, 180.0, Y)), 'turned by 180 degrees about (0.00, 1.00, 0.00)'),
        (findings(curve=((0.88, 0.9), (1.14, 0.2), (1.25, 0.9))), 'scale not determined, between 8.8 and 12.5'),
        (findings(curve=((0.94, 0.5), (1.06, 1.3), (1.14, 0.4))), 'not settled: it fits 1.30 times as well 1.06 times'),
        (findings(Rival(0.95, 3.0)), 'a different transform'),  # nearby, and as good
        (findings(mirrored=1.5), 'mirror image'),
        (findings(agreement=agreement(planes=80.0), mirrored=1.15), 'mirror image'),
        (findings(found(0.19), agreement=agreement(planes=24.0), mirrored=0.9), 'a fit by chance'),  # a corner
        (findings(mirrored=0.9), 'a fit by chance'),  # of 20 surfaces: less than one standard deviation worse
        (findings(found(0.3), agreement=agreement(planes=5.0)), '0.30 times as well'),  # few surfaces: a wide margin
        (findings(found(0.53), agreement=agreement(planes=60.0)), '0.53 times as well'),
        (findings(half_shift=2.0), 'halves of the overlap'),
        (findings(half_shift=float('inf')), 'halves of the overlap'),
        (findings(seen_through=0.5), 'looked through 50%'),
        (findings(agreement=agreement(planes=1.0)), 'verification.min_planes'),
        (findings(agreement=agreement(inliers=3)), 'too little overlap'),
        (findings(agreement=agreement(coverage=0.06)), '6.0% of the surfaces of the smaller cloud agree, 7.0% are'),
    ],
)
def test_each_doubt_rejects_and_says_so(given, said):
    verdict = judged(given)
    assert not verdict.accepted
    assert said in verdict.reason
    assert verdict.confidence <= 0.5


@pytest.mark.parametrize(
    ('given', 'most'),
    [
        (findings(agreement=agreement(inliers=0, planes=0.0)), 0.02),  # nothing competes where nothing overlaps
        (findings(agreement=agreement(planes=1.0)), 0.02),
        (findings(seen_through=0.5), 0.1),
        (findings(Rival(4.0, 3.0)), 0.1),
        (findings(found(0.6)), 0.5),
        (findings(found(1.0)), 0.06),
    ],
)
def test_what_is_rejected_has_as_little_confidence_as_its_reason_leaves(given, most):
    assert judged(given).confidence <= most


@pytest.mark.parametrize(
    ('given', 'kind', 'low', 'high'),
    [
        (findings(slid(0.9, 0.6), slid(0.8, -1.0), slid(0.1, 1.2, Y)), 'slide', -2.0, 1.2),
        (findings(slid(0.9, 0.6), slid(0.8, 1.0, -X)), 'slide', -2.0, 1.2),  # one axis, either sign
        (findings(turned(0.9, 90.0), turned(1.0, 180.0)), 'turn', 0.0, 180.0),
        (findings(curve=((0.88, 0.9), (1.14, 0.9))), 'scale', 8.8, 11.4),
    ],
)
def test_one_direction_left_open_is_named_with_its_range(given, kind, low, high):
    verdict = judged(given)
    assert not verdict.accepted
    assert verdict.undetermined.kind == kind
    assert (verdict.undetermined.low, verdict.undetermined.high) == pytest.approx((low, high))


@pytest.mark.parametrize(
    'given',
    [
        findings(slid(0.9, 0.6), slid(0.9, 0.6, Y)),  # two directions
        findings(slid(0.9, 0.6), turned(0.9, 90.0)),
        findings(slid(0.9, 0.6), found(0.9)),  # what the search found is no known direction
        findings(slid(0.9, 0.6), seen_through=0.9),  # and wrong besides
    ],
)
def test_more_than_one_direction_left_open_names_none(given):
    assert judged(given).undetermined is None


def test_with_the_scale_given_the_reason_does_not_ask_for_it():
    verdict = judged(findings(curve=((0.88, 0.9), (1.14, 0.9))), estimate_scale=False)
    assert not verdict.accepted
    assert 'scale not determined' not in verdict.reason


share = st.floats(0, 1)
some_findings = st.builds(
    lambda planes, ratios, curve, shift, through: findings(
        *map(found, ratios),
        agreement=agreement(planes),
        curve=tuple(zip(SCALES, curve, strict=True)),
        half_shift=shift,
        seen_through=through,
    ),
    st.floats(0, 50),
    st.lists(st.floats(0, 2), max_size=4),
    st.lists(st.floats(0, 1.5), min_size=len(SCALES), max_size=len(SCALES)),
    st.floats(0, 2),
    share,
)


@given(some_findings, st.floats(0, 2))
def test_more_competition_never_makes_a_verdict_kinder(before, another):
    after = dataclasses.replace(before, rivals=(*before.rivals, found(another)))
    assert margin(after) <= margin(before)
    assert judged(before).accepted or not judged(after).accepted
    assert confidence(after) <= confidence(before) + 1e-12


@given(some_findings, st.floats(0, 1))
def test_what_a_sensor_has_looked_through_never_helps(before, through):
    after = dataclasses.replace(before, seen_through=max(before.seen_through, through))
    assert judged(before).accepted or not judged(after).accepted


@given(some_findings)
def test_every_verdict_has_a_reason_and_a_confidence(given):
    verdict = judged(given)
    assert verdict.reason
    assert 0.0 <= verdict.confidence <= 1.0
    assert verdict.accepted == (verdict.confidence > 0.5) or verdict.confidence <= 0.5


@pytest.mark.parametrize(
    ('scale', 'bounds', 'accepted'),
    [(1.0, ScaleConfig(), True), (2e6, ScaleConfig(), False), (5.0, ScaleConfig(estimate_scale=False), True)],
)
def test_a_scale_out_of_its_bounds_is_rejected_and_named(scale, bounds, accepted):
    verdict = within_bounds(judged(findings()), scale, bounds)
    assert verdict.accepted is accepted
    assert accepted or ('scale.scale_min' in verdict.reason and f'{scale:.4g}' in verdict.reason)


@pytest.mark.parametrize('angle', [15.0, 90.0, 180.0])
def test_a_turn_is_told_by_its_axis_and_angle(angle):
    axis = np.array([0.6, 0.0, 0.8])
    cross = np.cross(np.eye(3), -axis)
    turn = np.eye(4)
    turn[:3, :3] += np.sin(np.radians(angle)) * cross + (1 - np.cos(np.radians(angle))) * cross @ cross
    found = motion(np.diag([2.0, 2.0, 2.0, 1.0]), turn @ np.diag([2.0, 2.0, 2.0, 1.0]), np.eye(3))
    assert found.kind == 'turn'
    assert found.amount == pytest.approx(angle)
    assert abs(found.axis @ axis) == pytest.approx(1.0)


def test_a_slide_is_told_by_its_direction_and_length_and_another_scale_by_neither():
    slid = np.eye(4)
    slid[:3, 3] = 0.0, -3.0, 0.0
    found = motion(np.eye(4), slid, np.eye(3))
    assert (found.kind, found.amount) == ('slide', 3.0)
    np.testing.assert_allclose(found.axis, -Y)
    assert motion(np.eye(4), np.diag([1.2, 1.2, 1.2, 1.0]), np.eye(3)) is None


def test_without_hypotheses_the_verdict_says_so():
    verdict = no_hypothesis()
    assert not verdict.accepted
    assert 'no hypothesis' in verdict.reason
    assert (verdict.fitness_source, verdict.fitness_target, verdict.margin) == (0.0, 0.0, 0.0)
