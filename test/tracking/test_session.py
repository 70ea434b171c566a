"""A session on real frames and on what is no frame; the parts of it on surfaces whose truth is exact."""

from concurrent.futures import Future

import numpy as np
import pytest
from sequences import Sequence

from csgm_ros import Session
from csgm_ros.config import profile, replaced
from csgm_ros.errors import InputError
from csgm_ros.tracking import frames, maps, recheck, scale, settling, surface, views
from csgm_ros.tracking.alignment import align
from csgm_ros.tracking.evidence import Evidence
from csgm_ros.tracking.localization import moved, scale_of, scaling, vertex
from csgm_ros.tracking.odometry import Odometry, power
from csgm_ros.tracking.search import Found, Query, expected
from csgm_ros.tracking.session import ASTRAY


class Never:
    """Searches for nothing: whoever asked is told the result by the test. A place is checked at once."""

    def submit(self, work, *inputs):
        future = Future()
        if work is recheck.recheck:
            future.set_result(work(*inputs))
        return future


def corner(rng, count=6000):
    """Three walls, a step and a ball: (N, 3) metres, the viewpoint at the origin, z forward."""
    a, b = rng.uniform(-1, 1, (2, count))
    walls = [np.stack(w, 1) for w in ((a, b, 0 * a + 2.4), (0 * a - 1, a, b + 1.4), (a, 0 * a + 1, b + 1.4))]
    ball = rng.normal(size=(count // 3, 3))
    ball = np.array([0.3, 0.4, 1.7]) + 0.3 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    box = np.stack((0.3 * a - 0.4, 0.3 * b - 0.3, 0 * a + 1.9), 1)
    return np.concatenate([*walls, ball, box])


def motion(angles, shift):
    from scipy.spatial.transform import Rotation

    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler('xyz', angles, degrees=True).as_matrix()
    matrix[:3, 3] = shift
    return matrix


@pytest.mark.parametrize('scale', [1.0, 0.07, 30.0])
def test_alignment_finds_a_known_rigid_motion_and_keeps_the_scale(scale):
    rng = np.random.default_rng(0)
    frame = frames.prepared(corner(rng), 0.03)
    own = surface.build(frame.points, frame.normals, 0.12)
    truth = motion((2.0, -3.0, 1.5), (0.03, -0.02, 0.04)) @ np.diag((1 / scale,) * 3 + (1.0,))
    points = moved(np.linalg.inv(truth), corner(rng))
    start = motion((0, 0, 0), (0, 0, 0)) @ np.diag((1 / scale,) * 3 + (1.0,))
    fit = align(points[::5], None, own, start, (0.12, 0.05), iterations=30)
    assert np.allclose(fit.matrix, truth, atol=4e-3)
    assert np.cbrt(np.linalg.det(fit.matrix[:3, :3])) == pytest.approx(1 / scale, rel=1e-9)


def test_a_view_tells_what_is_on_before_and_behind_a_surface():
    rng = np.random.default_rng(0)
    wall = np.column_stack((rng.uniform(-1, 1, (40000, 2)), np.full(40000, 2.0)))
    probes = np.array([(0.1, 0.2, 2.0), (0.1, 0.2, 1.0), (0.1, 0.2, 3.0), (0.0, 0.0, -2.0)])
    assert views.seen(probes, np.eye(4), views.look(wall), 0.04).tolist() == [1, -1, 0, 0]


def test_odometry_follows_a_known_walk():
    rng = np.random.default_rng(1)
    odometry = Odometry(0.03, np.random.default_rng(0))
    step, pose = motion((1.5, 4.0, -2.0), (0.03, 0.01, -0.04)), np.eye(4)
    for k in range(6):
        assert odometry.add(frames.prepared(moved(np.linalg.inv(pose), corner(rng)), 0.03), 0.1 * k)
        assert np.allclose(odometry.matrix, pose, atol=0.02)
        pose = pose @ step


def test_odometry_refuses_what_shows_another_place():
    rng = np.random.default_rng(2)
    odometry = Odometry(0.03, np.random.default_rng(0))
    odometry.add(frames.prepared(corner(rng), 0.03), 0.0)
    before = odometry.matrix.copy()
    elsewhere = rng.normal(size=(6000, 3)) * 0.4 + np.array([3.0, -2.0, 6.0])
    assert not odometry.add(frames.prepared(elsewhere, 0.03), 0.1)
    assert np.array_equal(odometry.matrix, before)


def test_odometry_refuses_a_leap_to_a_view_that_looks_alike(kitchen):
    """From one stretch of cupboards to the next, whose planes the frame fits a little."""
    odometry = Odometry(0.03, np.random.default_rng(0))
    for k in range(56, 63):
        assert odometry.add(frames.prepared(kitchen.points(k), 0.03), kitchen.stamps[k])
    assert odometry.quality > 0.7
    assert not odometry.add(frames.prepared(kitchen.points(90), 0.03), kitchen.stamps[62] + 0.12)


def test_a_motion_carried_on_twice_is_the_motion_twice():
    step = motion((3.0, 0.0, 0.0), (0.1, 0.0, 0.0))
    assert np.allclose(power(step, 2.0), step @ step, atol=1e-12)
    assert np.allclose(power(step, 0.0), np.eye(4))


@pytest.fixture(scope='module')
def kitchen(shared):
    return Sequence(shared / 'data' / 'sequence_kitchen')


def test_a_walk_is_localised_tracked_interrupted_and_found_again(kitchen):
    session = Session(kitchen.map)
    estimates = {}
    for k in (*range(24), 75, 76, 82, *range(86, 110)):  # 75 to 85 are blocked
        estimates[k] = session.add(kitchen.points(k), kitchen.stamps[k])
        given = estimates[k].T_map_sensor
        assert (given is not None) == (estimates[k].state == 'tracking')
        assert given is None or kitchen.right(k, given)
    states = {k: estimate.state for k, estimate in estimates.items()}
    assert states[0] == 'lost'
    assert states[23] == states[109] == 'tracking'
    assert 'tracking' not in (states[75], states[76], states[82], states[86])
    assert 'points' in estimates[82].reason
    sigma = np.sqrt(np.diag(estimates[23].covariance))
    assert (sigma > 0).all()
    assert (sigma < 0.2).all()


def test_a_scale_that_is_off_is_corrected_without_a_jump(kitchen):
    factor = 1.04
    session = Session(kitchen.map, executor=Never())
    true = scale_of(kitchen.truth[0])
    for k in range(45):
        before = session.scale
        estimate = session.add(kitchen.points(k), kitchen.stamps[k])
        if k == 10:  # as if a search had ended
            sensor = session._odometry.matrix
            place = kitchen.truth[k] @ np.linalg.inv(sensor) @ scaling(factor, sensor[:3, 3])
            session._job.future.set_result(Found(place, 'told'))
        if estimate.T_map_sensor is not None:
            assert scale_of(estimate.T_map_sensor) == pytest.approx(session.scale)
            assert kitchen.right(k, estimate.T_map_sensor)
            assert np.isnan(before) or abs(session.scale / before - 1) < 0.005
    assert abs(session.scale / true - 1) < 0.75 * abs(factor - 1)
    assert estimate.scale_sigma < 0.02


def told(sequence, numbers, factor=1.0, executor=None):
    """Follow from the true pose, at a scale that is off by a factor, as if a search had ended."""
    config = replaced(profile(), {'tracking.first_seconds': 0.3})
    session, first = Session(sequence.map, config, executor=executor or Never()), None
    for k in numbers:
        estimate = session.add(sequence.points(k), sequence.stamps[k])
        if first is None and session._job is not None:
            first, sensor = k, session._odometry.matrix
            place = sequence.truth[k] @ np.linalg.inv(sensor) @ scaling(factor, sensor[:3, 3])
            session._job.future.set_result(Found(place, 'told'))
        yield k, session, estimate


@pytest.fixture(scope='module')
def desk(shared):
    return Sequence(shared / 'data' / 'sequence_desk')


def test_a_look_beside_the_map_does_not_move_the_place(desk):
    for k, _, estimate in told(desk, range(3, 22)):  # 13 to 18 are off the map
        given = estimate.T_map_sensor
        assert given is None or not 14 <= k <= 17
        if given is not None and k > 18:
            angle, shift, _ = desk.errors(k, given)
            assert angle < 10
            assert shift < 0.2
    assert given is not None


def test_a_pose_is_given_out_only_where_frames_fit_as_well_as_what_was_found(desk):
    """The odometry may have slipped while it was searched: what it leads to is beside the truth."""
    config = replaced(profile(), {'tracking.first_seconds': 0.3})
    session, slipped = Session(desk.map, config, executor=Never()), motion((0.0, 30.0, 0.0), (0.1, 0.0, 0.0))
    for k in range(115, 122):
        estimate = session.add(desk.points(k), desk.stamps[k])
        if k == 118:
            sensor = session._odometry.matrix
            place = desk.truth[k] @ slipped @ np.linalg.inv(sensor)
            session._job.future.set_result(Found(place, 'told', Evidence(0.2, 0.7, 0.92, 3000)))
        assert estimate.T_map_sensor is None or desk.errors(k, estimate.T_map_sensor)[0] < 10


def test_a_place_that_was_found_where_the_map_is_worse_is_confirmed_by_what_it_was_found_by(kitchen):
    session = Session(kitchen.map)
    session._typical = np.array((0.5, 0.8, 0.9))
    seen = [Evidence(closeness, 0.6, 0.9, 3000) for closeness in (0.32, 0.2, 0.1)]
    for found, confirms in ((None, [1, 0, 0]), (0.6, [1, 0, 0]), (0.3, [1, 1, 0])):
        session._settle_at(np.eye(4), found and Evidence(found, 0.6, 0.9, 3000), 'told')
        assert [session._confirms(evidence) for evidence in seen] == confirms


@pytest.mark.parametrize('factor', [0.8, 0.92, 1.08, 1.25])
def test_a_noisy_map_pulls_the_scale_that_a_search_found_to_neither_side(desk, factor):
    *_, (k, session, _) = told(desk, range(115, 135))
    true, sensor = desk.truth[k], session._odometry.matrix
    middle = (desk.points(k) @ sensor[:3, :3].T + sensor[:3, 3]).mean(axis=0)
    place = true @ np.linalg.inv(sensor) @ scaling(factor, middle)
    seen = [(frame, matrix) for _, frame, matrix in session._recent]
    found = settling.best_scale(seen, session._voxel, session._map, place, np.random.default_rng(0))
    assert abs(np.log(found / scale_of(true))) < 0.03


@pytest.mark.parametrize('beside', [motion((0, 0, 30), (0, 0.2, 0)), motion((0, 0, 60), (0, 0, 0))])
def test_a_place_that_was_found_beside_the_right_one_is_left_for_it(desk, beside):
    """As where a single frame fits as well: tracked on from there it would stay beside."""
    session, shifts = Session(desk.map, executor=Never()), {}
    for k in range(115, 135):
        pose = session.add(desk.points(k), desk.stamps[k]).T_map_sensor
        if pose is not None:
            shifts[k] = desk.errors(k, pose)[1]
        if session._job is not None and session._found is None:
            matrix = desk.truth[k] @ beside @ np.linalg.inv(session._odometry.matrix)
            session._job.future.set_result(Found(matrix, 'told', Evidence(0.1, 0.5, 0.8, 3000)))
    first, last = min(shifts), max(shifts)
    assert shifts[first] > 0.15
    assert last == 134
    assert all(shifts[k] < 0.1 for k in shifts if k >= first + 4)


@pytest.mark.parametrize(('last', 'enough'), [(36, False), (38, False), (40, True)])
def test_frames_beside_the_map_do_not_lead_away_from_the_place(desk, last, enough):
    *_, (k, session, _) = told(desk, range(28, last + 1))  # 33 to 37 are beside the map, or nearly
    sensor = session._odometry.matrix
    seen = [(frame, matrix) for stamp, frame, matrix in session._recent if stamp >= desk.stamps[33]]
    place, prior = desk.truth[k] @ np.linalg.inv(sensor), expected(desk.truth[k], ASTRAY)
    query = Query(seen, session._voxel, scale_of(place), prior, sensor, (0.09, 0.74))
    for seed in range(6):
        second = recheck.elsewhere(query, session._map, place, np.random.default_rng(seed))
        assert second.matrix is None
        assert second.told is enough


class Asked(Never):
    """Keeps what is searched for, and has checks tell nothing."""

    def __init__(self):
        self.searches, self.checks = [], []

    def submit(self, work, *inputs):
        future = Future()
        if work is recheck.recheck:
            future.set_result(recheck.Second(told=False))
            self.checks.append(inputs[0])
        else:
            self.searches.append(inputs[0])
        return future


def test_a_place_of_which_a_check_tells_nothing_is_checked_again_soon_and_nothing_is_measured_by_it(kitchen):
    asked, enough = Asked(), []
    for _, session, estimate in told(kitchen, range(20), executor=asked):
        if estimate.state == 'tracking':
            enough.append(session._enough(2.0))
    assert len(enough) > 10
    assert len(set(enough)) == 1
    assert len(asked.checks) >= 3
    assert all(query.fresh for query in asked.checks)


def test_a_sensor_that_was_lost_is_looked_for_where_it_was_with_each_frame_and_then_anywhere(kitchen):
    asked = Asked()
    *_, (last, session, estimate) = told(kitchen, range(12), executor=asked)
    assert estimate.state == 'tracking'
    asked.searches.clear()
    for k in range(last + 1, last + 4):
        session.add(kitchen.points(k), kitchen.stamps[k] + 2.0)
        session._job.future.set_result(Found(None, 'told'))
    assert [(len(query.seen), query.wide) for query in asked.searches] == [(1, False), (2, False), (3, True)]
    least = [query.enough[1] for query in asked.searches]  # of fewer frames more must agree
    assert least[0] == least[1] > least[2]


def test_a_single_wall_does_not_tell_the_scale():
    rng = np.random.default_rng(0)
    side = rng.uniform(-1.0, 1.0, (2, 20000))
    wall = np.stack((*side, np.full(20000, 2.0)), axis=1)
    frame = frames.prepared(wall, 0.03)
    larger = maps.prepare_map(wall * (5.0, 5.0, 1.0) + rng.normal(scale=1e-3, size=wall.shape))
    seen = [(frame, np.eye(4))] * 5
    assert settling.best_scale(seen, 0.03, larger, np.eye(4), np.random.default_rng(0)) is None


def test_the_middle_of_what_is_nearly_best_counts_and_must_have_two_ends():
    steps = np.linspace(-0.2, 0.2, 21)
    for best in (-0.07, 0.0, 0.1):
        assert settling.middle(steps, 1.0 - 10.0 * (steps - best) ** 2) == pytest.approx(best, abs=0.002)
    for scores in (np.ones(21), np.zeros(21), 1.0 + steps, 1.0 - steps):
        assert settling.middle(steps, scores) is None


@pytest.mark.parametrize('factor', [0.96, 1.04])
def test_the_scale_is_found_while_poses_are_given_out(kitchen, factor):
    true = scale_of(kitchen.truth[0])
    *_, (_, session, estimate) = told(kitchen, range(40), factor)
    assert estimate.state == 'tracking'
    assert abs(np.log(session.scale / true)) < 0.6 * abs(np.log(factor))


def test_the_scale_is_where_three_scores_say_and_one_wall_says_nothing():
    step = 0.06
    steps = step * np.arange(-1, 2)
    for truth in (-0.8 * step, 0.0, 0.3 * step):
        assert vertex(steps, 1.0 - ((steps - truth) / step) ** 2) == pytest.approx(truth)
    assert vertex(steps, np.array((0.1, 0.5, 0.8))) is not None
    assert abs(vertex(steps, np.array((0.1, 0.5, 0.8)))) <= step
    for flat in ((0.5, 0.5, 0.5), (0.6, 0.5, 0.6), (0.0, 0.0, 0.0)):
        assert vertex(steps, np.array(flat)) is None


def test_a_scale_is_believed_the_more_the_longer_but_never_beyond_what_a_map_is_worth():
    known, true, steps = scale.Scale.found(2.0), 2.0 * np.exp(0.03), []
    for _ in range(400):
        before, known = known, known.told(true).followed()
        steps.append(np.log(known.value / before.value))
        assert scale.LEAST <= known.sigma <= before.sigma
    assert max(steps) < 1.001 * scale.LARGEST_STEP
    assert abs(np.log(known.value / true)) < scale.LEFT * scale.LEAST
    assert known.value * np.exp(known.ahead) == pytest.approx(true, rel=0.001)
    assert not scale.Scale().known


def test_a_scale_that_is_far_off_goes_in_short_steps_to_what_looks_made_believed():
    found = scale.Scale.found(2.0)
    known = found.told(2.2)
    believed = known.value * np.exp(known.ahead)
    assert found.unconfirmed
    assert not known.unconfirmed
    assert known.value == 2.0
    for _ in range(60):
        before, known = known, known.followed()
        assert 0.0 <= np.log(known.value / before.value) < 1.001 * scale.LARGEST_STEP
    assert known.value == pytest.approx(believed)
    assert not known.moving


def test_a_scale_that_is_off_by_little_for_its_sigma_is_left_alone():
    known = scale.Scale.found(2.0)
    for true in (2.01, 1.99, 2.01):
        known = known.told(true).followed()
        assert known.value == 2.0


@pytest.mark.parametrize(
    ('points', 'says'),
    [(np.zeros((5, 2)), r'\(N, 3\)'), (np.array([['a', 'b', 'c']]), 'frame'), (np.zeros(3), r'\(N, 3\)')],
)
def test_what_is_no_frame_is_refused_and_the_session_lives_on(points, says):
    session = Session(corner(np.random.default_rng(0)))
    with pytest.raises(InputError, match=says):
        session.add(points, 0.0)
    with pytest.raises(InputError, match='stamp'):
        session.add(corner(np.random.default_rng(0)), np.nan)
    assert session.add(np.full((10, 3), np.nan), 0.0).state == 'lost'


def test_a_prepared_map_survives_the_file(tmp_path):
    prepared = maps.prepare_map(corner(np.random.default_rng(0)))
    maps.save_map(tmp_path / 'map.npz', prepared)
    loaded = maps.load_map(tmp_path / 'map.npz')
    assert all(np.array_equal(a, b) for a, b in zip(prepared, loaded, strict=True))


def damaged(path, **changed):
    with np.load(path) as file:
        arrays = {**{name: file[name] for name in file.files}, **changed}
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})


@pytest.mark.parametrize(
    ('damage', 'says'),
    [
        (lambda path: path.write_bytes(path.read_bytes()[:100]), 'damaged'),
        (lambda path: path.unlink(), 'no such file'),
        (lambda path: damaged(path, csgm_map=99), 'version 99'),
        (lambda path: damaged(path, csgm_map=None), 'no prepared map'),
        (lambda path: damaged(path, normals=np.zeros((3, 3))), 'damaged'),
        (lambda path: damaged(path, voxel=-1.0), 'damaged'),
    ],
)
def test_a_file_that_is_no_sound_prepared_map_is_refused_with_the_remedy(tmp_path, damage, says):
    path = tmp_path / 'map.npz'
    maps.save_map(path, maps.prepare_map(corner(np.random.default_rng(0))))
    damage(path)
    with pytest.raises(InputError, match=says):
        maps.load_map(path)


def test_a_map_is_prepared_from_the_command_line(tmp_path, capsys):
    from csgm_ros.cli.main import main

    np.save(tmp_path / 'map.npy', corner(np.random.default_rng(0)))
    assert main(['prepare-map', str(tmp_path / 'map.npy'), '-o', str(tmp_path / 'map.npz')]) == 0
    assert len(maps.load_map(tmp_path / 'map.npz').points) > 1000
    assert main(['prepare-map', str(tmp_path / 'map.npy'), '-o', str(tmp_path / 'map.ply')]) == 2
    assert '.npz' in capsys.readouterr().err
