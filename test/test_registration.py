"""The whole registration: known truth, invariances, honesty about what cannot be registered, wrong input."""

import dataclasses
import functools
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from scenes import ball, box, cylinder, error, radius, random_rotation, random_similarity, rectangle, room

from csgm_ros import profile, register
from csgm_ros.attempts import Attempt, Ranked, best_of
from csgm_ros.config import replaced
from csgm_ros.errors import Cancelled, DegenerateCloudError, InputError
from csgm_ros.io.cloud_file import CloudFile
from csgm_ros.io.results import fused
from csgm_ros.progress import STAGES
from csgm_ros.registration import warm_up
from csgm_ros.types import Prior, Similarity

ROOT = Path(__file__).parents[1]
SOURCE, TARGET = room(1, 400), room(2, 400)
TRUTH = random_similarity(np.random.default_rng(11), (0.3, 0.4), 10.0)
RIGHT, SAME = 0.01, 0.01  # of the radius: RMS displacement from the truth, and between runs that should agree
RIGID = replaced(profile(), {'scale.estimate_scale': False})
# larger supervoxels and one more attempt only: clouds that nothing fits cost all attempts
QUICK = replaced(
    profile(),
    {'supervoxels.seed_size': 0.35, 'hypotheses.relative_scales': (0.6,), 'preprocess.smoothing': (40,)},
)


@functools.cache
def registered(source=1, target=2, config=None):
    """The room registered with another sampling of it under TRUTH."""
    return register(room(source, 400), TRUTH.apply(room(target, 400)), config)


def assert_right(result, truth, source, bound=RIGHT):
    assert result.accepted, result.reason
    assert error(result.transform, truth, source) < bound


def moved(result, transform):
    return dataclasses.replace(result, transform=transform)


def assert_agree(first, second, bound=SAME):
    """Two results for the same clouds: same verdict, same transform."""
    assert first.accepted == second.accepted
    assert error(first.transform, second.transform, SOURCE) < bound


# ---- known truth


@pytest.mark.parametrize('seed', range(4))
def test_recovers_a_similarity_about_any_axis_far_away_and_at_any_scale(seed):
    truth = random_similarity(np.random.default_rng([seed, 1]), ((0.05, 0.1), (10, 20), (0.3, 3), (1, 1.001))[seed])
    assert_right(register(SOURCE, truth.apply(TARGET)), truth, SOURCE)


def test_recovers_a_part_of_the_scene_in_the_whole():
    part = TARGET[TARGET[:, 0] < 2.0]
    assert_right(register(part, TRUTH.apply(SOURCE)), TRUTH, part)


def test_uniform_outliers_around_the_source_does_not_mislead():
    rng = np.random.default_rng(6)
    outliers = rng.uniform(SOURCE.min(0), SOURCE.max(0), (len(SOURCE), 3))
    assert_right(register(np.concatenate([SOURCE, outliers]), TRUTH.apply(TARGET)), TRUTH, SOURCE)


def test_a_source_with_one_of_twenty_points_is_right():
    thin = np.random.default_rng(7).permutation(SOURCE)[: len(SOURCE) // 20]
    # whether it is also accepted is a close call: sparse surfaces tell the room less well from itself turned
    assert error(register(thin, TRUTH.apply(TARGET)).transform, TRUTH, SOURCE) < 0.03


def attempts(config):
    """How often the structure was extracted for a registration, and its result."""
    heard = []
    result = register(SOURCE, TRUTH.apply(TARGET), config, on_progress=lambda *call: heard.append(call))
    return len({fraction for stage, fraction in heard if stage == 'structure extraction'}), result


def test_other_lengths_are_tried_while_nothing_is_accepted():
    once, certain = attempts(profile())
    thrice, doubted = attempts(replaced(profile(), {'verification.min_margin': 100.0}))
    assert (once, thrice) == (1, 3)
    assert_right(certain, TRUTH, SOURCE)
    assert not doubted.accepted
    assert error(doubted.transform, certain.transform, SOURCE) < RIGHT


def test_the_accepted_result_is_the_best_then_the_likeliest():
    one = registered()
    rejected = dataclasses.replace(one, verdict=dataclasses.replace(one.verdict, accepted=False))
    likely = dataclasses.replace(rejected)
    assert best_of([Ranked(likely, 9.0), Ranked(one, 0.0), Ranked(rejected, 2.0)]) is one
    assert best_of([Ranked(rejected, 2.0), Ranked(likely, 9.0)]) is likely


def test_the_result_tells_what_it_found():
    result = registered()
    assert_right(result, TRUTH, SOURCE)
    assert result.scale == pytest.approx(TRUTH.scale, rel=0.01)
    np.testing.assert_array_equal(result.T_target_source, result.transform.matrix)
    assert 0.5 < min(result.fitness_source, result.fitness_target) <= 1.0
    assert result.verdict.margin > profile().verification.min_margin
    assert 0.0 < result.verdict.inlier_rmse < 0.03 * radius(TRUTH.apply(SOURCE))
    assert result.seed == 0
    assert result.config == profile()
    assert set(result.timings) == set(STAGES)
    assert result.seconds > 0.0


def test_graphs_and_matches_are_in_the_clouds_own_units():
    result = registered()
    for graph, cloud in ((result.source_graph, SOURCE), (result.target_graph, TRUTH.apply(TARGET))):
        assert np.linalg.norm(graph.nodes - cloud.mean(0), axis=1).max() < radius(cloud) * 1.01
        assert graph.edges.max() < len(graph.nodes)
    i, a = result.matches[result.match_inliers].T
    offsets = TRUTH.apply(result.source_graph.nodes[i]) - result.target_graph.nodes[a]
    assert len(i) >= 3
    assert np.linalg.norm(offsets, axis=1).max() < 0.15 * radius(TRUTH.apply(SOURCE))


def test_the_papers_profile_is_right_or_rejected():
    result = registered(config=profile('paper'))
    assert not result.accepted or error(result.transform, TRUTH, SOURCE) < 0.05
    assert result.config.profile == 'paper'


# ---- invariances


@pytest.mark.parametrize('side', ['source', 'target'])
def test_pose_and_unit_of_either_cloud_do_not_matter(side):
    pose = random_similarity(np.random.default_rng(5), (0.05, 20.0), 100.0)
    clouds = {'source': SOURCE, 'target': TRUTH.apply(TARGET)}
    clouds[side] = pose.apply(clouds[side])
    result = register(**clouds)
    back = result.transform @ pose if side == 'source' else pose.inverse() @ result.transform
    assert result.accepted == registered().accepted
    assert error(back, registered().transform, SOURCE) < SAME


def test_map_coordinates_change_neither_the_verdict_nor_the_transform():
    """UTM: a double there is good to a nanometre, a float to half a metre."""
    first, second = (
        Similarity(1.0, np.eye(3), np.array(place)) for place in ((5e5, 4e6, 120.0), (665e3, 5.648e6, 300.0))
    )
    source = first.apply(SOURCE)
    result = register(source, second.apply(TRUTH.apply(TARGET)))
    back = second.inverse() @ result.transform @ first
    assert result.accepted
    assert result.verdict.margin == pytest.approx(registered().verdict.margin, rel=1e-6)
    assert np.abs(back.apply(SOURCE) - registered().transform.apply(SOURCE)).max() < 1e-6
    joined = fused(CloudFile(source, None), CloudFile(second.apply(TARGET), None), result.transform)
    moved = second.inverse().apply(joined.points[len(TARGET) :])
    assert np.abs(moved - registered().transform.apply(SOURCE)).max() < 1e-6


def test_the_order_of_the_points_does_not_matter():
    rng = np.random.default_rng(0)
    assert_agree(register(rng.permutation(SOURCE), rng.permutation(TRUTH.apply(TARGET))), registered())


def test_both_clouds_in_another_unit_give_the_same():
    result = register(1000.0 * SOURCE, 1000.0 * TRUTH.apply(TARGET))
    found = result.transform
    assert_agree(registered(), moved(result, Similarity(found.scale, found.rotation, found.translation / 1000.0)))


def test_exchanged_clouds_give_the_inverse_and_the_same_verdict():
    forth = register(SOURCE, TRUTH.apply(TARGET), details=True)
    back = register(TRUTH.apply(TARGET), SOURCE, details=True)
    assert_right(forth, TRUTH, SOURCE)
    there, here = (back.transform @ forth.transform).apply(SOURCE), SOURCE
    np.testing.assert_allclose(there, here, atol=1e-12 * radius(SOURCE))
    assert back.verdict.terms == forth.verdict.terms
    assert back.reason == forth.reason
    assert (back.fitness_source, back.fitness_target) == (forth.fitness_target, forth.fitness_source)
    assert back.verdict.inlier_rmse * forth.scale == pytest.approx(forth.verdict.inlier_rmse)
    for one, other in ((forth.matches, back.matches), (forth.unguided_matches, back.unguided_matches)):
        np.testing.assert_array_equal(one, np.array(sorted(other[:, ::-1].tolist())))
    assert len(back.match_inliers) == len(back.matches)
    np.testing.assert_array_equal(back.source_graph.nodes, forth.target_graph.nodes)
    assert len(back.details.structures[0].nodes) == len(back.source_graph.nodes)
    assert back.details.match_distance * forth.scale == pytest.approx(forth.details.match_distance)
    best = back.details.hypotheses[0]
    assert (best.fitness_source, best.fitness_target) == (back.fitness_source, back.fitness_target)
    np.testing.assert_allclose(best.transform.matrix, back.T_target_source)


def test_exchanged_clouds_keep_to_exchanged_bounds_and_viewpoints():
    """Whichever is searched in the other order, the scales and the sensors are those of who asked."""
    clouds, eye = (SOURCE, TRUTH.apply(TARGET)), SOURCE.mean(0)
    forth, back = (
        replaced(QUICK, {'scale.prior': prior, 'scale.prior_factor': 1.1}) for prior in (TRUTH.scale, 1 / TRUTH.scale)
    )
    results = (
        register(*clouds, forth, source_viewpoint=eye),
        register(*clouds[::-1], back, target_viewpoint=eye),
    )
    for result, config in zip(results, (forth, back), strict=True):
        assert result.accepted, result.reason
        assert result.config == config
    assert results[0].verdict.terms == results[1].verdict.terms
    assert any('looked through' in term.name for term in results[0].verdict.terms)


@pytest.mark.parametrize('name', ['source', 'target'])
def test_the_cloud_that_has_no_structure_is_named_in_either_order(name):
    dust = np.random.default_rng(0).uniform(size=(60, 3))
    with pytest.raises(InputError, match=f'^{name}: '):
        register(**{'source': SOURCE, 'target': SOURCE, name: dust})


def test_rows_that_are_not_finite_are_ignored():
    rng = np.random.default_rng(0)
    bad = np.full((600, 3), np.nan)
    bad[:300] = np.inf
    bad[300:, 0] = 1.0
    mixed = np.insert(SOURCE, np.sort(rng.integers(0, len(SOURCE), 600)), bad, axis=0)
    result = register(mixed, TRUTH.apply(TARGET))
    assert result.T_target_source.tobytes() == registered().T_target_source.tobytes()


def test_the_type_of_the_numbers_does_not_matter():
    result = register(SOURCE.astype(np.float32), TRUTH.apply(TARGET).astype(np.float32))
    assert_agree(result, registered())
    assert result.verdict.margin == pytest.approx(registered().verdict.margin, rel=0.05)


def test_duplicates_do_not_move_the_transform():
    result = register(np.repeat(SOURCE, 3, axis=0), TRUTH.apply(TARGET))
    assert error(result.transform, registered().transform, SOURCE) < SAME


def test_the_input_is_left_alone():
    source, target = SOURCE.copy(), TRUTH.apply(TARGET)
    before = target.copy()
    source.setflags(write=False)
    target.setflags(write=False)
    register(source, target)
    np.testing.assert_array_equal(target, before)


# ---- determinism


@pytest.mark.parametrize('threads', [1, 2, 5])
def test_the_number_of_threads_does_not_change_a_bit(threads):
    result = register(SOURCE, TRUTH.apply(TARGET), replaced(profile(), {'threads': threads}))
    assert result.T_target_source.tobytes() == registered().T_target_source.tobytes()
    assert result.verdict == registered().verdict
    np.testing.assert_array_equal(result.matches, registered().matches)


def test_another_process_with_one_core_gives_the_same_bits():
    code = (
        'from test_registration import registered\n'
        'import sys; sys.stdout.write(registered().T_target_source.tobytes().hex())'
    )
    paths = os.pathsep.join([str(ROOT), str(ROOT / 'test')])
    one = {'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1', 'NUMBA_NUM_THREADS': '1'}
    run = subprocess.run(
        [sys.executable, '-c', code],
        env={**os.environ, **one, 'PYTHONPATH': paths},
        capture_output=True,
        text=True,
        check=True,
    )
    assert run.stdout == registered().T_target_source.tobytes().hex()


def test_another_seed_is_right_too_and_ends_in_the_same_transform():
    result = register(SOURCE, TRUTH.apply(TARGET), seed=7)
    assert_right(result, TRUTH, SOURCE)
    assert error(result.transform, registered().transform, SOURCE) < SAME / 100.0
    assert result.seed == 7


# ---- rigid mode and bounds of the scale


def test_rigid_mode_gives_scale_exactly_one():
    truth = Similarity(1.0, random_rotation(np.random.default_rng(2)), np.array([50.0, -3.0, 7.0]))
    result = register(SOURCE, truth.apply(TARGET), RIGID)
    assert_right(result, truth, SOURCE)
    assert result.scale == 1.0


def test_rigid_mode_rejects_what_differs_by_a_scale():
    assert not register(SOURCE, TRUTH.apply(TARGET), RIGID).accepted


@pytest.mark.parametrize(('low', 'high', 'inside'), [(0.9, 1.05, True), (1.08, 3.0, False), (0.3, 0.95, False)])
def test_an_accepted_scale_lies_in_its_bounds(low, high, inside):
    result = register(SOURCE, TARGET, replaced(QUICK, {'scale.scale_min': low, 'scale.scale_max': high}))
    assert result.accepted == inside, result.reason
    assert not result.accepted or low <= result.scale <= high


# ---- progress, cancellation, time


def test_progress_goes_through_the_stages_to_the_end():
    heard = []
    register(SOURCE, TARGET, on_progress=lambda *call: heard.append(call))
    stages = list(dict.fromkeys(stage for stage, _ in heard))
    fractions = [fraction for _, fraction in heard]
    assert stages == [*STAGES, 'done']
    assert fractions == sorted(fractions)
    assert fractions[0] == 0.0
    assert heard[-1] == ('done', 1.0)
    assert 1.0 not in fractions[:-1]


@pytest.mark.parametrize('stage', STAGES)
def test_whatever_progress_raises_ends_the_registration_at_once(stage):
    heard = []

    def on_progress(running, fraction):
        heard.append(running)
        if running == stage:
            raise Cancelled(f'in {running}')

    with pytest.raises(Cancelled, match=stage):
        register(SOURCE, TARGET, on_progress=on_progress)
    assert heard.count(stage) == 1
    assert heard[-1] == stage


@pytest.mark.parametrize('budget', [1e-6, 0.1, 0.3, 0.7, 1.5])
@pytest.mark.parametrize('name', ['room', 'fog'])
def test_a_time_budget_holds_at_any_stage(name, budget, monkeypatch):
    """In seconds of CPU of one thread; other programs slow them all the same, so more is allowed than promised."""
    monkeypatch.setattr('csgm_ros.progress.time.perf_counter', time.process_time)
    clouds = (SOURCE, TRUTH.apply(TARGET)) if name == 'room' else (shape('fog', 0), shape('fog', 1))
    warm_up()  # what is loaded once a process
    pytest.importorskip('open3d')  # and the library of the last refinement, by whichever test comes first
    start = time.process_time()
    result = register(*clouds, replaced(profile(), {'time_budget': budget, 'threads': 1}))
    assert time.process_time() - start < budget + 0.9
    assert result.accepted == ('time budget' not in result.reason and name == 'room'), result.reason
    assert not result.accepted or error(result.transform, TRUTH, SOURCE) < RIGHT


# ---- what cannot be registered


def shape(name, seed):
    rng = np.random.default_rng(seed)
    return {
        'plane': lambda: rectangle(rng, (0, 0, 0), (2, 0, 0), (0, 1.3, 0), 4000),
        'sphere': lambda: ball(rng, (0, 0, 0), 1.0, 500),
        'cuboid': lambda: box(rng, (0, 0, 0), (1, 2, 3), 300),
        'cylinder': lambda: cylinder(rng, (0, 0, 0), 0.5, 2.0, 800),
        'fog': lambda: rng.normal(size=(4000, 3)),
    }[name]()


@pytest.mark.parametrize('name', ['plane', 'sphere', 'cuboid', 'cylinder', 'fog'])
def test_shapes_that_fit_in_many_ways_or_in_none_are_rejected(name):
    pose = random_similarity(np.random.default_rng(4), (0.5, 2.0), 5.0)
    result = register(shape(name, 0), pose.apply(shape(name, 1)), QUICK)
    assert not result.accepted
    assert any(cause in result.reason for cause in ('ambiguous', 'overlap', 'no hypothesis'))


@pytest.mark.parametrize('name', ['plane', 'sphere', 'cuboid', 'cylinder'])
def test_a_symmetric_cloud_and_its_exact_copy_are_rejected_or_exactly_right(name):
    cloud = shape(name, 0)
    result = register(cloud, cloud, QUICK)
    assert not result.accepted or error(result.transform, Similarity.identity(), cloud) < 1e-6


@pytest.mark.parametrize('name', ['sphere', 'cuboid'])
def test_a_room_is_not_mistaken_for_a_shape(name):
    assert not register(SOURCE, shape(name, 0), QUICK).accepted


def test_unrelated_shapes_are_rejected():
    assert not register(shape('cuboid', 0), shape('cylinder', 1), QUICK).accepted


def test_an_icp_that_shrinks_the_source_onto_a_few_points_is_no_answer():
    rng = np.random.default_rng(0)
    ball, (x, y) = rng.normal(size=(4000, 3)), rng.uniform(-1, 1, (2, 4000))
    sheet = np.stack([x, y, 0.1 * np.sin(9 * x) * np.cos(7 * y)], axis=1)
    for kind in (np.float32, np.float64):  # of rounding errors, one lets it collapse
        result = register(ball.astype(kind), sheet.astype(kind))
        assert not result.accepted
        assert 1e-3 < result.scale < 1e3


def test_clouds_of_one_scene_without_overlap_are_rejected():
    left, right = SOURCE[SOURCE[:, 0] < 1.0], TARGET[TARGET[:, 0] > 1.4]
    assert not register(left, right).accepted


def test_a_cuboid_at_first_sight_is_not_accepted_either(monkeypatch):
    monkeypatch.setattr('csgm_ros.registration.schedule', lambda *_: [Attempt()])
    assert not register(shape('cuboid', 0), shape('cuboid', 1), QUICK).accepted


# ---- a prior

LITTLE = replaced(QUICK, {'hypotheses.sources': ('graph',), 'hypotheses.trials': 200000, 'matching.search_effort': 1.0})
AXIS_TURN = Similarity.from_quaternion(np.array([0.0, 0.0, 1.0, 1.0]), np.zeros(3))


def near(transform, seed=0, sigma=(0.02, 3.0, 0.02)):
    """A transform off by about one sigma, and the prior of it."""
    rng = np.random.default_rng(seed)
    turn = Similarity.from_quaternion(np.append(np.radians(sigma[1]) / 2 * rng.normal(size=3), 1.0), np.zeros(3))
    shifted = Similarity(
        transform.scale * (1 + sigma[2]), transform.rotation @ turn.rotation, transform.translation + sigma[0] / 2
    )
    return Prior(shifted, sigma)


def test_a_prior_leads_to_the_same_answer():
    target = TRUTH.apply(TARGET)
    assert_right(register(SOURCE, target, LITTLE, prior=near(TRUTH)), TRUTH, SOURCE)


WRONG_PRIORS = {
    'turned': TRUTH @ AXIS_TURN,
    'shifted': Similarity(TRUTH.scale, TRUTH.rotation, TRUTH.translation + 0.5 * radius(TRUTH.apply(TARGET))),
    'of another scale': Similarity(1.5 * TRUTH.scale, TRUTH.rotation, TRUTH.translation),
}


@pytest.mark.parametrize('name', WRONG_PRIORS)
def test_a_wrong_prior_leads_to_no_answer_however_sure_it_is(name):
    prior = Prior(WRONG_PRIORS[name], (0.02 * radius(TARGET) * TRUTH.scale, 3.0, 0.02))
    result = register(SOURCE, TRUTH.apply(TARGET), LITTLE, prior=prior)
    assert not result.accepted, result.reason


def test_a_prior_does_not_decide_between_transforms_that_fit_as_well():
    source, target = shape('cuboid', 0), shape('cuboid', 1)
    assert not register(source, target, LITTLE, prior=near(Similarity.identity())).accepted


@pytest.mark.parametrize(
    ('prior', 'says'),
    [
        (Prior(TRUTH, (1.0, 2.0)), 'sigma'),
        (Prior(TRUTH, (-1.0, 2.0, 0.1)), 'sigma'),
        (Prior(Similarity(np.nan, np.eye(3), np.zeros(3)), (1.0, 1.0, 1.0)), 'similarity'),
        (Prior(Similarity(1e9, np.eye(3), np.zeros(3)), (1.0, 1.0, 0.1)), 'scale'),
    ],
)
def test_what_is_no_prior_is_refused(prior, says):
    with pytest.raises(InputError, match=f'prior.*{says}'):
        register(SOURCE, TARGET, prior=prior)


# ---- wrong and extreme input

WRONG = {
    'empty': np.empty((0, 3)),
    'three points': SOURCE[:3],
    'only NaN': np.full((100, 3), np.nan),
    'one place': np.ones((100, 3)),
    'a line': np.outer(np.linspace(0, 1, 1000), (1.0, 2.0, 3.0)),
    'two columns': SOURCE[:, :2],
    'text': SOURCE.astype(str),
    'nothing': None,
    'too large': SOURCE * 1e200,
    'too sparse': SOURCE[:60],
    'outlier far away': np.concatenate([SOURCE[:60], [[1e3, 0.0, 0.0]]]),
}


@pytest.mark.parametrize('side', ['source', 'target'])
@pytest.mark.parametrize('case', WRONG)
def test_wrong_input_is_an_error_that_names_the_cloud(case, side):
    clouds = {'source': SOURCE, 'target': TARGET, side: WRONG[case]}
    with pytest.raises(InputError, match=f'^{side}: '):
        register(**clouds)


@pytest.mark.parametrize('count', [60, 150, 200, 300, 500])
def test_few_points_are_right_or_rejected_or_refused(count):
    for seed in (1, 3):
        source, target = room(seed, 400)[:count], room(seed + 1, 400)[:count]
        try:
            result = register(source, target, QUICK)
        except DegenerateCloudError:
            continue
        assert not result.accepted or error(result.transform, Similarity.identity(), source) < 0.05


@pytest.mark.parametrize('offset', [1e6, 1e9])
def test_coordinates_far_from_the_origin_are_no_trouble(offset):
    away = Similarity(1.0, np.eye(3), np.full(3, offset))
    truth = away.inverse() @ TRUTH @ away.inverse()
    assert_right(register(away.apply(SOURCE), away.inverse().apply(TRUTH.apply(TARGET))), truth, away.apply(SOURCE))


@pytest.mark.parametrize(('source', 'target'), [(1e-6, 1e-6), (1e6, 1e6), (1.0, 3e-6), (1e5, 1.0), (1e30, 1e30)])
def test_extreme_units_are_no_trouble(source, target):
    truth = Similarity(target / source, np.eye(3), np.zeros(3))
    assert_right(register(source * SOURCE, target * TARGET), truth, source * SOURCE)


@pytest.mark.parametrize('factor', [1e-9, 1e9])
def test_a_scale_beyond_the_bounds_is_rejected(factor):
    assert not register(SOURCE, factor * TARGET, QUICK).accepted


@pytest.mark.parametrize('outlier', [10.0, 1e3, 1e9])
def test_one_outlier_point_is_survived_or_rejected_or_refused(outlier):
    source = np.concatenate([SOURCE, np.full((1, 3), outlier)])
    try:
        result = register(source, TARGET, QUICK)
    except DegenerateCloudError:
        return
    assert not result.accepted or error(result.transform, Similarity.identity(), SOURCE) < RIGHT


def test_a_few_outliers_nearby_do_not_matter():
    outliers = np.random.default_rng(0).normal(scale=4.0, size=(30, 3))
    assert_right(register(np.concatenate([SOURCE, outliers]), TARGET), Similarity.identity(), SOURCE)


def test_warming_up_compiles_all_that_a_registration_needs():
    code = """
import gc
from numba.core.dispatcher import Dispatcher
from test_registration import SOURCE, TARGET, TRUTH, profile, register, replaced
from csgm_ros.registration import warm_up

def kernels():
    return {kernel: len(kernel.overloads) for kernel in gc.get_objects() if isinstance(kernel, Dispatcher)}

warm_up()
before = kernels()
register(SOURCE, TRUTH.apply(TARGET), replaced(profile(), {'verification.min_margin': 100.0, 'time_budget': 20.0}))
print([k.py_func.__qualname__ for k, count in kernels().items() if count > before.get(k, 0)])
"""
    paths = os.pathsep.join([str(ROOT), str(ROOT / 'test')])
    run = subprocess.run(
        [sys.executable, '-c', code],
        env={**os.environ, 'PYTHONPATH': paths},
        capture_output=True,
        text=True,
        check=True,
    )
    assert run.stdout.strip() == '[]'
