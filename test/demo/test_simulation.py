"""The simulated sensors: deterministic, true to the transform they tell, and as imperfect as they should be."""

import json

import numpy as np
import pytest
from scipy.spatial import cKDTree

from csgm_ros.demo.scene import NAMES, Room
from csgm_ros.demo.simulation import (
    kinect_frame,
    look_at,
    pixel_rays,
    random_similarity,
    recording,
    sfm_cloud,
    simulate,
    write_pair,
)
from csgm_ros.io.files import read_cloud
from csgm_ros.io.results import errors
from csgm_ros.types import Similarity

EYE, AT = np.array([1.4, -2.4, 1.7]), np.array([-0.1, 0.75, 0.75])
SIZE = 240, 320


@pytest.fixture(scope='module')
def pair():
    return simulate(5, height=SIZE[0], width=SIZE[1], sfm_points=15000)


@pytest.fixture(scope='module')
def room():
    return Room(np.random.default_rng(5))


def depth_of(room, seed):
    return kinect_frame(room, look_at(EYE, AT), np.random.default_rng(seed), *SIZE)[0][..., 2]


def true_hits(room):
    rays = pixel_rays(*SIZE)
    directions = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    pose = look_at(EYE, AT)
    hits = room.cast(np.broadcast_to(pose.translation, directions.shape), directions @ pose.rotation.T)
    return hits, (hits.distance * directions[:, 2]).reshape(SIZE)


def test_the_same_seed_gives_the_same_bits_and_another_seed_another_room(pair):
    again = simulate(5, height=SIZE[0], width=SIZE[1], sfm_points=15000)
    assert np.array_equal(again.source, pair.source)
    assert np.array_equal(again.target, pair.target, equal_nan=True)
    assert np.array_equal(again.truth.matrix, pair.truth.matrix)
    assert not np.allclose(simulate(6, height=24, width=32).truth.matrix, pair.truth.matrix)


def test_the_truth_lays_the_source_on_the_target(pair):
    seen = pair.target[np.isfinite(pair.target).all(axis=2)]
    distance = cKDTree(seen).query(pair.truth.apply(pair.source))[0]
    assert np.median(distance) < 0.03
    shifted = cKDTree(seen).query(pair.truth.apply(pair.source) + np.array([0, 0, 0.3]))[0]
    assert np.median(shifted) > 2 * np.median(distance)


def test_the_frame_is_organised_along_its_pixel_rays(pair):
    assert pair.target.shape == (*SIZE, 3)
    assert pair.target.dtype == np.float32
    rays = pixel_rays(*SIZE).reshape(*SIZE, 3)
    seen = np.isfinite(pair.target).all(axis=2)
    assert np.allclose(pair.target[seen], (rays * pair.target[..., 2:])[seen], atol=1e-5)
    assert 0.3 < seen.mean() < 0.95


def test_depth_noise_grows_with_the_range(room):
    _, truth = true_hits(room)
    noise = np.stack([depth_of(room, seed) for seed in range(6)]) - truth
    near, far = truth < 2.0, (truth > 3.2) & (truth < 4.5)
    spread = [np.nanstd(noise[:, where]) for where in (near, far)]
    assert 0.001 < spread[0] < 0.008
    assert spread[1] > 2.5 * spread[0]


def test_dark_and_grazing_surfaces_and_shadows_leave_holes(room):
    hits, _ = true_hits(room)
    lost = np.isnan(depth_of(room, 1)).ravel()
    screen = hits.material == NAMES.index('screen')
    front = hits.cosine > 0.5
    poster = (hits.material == NAMES.index('poster')) & front
    assert screen.sum() > 20
    assert lost[screen].mean() > 0.7 > 0.4 > lost[poster].mean()
    assert lost[(hits.cosine < 0.1) & (hits.material >= 0)].all()
    near = hits.distance < 4.0
    assert lost[near & front].any()  # in the projector's shadow, or dark


def test_sfm_points_lie_on_texture_with_noise_and_outliers(room):
    points, colors = sfm_cloud(room, np.random.default_rng(1), 15000)
    assert points.shape == colors.shape
    assert 5000 < len(points) <= 15000
    rng = np.random.default_rng(2)
    dense = np.concatenate(
        [
            kinect_frame(room, look_at(EYE + step, AT + step), rng, 480, 640)[0].reshape(-1, 3)
            @ look_at(EYE + step, AT + step).rotation.T
            + look_at(EYE + step, AT + step).translation
            for step in rng.normal(0, 0.3, (6, 3))
        ]
    )
    distance = cKDTree(dense[np.isfinite(dense).all(axis=1)]).query(points)[0]
    assert np.median(distance) < 0.03
    assert (distance > 0.1).mean() > 0.02  # outliers, and what the other sensor did not see
    plain = np.flatnonzero((points[:, 1] > 1.8) & (np.abs(points[:, 0] - 0.3) < 1.0) & (points[:, 2] > 2.0))
    poster = np.flatnonzero(
        (points[:, 1] > 1.8) & (np.abs(points[:, 0] + 0.65) < 0.4) & (np.abs(points[:, 2] - 1.65) < 0.3)
    )
    assert len(poster) / (0.8 * 0.6) > 3 * len(plain) / (2.0 * 0.5)


def test_gauges_are_similarities_of_any_scale():
    rng = np.random.default_rng(3)
    gauges = [random_similarity(rng) for _ in range(200)]
    scales = np.array([gauge.scale for gauge in gauges])
    assert scales.min() >= 1 / 20
    assert scales.max() <= 20
    assert (scales < 0.2).any()
    assert (scales > 5).any()
    for gauge in gauges[:20]:
        assert np.allclose(gauge.rotation @ gauge.rotation.T, np.eye(3))
        assert np.linalg.det(gauge.rotation) == pytest.approx(1)


def test_errors_are_zero_for_the_truth_and_measure_a_known_change(pair):
    assert errors(pair.truth, pair.truth, pair.source) == pytest.approx(
        dict.fromkeys(errors(pair.truth, pair.truth, pair.source), 0), abs=1e-5
    )
    angle = np.radians(10)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    found = errors(Similarity(1.1, turn, np.zeros(3)) @ pair.truth, pair.truth, pair.source)
    assert found['rotation_deg'] == pytest.approx(10)
    assert found['scale_percent'] == pytest.approx(10)
    shifted = errors(Similarity(1.0, np.eye(3), np.array([0, 0.3, 0.4])) @ pair.truth, pair.truth, pair.source)
    assert shifted['mean_displacement'] == pytest.approx(0.5)


def test_the_pair_is_written_with_its_truth(tmp_path):
    write_pair(tmp_path / 'pair', 3)
    truth = Similarity.from_matrix(json.loads((tmp_path / 'pair' / 'truth.json').read_text())['T_target_source'])
    source, target = (read_cloud(tmp_path / 'pair' / name) for name in ('sfm.ply', 'kinect.ply'))
    assert source.colors is not None
    assert np.median(cKDTree(target.points).query(truth.apply(source.points))[0]) < 0.03


def test_the_recording_is_stamped_in_order(pair):
    messages = recording(pair, frames=4)
    stamps = [cloud.stamp for _, cloud in messages]
    assert [topic for topic, _ in messages] == ['/source'] + 4 * ['/target']
    assert stamps == sorted(stamps)
    assert messages[-1][1].points.shape == (*SIZE, 3)
