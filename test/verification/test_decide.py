"""The judge: exact measures, and a verdict that fails closed."""

import numpy as np
import pytest
from scenes import ball, box, error, random_rotation, random_similarity, room

from csgm_ros.config import profile, replaced
from csgm_ros.scale import normalizations
from csgm_ros.types import Similarity
from csgm_ros.verification.decide import Judge

CONFIG = profile()
TRUTH = random_similarity(np.random.default_rng(3), (0.2, 0.3), 10.0)
ROOM = room(1, 1000), TRUTH.apply(room(2, 1000))
HALF_TURN = Similarity(1.0, np.diag([-1.0, -1.0, 1.0]), np.zeros(3))


def judge_of(clouds, config=CONFIG):
    units = normalizations(*clouds, config.scale)
    return Judge(clouds, units, config, np.random.default_rng(0)), units


def normal(transform, units):
    """A transform between the clouds' own units, between the normalised clouds."""
    return units[1] @ transform @ units[0].inverse()


def considered(judge, *transforms):
    return judge.consider(np.stack([transform.matrix for transform in transforms]))


@pytest.fixture(scope='module')
def room_judge():
    return judge_of(ROOM)


@pytest.fixture
def judged():
    """A fresh judge of the room and the truth in its frame."""
    judge, units = judge_of(ROOM)
    return judge, normal(TRUTH, units)


def wrong_ones(count):
    rng = np.random.default_rng(8)
    return [Similarity(1.0, random_rotation(rng), rng.normal(scale=0.2, size=3)) for _ in range(count)]


def test_a_cloud_fits_itself_perfectly():
    judge, _ = judge_of((ROOM[0], ROOM[0]))
    fit = judge.fit(Similarity.identity())
    assert (fit.fitness_source, fit.fitness_target, fit.closeness, fit.rmse) == (1.0, 1.0, 1.0, 0.0)


def test_the_truth_fits_far_better_than_anything_else(room_judge):
    judge, units = room_judge
    truth = judge.fit(normal(TRUTH, units))
    assert min(truth.fitness_source, truth.fitness_target) > 0.85
    for wrong in wrong_ones(10):
        assert judge.fit(wrong).closeness < 0.5 * truth.closeness


def test_both_sides_are_told_apart_and_the_smaller_counts():
    whole = room(1, 1000)
    part = room(2, 1000)
    part = part[part[:, 0] < 1.5]
    units = (normalizations(whole, whole, CONFIG.scale)[0],) * 2  # one frame for both
    forth = Judge((whole, part), units, CONFIG, np.random.default_rng(0)).fit(Similarity.identity())
    back = Judge((part, whole), units, CONFIG, np.random.default_rng(0)).fit(Similarity.identity())
    assert forth.fitness_target > 0.9 > 0.75 > forth.fitness_source
    assert back.fitness_source == pytest.approx(forth.fitness_target, abs=0.02)
    assert back.fitness_target == pytest.approx(forth.fitness_source, abs=0.02)
    both = Judge((whole, room(2, 1000)), units, CONFIG, np.random.default_rng(0)).fit(Similarity.identity())
    assert forth.closeness < 0.85 * both.closeness
    assert back.closeness < 0.85 * both.closeness


def test_far_away_nothing_fits(room_judge):
    fit = room_judge[0].fit(Similarity(1.0, np.eye(3), np.full(3, 100.0)))
    assert (fit.fitness_source, fit.fitness_target, fit.closeness) == (0.0, 0.0, 0.0)
    assert fit.rmse == float('inf')


def test_a_shrunken_fit_is_worse(room_judge):
    judge, units = room_judge
    truth = normal(TRUTH, units)
    ladder = [judge.fit(truth @ Similarity(factor, np.eye(3), np.zeros(3))) for factor in (1.0, 0.95, 0.7, 0.01)]
    assert (np.diff([fit.closeness for fit in ladder]) < 0).all()
    assert min(ladder[-1].fitness_source, ladder[-1].fitness_target) < 0.02


def test_finds_the_truth_among_wrong_ones_refines_and_accepts_it(judged):
    judge, truth = judged
    start = truth @ Similarity(1.01, np.eye(3), np.full(3, 0.01))
    best, verdict = considered(judge, *wrong_ones(4), start)
    assert verdict.accepted, verdict.reason
    assert error(best, truth, judge._sides[0].points) < 0.005 < error(start, truth, judge._sides[0].points)
    assert verdict.margin > CONFIG.verification.min_margin
    assert 0.0 < verdict.inlier_rmse < CONFIG.verification.inlier_distance / judge_of(ROOM)[1][1].scale


def test_the_best_of_all_considered_is_judged_and_all_are_its_rivals(judged):
    judge, truth = judged
    first, accepted = considered(judge, truth)
    second, still = considered(judge, *wrong_ones(4))
    assert accepted.accepted
    assert still.accepted
    assert error(second, first, judge._sides[0].points) < 1e-3
    assert still.margin <= accepted.margin


def test_hypotheses_for_the_same_place_are_no_rivals(judged):
    judge, truth = judged
    near = [truth @ Similarity(1.0, np.eye(3), np.array([offset, 0, 0])) for offset in (0.0, 0.01, 0.02)]
    _, verdict = considered(judge, *near)
    assert verdict.accepted
    assert verdict.margin > 5.0


def test_a_near_miss_is_rejected_when_the_truth_was_considered(judged):
    judge, truth = judged
    miss = truth @ Similarity(1.05, np.eye(3), np.zeros(3))
    assert judge.verdict(miss, judge.fit(miss)).accepted  # knowing no better
    considered(judge, truth)
    verdict = judge.verdict(miss, judge.fit(miss))
    assert not verdict.accepted
    assert verdict.margin < 1.0


def test_two_equally_good_places_are_ambiguous():
    rng = np.random.default_rng(0)
    clouds = tuple(box(rng, (-0.5, -1.0, -1.5), (1, 2, 3), 1000) for _ in range(2))
    judge, units = judge_of(clouds)
    places = [normal(place, units) for place in (Similarity.identity(), HALF_TURN)]
    assert judge.consider(np.stack([places[0].matrix]))[1].accepted  # knowing no other
    _, verdict = considered(judge, *places)
    assert not verdict.accepted
    assert 'ambiguous' in verdict.reason
    assert verdict.margin == pytest.approx(1.0, abs=0.05)


def test_what_hardly_overlaps_is_rejected_with_the_threshold_named(judged):
    judge, truth = judged
    away = truth @ Similarity(1.0, np.eye(3), np.array([0.0, 1.4, 0.0]))
    fit = judge.fit(away)
    verdict = judge.verdict(away, fit)
    assert min(fit.fitness_source, fit.fitness_target) < CONFIG.verification.min_fitness
    assert not verdict.accepted
    assert 'overlap' in verdict.reason
    assert 'verification.min_fitness' in verdict.reason


def test_without_hypotheses_the_verdict_says_so(judged):
    best, verdict = judged[0].consider(np.empty((0, 4, 4)))
    assert not verdict.accepted
    assert 'no hypothesis' in verdict.reason
    np.testing.assert_array_equal(best.matrix, np.eye(4))
    assert (verdict.fitness_source, verdict.fitness_target) == (0.0, 0.0)


@pytest.mark.parametrize('bounds', [(1e-6, 0.1), (0.5, 1e6)])
def test_a_scale_out_of_its_bounds_is_rejected_however_well_it_fits(bounds):
    config = replaced(CONFIG, {'scale.scale_min': bounds[0], 'scale.scale_max': bounds[1]})
    judge, units = judge_of(ROOM, config)
    truth = normal(TRUTH, units)
    verdict = judge.verdict(truth, judge.fit(truth))
    assert not verdict.accepted
    assert 'scale.scale_min' in verdict.reason
    assert f'{TRUTH.scale:.4g}' in verdict.reason


@pytest.mark.parametrize(
    'threshold', [{'min_fitness': 0.999}, {'min_margin': 100.0}, {'min_lead': 0.99}, {'chance': 0.9}]
)
def test_each_threshold_can_reject(threshold):
    config = replaced(CONFIG, {f'verification.{name}': value for name, value in threshold.items()})
    judge, units = judge_of(ROOM, config)
    truth = normal(TRUTH, units)
    assert judge_of(ROOM)[0].verdict(truth, judge.fit(truth)).accepted
    assert not judge.verdict(truth, judge.fit(truth)).accepted


def test_fewer_points_need_a_larger_lead():
    rng = np.random.default_rng(2)
    few = tuple(cloud[rng.choice(len(cloud), 200, replace=False)] for cloud in ROOM)
    judge, units = judge_of(few)
    truth = normal(TRUTH, units)
    lead = judge.fit(truth).closeness - CONFIG.verification.chance
    config = replaced(CONFIG, {'verification.min_lead': 0.5 * lead})
    for clouds, enough in ((ROOM, True), (few, False)):
        judge, units = judge_of(clouds, config)
        truth = normal(TRUTH, units)
        assert judge.verdict(truth, judge.fit(truth)).accepted is enough


def test_what_another_look_finds_needs_a_wider_margin_and_the_rest_does_not():
    config = replaced(CONFIG, {'verification.min_margin_again': 100.0})
    judge, units = judge_of(ROOM, config)
    truth = normal(TRUTH, units)
    _, first = considered(judge, truth)
    judge.look_again()
    near = truth @ Similarity(1.001, np.eye(3), np.zeros(3))
    best, same = considered(judge, near, *wrong_ones(3))
    assert first.accepted
    assert same.accepted
    assert same.margin <= first.margin
    assert error(best, truth, judge._sides[0].points) < 0.01
    judge, _ = judge_of(ROOM, config)
    considered(judge, *wrong_ones(3))
    judge.look_again()
    assert not considered(judge, truth)[1].accepted


def test_unrelated_shapes_do_not_fit():
    rng = np.random.default_rng(0)
    judge, _ = judge_of((ROOM[0], ball(rng, (0, 0, 0), 1.0, 400)))
    _, verdict = considered(judge, *wrong_ones(6))
    assert not verdict.accepted
