"""Two clouds as verification sees them: exact measures, and the verdict on what was measured."""

import numpy as np
import pytest
from scenes import ball, box, error, random_rotation, random_similarity, room

from csgm_ros.config import profile, replaced
from csgm_ros.scale import normalizations
from csgm_ros.transform.refinement import refine_finalists
from csgm_ros.types import NormalizedPair, Similarity
from csgm_ros.verification.view import View

CONFIG = profile()
TRUTH = random_similarity(np.random.default_rng(3), (0.2, 0.3), 10.0)
ROOM = room(1, 1000), TRUTH.apply(room(2, 1000))
HALF_TURN = Similarity(1.0, np.diag([-1.0, -1.0, 1.0]), np.zeros(3))


def view_of(clouds, config=CONFIG, units=None):
    units = units or normalizations(*clouds, config.scale)
    return View(NormalizedPair(clouds, units), config, np.random.default_rng(0), retried=False)


def normal(transform, view):
    """A transform between the clouds' own units, between the normalised clouds."""
    source, target = view.pair.normalizations
    return target @ transform @ source.inverse()


def judged(view, transform):
    return view.judge(view.measure(transform))


def considered(view, *transforms):
    """Refine and measure transforms; the best of all measured so far and its verdict."""
    refined = refine_finalists(np.stack([transform.matrix for transform in transforms]), *view.surfaces, CONFIG)
    view.measured += map(view.measure, refined)
    best = max(view.measured, key=lambda evidence: evidence.score)
    return best.transform, view.judge(best)


@pytest.fixture(scope='module')
def room_view():
    return view_of(ROOM)


@pytest.fixture
def seen():
    """A fresh view of the room and the truth in its frame."""
    view = view_of(ROOM)
    return view, normal(TRUTH, view)


def wrong_ones(count):
    rng = np.random.default_rng(8)
    return [Similarity(1.0, random_rotation(rng), rng.normal(scale=0.2, size=3)) for _ in range(count)]


def test_a_cloud_fits_itself_perfectly():
    fit = view_of((ROOM[0], ROOM[0])).measure(Similarity.identity())
    assert (fit.fitness_source, fit.fitness_target, fit.score, fit.rmse) == (1.0, 1.0, 1.0, 0.0)


def test_the_truth_fits_far_better_than_anything_else(room_view):
    truth = room_view.measure(normal(TRUTH, room_view))
    assert min(truth.fitness_source, truth.fitness_target) > 0.85
    for wrong in wrong_ones(10):
        assert room_view.measure(wrong).score < 0.5 * truth.score


def test_both_sides_are_told_apart_and_the_smaller_counts():
    whole = room(1, 1000)
    part = room(2, 1000)
    part = part[part[:, 0] < 1.5]
    units = (normalizations(whole, whole, CONFIG.scale)[0],) * 2  # one frame for both
    forth = view_of((whole, part), units=units).measure(Similarity.identity())
    back = view_of((part, whole), units=units).measure(Similarity.identity())
    assert forth.fitness_target > 0.9 > 0.75 > forth.fitness_source
    assert back.fitness_source == pytest.approx(forth.fitness_target, abs=0.02)
    assert back.fitness_target == pytest.approx(forth.fitness_source, abs=0.02)
    both = view_of((whole, room(2, 1000)), units=units).measure(Similarity.identity())
    assert forth.score < 0.85 * both.score
    assert back.score < 0.85 * both.score


def test_far_away_nothing_fits(room_view):
    fit = room_view.measure(Similarity(1.0, np.eye(3), np.full(3, 100.0)))
    assert (fit.fitness_source, fit.fitness_target, fit.score) == (0.0, 0.0, 0.0)
    assert fit.rmse == float('inf')


def test_a_shrunken_fit_is_worse(room_view):
    truth = normal(TRUTH, room_view)
    ladder = [
        room_view.measure(truth @ Similarity(factor, np.eye(3), np.zeros(3))) for factor in (1.0, 0.95, 0.7, 0.01)
    ]
    assert (np.diff([fit.score for fit in ladder]) < 0).all()
    assert min(ladder[-1].fitness_source, ladder[-1].fitness_target) < 0.02


def test_finds_the_truth_among_wrong_ones_refines_and_accepts_it(seen):
    view, truth = seen
    start = truth @ Similarity(1.01, np.eye(3), np.full(3, 0.01))
    best, verdict = considered(view, *wrong_ones(4), start)
    assert verdict.accepted, verdict.reason
    assert error(best, truth, view.surfaces[0].points) < 0.005 < error(start, truth, view.surfaces[0].points)
    assert verdict.margin > CONFIG.verification.min_margin
    assert 0.0 < verdict.inlier_rmse < CONFIG.verification.inlier_distance / view.pair.normalizations[1].scale


def test_the_best_of_all_considered_is_judged_and_all_compete(seen):
    view, truth = seen
    first, accepted = considered(view, truth)
    second, still = considered(view, *wrong_ones(4))
    assert accepted.accepted
    assert still.accepted
    assert error(second, first, view.surfaces[0].points) < 1e-3
    assert still.margin <= accepted.margin


def test_hypotheses_for_the_same_place_do_not_compete(seen):
    view, truth = seen
    near = [truth @ Similarity(1.0, np.eye(3), np.array([offset, 0, 0])) for offset in (0.0, 0.01, 0.02)]
    _, verdict = considered(view, *near)
    assert verdict.accepted
    assert verdict.margin > 5.0


def test_a_near_miss_is_rejected_when_the_truth_was_considered(seen):
    view, truth = seen
    miss = truth @ Similarity(1.05, np.eye(3), np.zeros(3))
    assert judged(view, miss).accepted  # knowing no better
    considered(view, truth)
    verdict = judged(view, miss)
    assert not verdict.accepted
    assert verdict.margin < 1.0


def test_two_equally_good_places_are_ambiguous():
    rng = np.random.default_rng(0)
    clouds = tuple(box(rng, (-0.5, -1.0, -1.5), (1, 2, 3), 1000) for _ in range(2))
    view = view_of(clouds)
    places = [normal(place, view) for place in (Similarity.identity(), HALF_TURN)]
    assert considered(view, places[0])[1].accepted  # knowing no other
    _, verdict = considered(view, *places)
    assert not verdict.accepted
    assert 'ambiguous' in verdict.reason
    assert verdict.margin == pytest.approx(1.0, abs=0.05)


def test_what_hardly_overlaps_is_rejected_with_the_threshold_named(seen):
    view, truth = seen
    away = truth @ Similarity(1.0, np.eye(3), np.array([0.0, 1.4, 0.0]))
    evidence = view.measure(away)
    verdict = view.judge(evidence)
    assert evidence.fitness < CONFIG.verification.min_fitness
    assert not verdict.accepted
    assert 'overlap' in verdict.reason
    assert 'verification.min_fitness' in verdict.reason


@pytest.mark.parametrize('bounds', [(1e-6, 0.1), (0.5, 1e6)])
def test_a_scale_out_of_its_bounds_is_rejected_however_well_it_fits(bounds):
    config = replaced(CONFIG, {'scale.scale_min': bounds[0], 'scale.scale_max': bounds[1]})
    view = view_of(ROOM, config)
    verdict = judged(view, normal(TRUTH, view))
    assert not verdict.accepted
    assert 'scale.scale_min' in verdict.reason
    assert f'{TRUTH.scale:.4g}' in verdict.reason


@pytest.mark.parametrize(
    'threshold', [{'min_fitness': 0.999}, {'min_margin': 100.0}, {'min_lead': 0.99}, {'chance': 0.9}]
)
def test_each_threshold_can_reject(threshold):
    config = replaced(CONFIG, {f'verification.{name}': value for name, value in threshold.items()})
    view = view_of(ROOM, config)
    truth = normal(TRUTH, view)
    assert judged(view_of(ROOM), truth).accepted
    assert not judged(view, truth).accepted


def test_fewer_points_need_a_larger_lead():
    rng = np.random.default_rng(2)
    few = tuple(cloud[rng.choice(len(cloud), 200, replace=False)] for cloud in ROOM)
    view = view_of(few)
    lead = view.measure(normal(TRUTH, view)).score - CONFIG.verification.chance
    config = replaced(CONFIG, {'verification.min_lead': 0.5 * lead})
    for clouds, enough in ((ROOM, True), (few, False)):
        view = view_of(clouds, config)
        assert judged(view, normal(TRUTH, view)).accepted is enough


def test_what_another_attempt_finds_needs_a_wider_margin_and_the_rest_does_not():
    config = replaced(CONFIG, {'verification.min_margin_retried': 100.0})
    view = view_of(ROOM, config)
    truth = normal(TRUTH, view)
    _, first = considered(view, truth)
    view.end_attempt()
    near = truth @ Similarity(1.001, np.eye(3), np.zeros(3))
    best, same = considered(view, near, *wrong_ones(3))
    assert first.accepted
    assert same.accepted
    assert same.margin <= first.margin
    assert error(best, truth, view.surfaces[0].points) < 0.01
    view = view_of(ROOM, config)
    considered(view, *wrong_ones(3))
    view.end_attempt()
    assert not considered(view, truth)[1].accepted


def test_unrelated_shapes_do_not_fit():
    rng = np.random.default_rng(0)
    view = view_of((ROOM[0], ball(rng, (0, 0, 0), 1.0, 400)))
    _, verdict = considered(view, *wrong_ones(6))
    assert not verdict.accepted
