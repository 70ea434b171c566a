"""Two clouds as verification sees them: exact measures, and the verdict on what was measured."""

import numpy as np
import pytest
from scenes import ball, box, error, random_rotation, random_similarity, rectangle, room
from scipy.spatial.transform import Rotation

from csgm_ros.cloud import nearest_grid
from csgm_ros.cloud.agreement import INLIER, NEAR
from csgm_ros.config import profile, replaced
from csgm_ros.scale import normalizations
from csgm_ros.transform.refinement import refine_between, refine_finalists
from csgm_ros.types import NormalizedPair, Similarity
from csgm_ros.verification import findings
from csgm_ros.verification.view import View

CONFIG = profile()
TRUTH = random_similarity(np.random.default_rng(3), (0.2, 0.3), 10.0)
ROOM = room(1, 1000), TRUTH.apply(room(2, 1000))


def view_of(clouds, config=CONFIG, units=None, viewpoints=(None, None)):
    units = units or normalizations(*clouds, config.scale)
    return View(NormalizedPair(clouds, units), config, np.random.default_rng(0), refine_between, viewpoints)


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


def test_which_of_two_clouds_is_the_source_does_not_change_how_far_they_agree(seen):
    view, truth = seen
    back = view_of(ROOM[::-1])
    for moved in (truth, truth @ Similarity(1.02, np.eye(3), np.full(3, 0.02))):
        forth = view.score(moved)
        assert back.score(normal(view.pair.in_own_units(moved).inverse(), back)) == pytest.approx(forth, rel=1e-3)
    assert 0.0 < forth < view.score(truth)


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
    assert verdict.confidence > 0.9
    assert 0.0 < verdict.inlier_rmse < CONFIG.verification.inlier_distance / view.pair.normalizations[1].scale


def test_the_best_of_all_considered_is_judged_and_all_compete(seen):
    view, truth = seen
    first, accepted = considered(view, truth)
    second, still = considered(view, *wrong_ones(4))
    assert accepted.accepted
    assert still.accepted
    assert error(second, first, view.surfaces[0].points) < 1e-3
    assert still.margin <= accepted.margin


def test_wrong_transforms_are_rejected_whether_or_not_the_truth_is_known(seen):
    view, truth = seen
    wrong = [judged(view, transform) for transform in wrong_ones(3)]
    considered(view, truth)
    wrong += [judged(view, transform) for transform in wrong_ones(3)]
    assert not any(verdict.accepted for verdict in wrong)
    assert all(verdict.confidence <= 0.5 for verdict in wrong)


@pytest.mark.parametrize('swapped', [False, True])
def test_source_and_target_swapped_get_the_same_verdict(swapped):
    clouds, truth = (ROOM[::-1], TRUTH.inverse()) if swapped else (ROOM, TRUTH)
    view = view_of(clouds)
    verdict = considered(view, normal(truth, view))[1]
    assert verdict.accepted, verdict.reason
    assert verdict.margin == pytest.approx(considered(view_of(ROOM), normal(TRUTH, view_of(ROOM)))[1].margin, rel=0.25)


def test_a_small_part_in_a_large_whole_is_accepted():
    rng = np.random.default_rng(5)
    rooms = [Similarity(1.0, random_rotation(rng), np.array([4.0 * k, 0.0, 0.0])).apply(room(2, 800)) for k in range(4)]
    whole = np.concatenate([room(2, 800), *rooms[1:]])
    part = room(1, 1200)
    part = part[part[:, 0] > 1.2]
    view = view_of((part, whole))
    verdict = considered(view, normal(Similarity.identity(), view))[1]
    assert verdict.fitness_target < 0.2
    assert verdict.accepted, verdict.reason


# ---- what fits in more than one way is said to


def test_a_half_turn_that_fits_as_well_is_found_though_nothing_proposed_it():
    rng = np.random.default_rng(0)
    clouds = tuple(box(rng, (-0.5, -1.0, -1.5), (1, 2, 3), 1000) for _ in range(2))
    view = view_of(clouds)
    verdict = considered(view, normal(Similarity.identity(), view))[1]
    assert not verdict.accepted
    assert 'ambiguous: fits' in verdict.reason
    assert 'turned by' in verdict.reason
    assert verdict.margin == pytest.approx(1.0, abs=0.1)


def corridor(seed, low, high):
    rng = np.random.default_rng(seed)
    length = high - low
    parts = [rectangle(rng, (low, 0, 0), (length, 0, 0), edge, 600) for edge in ((0, 2, 0), (0, 0, 2.5))]
    parts += [rectangle(rng, (low, 2, 0), (length, 0, 0), (0, 0, 2.5), 600)]
    parts += [rectangle(rng, (low, 0.4, 1.0), (length, 0, 0), (0, 0.3, 0.2), 600)]
    points = np.concatenate(parts)
    return points + rng.normal(scale=0.005, size=points.shape)


def test_a_corridor_slides_and_is_said_to():
    clouds = corridor(0, 2.0, 7.0), corridor(1, 0.0, 10.0)
    config = replaced(CONFIG, {'scale.estimate_scale': False, 'verification.min_planes': 1.0})
    config = replaced(config, {'verification.max_scale_ratio': 10.0})
    view = view_of(clouds, config)
    verdict = considered(view, normal(Similarity.identity(), view))[1]
    assert not verdict.accepted
    assert 'slides along' in verdict.reason


def test_a_corner_of_three_walls_is_ambiguous():
    clouds = []
    for seed, edge in ((0, 1.0), (1, 1.3)):
        rng = np.random.default_rng(seed)
        walls = [rectangle(rng, (0, 0, 0), edge * u, edge * v, 2500) for u, v in np.eye(3)[[[0, 1], [1, 2], [2, 0]]]]
        clouds.append(np.concatenate(walls) + rng.normal(scale=0.003, size=(sum(map(len, walls)), 3)))
    view = view_of(tuple(clouds), replaced(CONFIG, {'verification.min_planes': 1.0}))
    verdict = view.judge(view.measure(normal(Similarity.identity(), view)))
    assert not verdict.accepted
    assert 'ambiguous' in verdict.reason


def test_the_mirror_image_of_a_room_is_not_the_room():
    mirrored = ROOM[0] * (-1.0, 1.0, 1.0)
    view = view_of((mirrored, room(2, 1000)))
    chance = np.random.default_rng(3)
    tries = [Similarity(1.0, random_rotation(chance), np.zeros(3)) for _ in range(60)]
    assert not considered(view, *tries)[1].accepted


def test_what_a_sensor_has_looked_through_contradicts():
    rng = np.random.default_rng(4)
    eye = np.array([0.2, -0.1, 0.3])
    shell = ball(rng, eye, 3.0, 400)
    view = view_of((room(1, 1000) - (1.0, 0.8, 0.4), shell), viewpoints=(None, eye))
    verdict = judged(view, normal(Similarity.identity(), view))
    assert not verdict.accepted
    assert view._seen_through(normal(Similarity.identity(), view)) > 0.9


def nearby(transform, count):
    """Transforms of which each ends its ICP in another place: up to a cell and two degrees beside one."""
    rng = np.random.default_rng(6)
    for _ in range(count):
        turn = Rotation.from_rotvec(np.radians(rng.uniform(-2.0, 2.0, 3))).as_matrix()
        yield transform @ Similarity(float(np.exp(rng.normal(scale=0.01))), turn, rng.normal(scale=0.01, size=3))


def test_wherever_the_search_has_stopped_the_polished_transform_is_the_same():
    noise = np.random.default_rng(7).normal(scale=0.02, size=ROOM[0].shape)
    view = view_of((ROOM[0] + noise, ROOM[1]))
    starts = list(nearby(normal(TRUTH, view), 6))
    points, cell = view.pair.normalized[0], view.comparison(starts[0].scale)[0].cell
    first, *ends = (view.polished(start) for start in starts)
    assert min(start.displacement(starts[0], points) for start in starts[1:]) > 0.2 * cell
    assert max(end.displacement(first, points) for end in ends) < 0.04 * cell


def test_it_takes_the_mean_of_the_scales_at_which_the_clouds_agree_about_as_well(seen):
    view, truth = seen
    comparison, scale = view.comparison(truth.scale)
    winner = truth.matrix @ np.diag([*3 * [1.0 / scale], 1.0])
    overlap = comparison.overlap(winner)[0]
    for growth in (0.95, 1.05):
        start = findings.scales(winner, overlap, [growth])[0]
        end = findings.centred(comparison, start, refine_between)
        assert 0.98 < np.cbrt(np.linalg.det(end[:3, :3]) / np.linalg.det(winner[:3, :3])) < 1.02


def test_the_winner_at_another_scale_does_not_compete_with_it_and_the_scale_curve_tells_of_it(seen, monkeypatch):
    monkeypatch.setattr(findings, 'WORTH', 0.0)
    monkeypatch.setattr(findings, 'DOUBT', 0.0)
    monkeypatch.setattr(findings, 'SAME', 0.5)  # cells: this room is no larger than twenty
    view, truth = seen
    comparison, scale = view.comparison(truth.scale)
    winner = truth.matrix @ np.diag([*3 * [1.0 / scale], 1.0])
    resized = findings.scales(winner, comparison.overlap(winner)[0], [1.08])[0]
    assert findings.apart(comparison, winner, resized) > findings.SAME

    def stays(start, *, scaled=True):
        return start if scaled else view._polish(comparison)(start, scaled=False)

    found = findings.compared(comparison, winner, [resized], stays)
    assert not found.rivals
    assert dict(view.probed(truth, found).scale_curve)[1.06] > 0.0


def test_scores_of_many_transforms_at_a_time_are_those_of_each(room_view):
    comparison, _ = room_view.comparison(1.0)
    transforms = np.array([transform.matrix for transform in (normal(TRUTH, room_view), *wrong_ones(4))])
    singly = [comparison.agreement(transform, 300).score for transform in transforms]
    assert max(singly) > 0.005
    np.testing.assert_allclose(comparison.scores(transforms, 300), singly, atol=1e-12)


def asked_one_by_one(comparison, transform, most):
    """Precision, planes and inliers, by the definition, a point at a time."""
    shares, agrees, inliers = [], [], []
    for matrix, moving, still in zip(
        (transform, np.linalg.inv(transform)), comparison.sides, comparison.sides[::-1], strict=True
    ):
        sample, grid, scale = moving.sample[:most], still.grid, np.linalg.norm(matrix[:3, 0])
        points = moving.points[sample] @ matrix[:3, :3].T + matrix[:3, 3]
        near = np.array([nearest_grid.lookup(grid.index, grid.origin, grid.cell, *point) for point in points])
        offsets, weights = points - still.points[near], 1.0 / moving.coplanar[:most]
        height = (offsets * still.normals[near]).sum(1)
        aside = np.sqrt(np.maximum((offsets**2).sum(1) - height**2, 0.0)) - still.gap * np.sqrt(scale)
        across = np.hypot(height, np.maximum(aside, 0.0))
        parallel = np.abs(((moving.normals[sample] @ matrix[:3, :3].T) * still.normals[near]).sum(1)) / scale
        meets = (near >= 0) & (np.linalg.norm(offsets, axis=1) < NEAR * comparison.cell * np.sqrt(scale))
        agree = meets & (across < INLIER * comparison.cell * np.sqrt(scale)) & (parallel >= comparison._min_cosine)
        shares.append(weights[agree].sum() / weights[meets].sum())
        agrees.append(weights[agree].sum())
        inliers.append(agree.sum())
    return min(shares), min(agrees), min(inliers)


def test_agreement_is_what_asking_one_point_at_a_time_says(room_view):
    comparison, _ = room_view.comparison(1.0)
    truth = normal(TRUTH, room_view).matrix
    for transform in (truth, truth @ np.diag([1.05, 1.05, 1.05, 1.0])):
        said = comparison.agreement(transform, 300)
        np.testing.assert_allclose(
            (said.precision, said.planes, said.inliers), asked_one_by_one(comparison, transform, 300), rtol=1e-9
        )


def test_what_leads_back_to_the_winner_does_not_compete_with_it(seen, monkeypatch):
    monkeypatch.setattr(findings, 'WORTH', 0.0)  # else a room so clear leaves nothing to lead back
    view, truth = seen
    others = [truth @ Similarity(1.0, np.eye(3), offset) for offset in 0.08 * np.eye(3)]
    assert not view.compared(truth, others).rivals
    assert view.compared(truth, [*others, *wrong_ones(1)]).rivals


# ---- thresholds


def test_what_hardly_overlaps_is_rejected_for_that(seen):
    view, truth = seen
    verdict = judged(view, truth @ Similarity(1.0, np.eye(3), np.array([0.0, 1.9, 0.0])))
    assert not verdict.accepted
    assert 'overlap' in verdict.reason


@pytest.mark.parametrize('bounds', [(1e-6, 0.1), (0.5, 1e6)])
def test_a_scale_out_of_its_bounds_is_rejected_however_well_it_fits(bounds):
    config = replaced(CONFIG, {'scale.scale_min': bounds[0], 'scale.scale_max': bounds[1]})
    view = view_of(ROOM, config)
    verdict = judged(view, normal(TRUTH, view))
    assert not verdict.accepted
    assert 'scale.scale_min' in verdict.reason
    assert f'{TRUTH.scale:.4g}' in verdict.reason


@pytest.mark.parametrize(
    'threshold',
    [{'min_planes': 999.0}, {'min_margin': 100.0}, {'max_scale_ratio': 0.0}, {'max_mirrored': 0.0}],
    ids=lambda threshold: next(iter(threshold)),
)
def test_each_threshold_can_reject(threshold):
    config = replaced(CONFIG, {f'verification.{name}': value for name, value in threshold.items()})
    view = view_of(ROOM, config)
    assert not judged(view, normal(TRUTH, view)).accepted


def test_the_same_clouds_and_seed_give_the_same_bits():
    first, second = view_of(ROOM), view_of(ROOM)
    assert judged(first, normal(TRUTH, first)) == judged(second, normal(TRUTH, second))


def test_a_winner_is_probed_once(seen):
    view, truth = seen
    refined, refine = [], view._refine

    def counted(transforms, *asked, **options):
        refined.append(len(transforms))
        return refine(transforms, *asked, **options)

    view._refine = counted
    best = view.measure(truth)
    assert view.judge(best).accepted
    first = sum(refined)
    view.measured += map(view.measure, wrong_ones(2))
    again = view.judge(best)
    assert sum(refined) - first <= 4  # the two that are new, wide and fine
    fresh = view_of(ROOM)
    fresh.measured += map(fresh.measure, wrong_ones(2))
    assert fresh.judge(best) == again
