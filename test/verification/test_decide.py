"""The decision as a pure function: tables of evidence and what must come of them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from csgm_ros.config import ScaleConfig, VerificationConfig
from csgm_ros.types import Similarity
from csgm_ros.verification.decide import Thresholds, competing, decide, no_hypothesis, thresholds, within_bounds
from csgm_ros.verification.evidence import Evidence

LIMITS = Thresholds(min_fitness=0.2, min_margin=1.25, min_lead=0.02, chance=0.05)
CONFIG = VerificationConfig()
PROBE = np.random.default_rng(0).normal(size=(50, 3))


def evidence(score, fitness=0.5, shift=0.0):
    return Evidence(Similarity(1.0, np.eye(3), np.array([shift, 0.0, 0.0])), fitness, 0.9, score, 0.01)


@pytest.mark.parametrize(
    ('best', 'others', 'accepted', 'said'),
    [
        (evidence(0.5), [], True, '10.00 times'),
        (evidence(0.5), [evidence(0.2), evidence(0.3)], True, '1.67 times'),
        (evidence(0.5), [evidence(0.2), evidence(0.45)], False, 'ambiguous'),
        (evidence(0.5), [evidence(0.6)], False, 'ambiguous'),
        (evidence(0.5, fitness=0.19), [], False, 'too little overlap'),
        (evidence(0.06), [], False, 'ambiguous'),  # hardly above chance
        (evidence(0.065), [evidence(0.05)], False, 'ambiguous'),  # margin enough, lead too small
        (evidence(0.0, fitness=0.0), [], False, 'too little overlap'),
    ],
)
def test_verdicts(best, others, accepted, said):
    verdict = decide(best, others, LIMITS)
    assert verdict.accepted is accepted
    assert said in verdict.reason
    assert (verdict.fitness_source, verdict.fitness_target) == (best.fitness_source, best.fitness_target)


@given(st.floats(0, 1), st.floats(0, 1), st.lists(st.floats(0, 1), max_size=5), st.floats(0, 1))
def test_more_competition_never_makes_a_verdict_kinder(score, fitness, others, another):
    before = decide(evidence(score, fitness), map(evidence, others), LIMITS)
    after = decide(evidence(score, fitness), map(evidence, [*others, another]), LIMITS)
    assert after.margin <= before.margin
    assert before.accepted or not after.accepted


def test_what_competes_is_different_or_much_better():
    best = evidence(0.5)
    same, different = evidence(0.4, shift=0.05), evidence(0.3, shift=1.0)
    much_better = evidence(0.9, shift=0.05)
    assert competing(best, [best, same, different, much_better], PROBE, CONFIG) == [different, much_better]


def test_noise_few_points_and_later_attempts_change_what_is_asked():
    plain = thresholds(CONFIG, 1.0, CONFIG.fine_samples, retried=False)
    assert (plain.min_fitness, plain.min_margin) == (CONFIG.min_fitness, CONFIG.min_margin)
    assert thresholds(CONFIG, 0.5, CONFIG.fine_samples, retried=False).min_fitness == 0.5 * CONFIG.min_fitness
    assert thresholds(CONFIG, 1.0, CONFIG.fine_samples // 4, retried=False).min_lead == 2 * CONFIG.min_lead
    assert thresholds(CONFIG, 1.0, CONFIG.fine_samples, retried=True).min_margin == CONFIG.min_margin_retried


@pytest.mark.parametrize(
    ('scale', 'bounds', 'accepted'),
    [(1.0, ScaleConfig(), True), (2e6, ScaleConfig(), False), (5.0, ScaleConfig(estimate_scale=False), True)],
)
def test_a_scale_out_of_its_bounds_is_rejected_and_named(scale, bounds, accepted):
    verdict = within_bounds(decide(evidence(0.5), [], LIMITS), scale, bounds)
    assert verdict.accepted is accepted
    assert accepted or ('scale.scale_min' in verdict.reason and f'{scale:.4g}' in verdict.reason)


def test_without_hypotheses_the_verdict_says_so():
    verdict = no_hypothesis()
    assert not verdict.accepted
    assert 'no hypothesis' in verdict.reason
    assert (verdict.fitness_source, verdict.fitness_target, verdict.margin) == (0.0, 0.0, 0.0)
