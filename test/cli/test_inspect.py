"""What inspect says of clouds whose sensor, unit and planes are known."""

import numpy as np
import pytest

from csgm_ros.cli.inspect import LOOSE, description, expectation, inspect
from csgm_ros.errors import DegenerateCloudError


def room(rng, count=6000, size=(4.0, 3.0, 2.5)):
    """Floor and two walls."""
    points = rng.random((count, 3)) * size
    points[np.arange(count), np.arange(count) % 3] = 0.0
    return points + rng.normal(0, 1e-3, points.shape)


def depth_image(rng, width=80, height=60):
    """A wavy wall as a depth camera sees it, float32 as drivers send it."""
    u, v = np.meshgrid(np.arange(width) - width / 2, np.arange(height) - height / 2)
    z = 2.0 + 0.3 * np.sin(u / 9) + rng.normal(0, 2e-3, u.shape)
    return np.stack([u * z / width, v * z / width, z], axis=-1).reshape(-1, 3).astype(np.float32)


def lidar(rng, rings=16, columns=300):
    """Walls of a square yard as a spinning lidar sees them, rays off by a hundredth of a degree."""
    elevation = np.radians(np.linspace(-15, 15, rings)[:, None] + rng.normal(0, 0.01, (rings, columns)))
    azimuth = np.linspace(0, 2 * np.pi, columns, endpoint=False)[None]
    reach = 10.0 / np.maximum(np.abs(np.cos(azimuth)), np.abs(np.sin(azimuth)))
    rays = np.stack([np.cos(azimuth) + 0 * elevation, np.sin(azimuth) + 0 * elevation, np.tan(elevation)], axis=-1)
    return (reach[..., None] * rays).reshape(-1, 3)


def test_size_is_told_and_values_suit_the_density():
    grid = np.stack(np.meshgrid(*3 * [np.arange(12.0)]), axis=-1).reshape(-1, 3)
    text = description(inspect(np.vstack([grid, [[np.nan] * 3], grid[:1]])))
    assert 'points   1730 (1 not finite, 1 repeated)' in text
    assert 'extent   11 x 11 x 11' in text
    assert 'spacing  1 ' in text
    assert '--set supervoxels.voxel_size=0.2' in text
    for nothing in (np.zeros((5, 3)), np.full((5, 3), np.nan)):
        with pytest.raises(DegenerateCloudError):
            inspect(nothing)


def test_the_rows_of_a_sensor_are_found_and_noise_has_none():
    rng = np.random.default_rng(0)
    found = inspect(depth_image(rng))
    assert found.pattern.kind == 'depth grid'
    assert np.allclose(found.pattern.size, (80, 60), atol=3)
    assert found.metric is True
    found = inspect(lidar(rng))
    assert found.pattern.kind == 'lidar rings'
    assert found.pattern.size == (16,)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    for other in (lidar(rng) @ turn + 5.0, room(rng), rng.normal(size=(5000, 3))):
        assert inspect(other).pattern.kind in ('even', 'uneven')


@pytest.mark.parametrize(
    ('change', 'metric', 'why'),
    [
        (lambda points: points * 0.37, None, 'unknown'),
        (lambda points: np.round(points * 1000), False, 'millimetres'),
        (lambda points: np.round(points, 3) + np.array([500_000, 5_400_000, 300]), True, 'map'),
        (lambda points: np.round(points, 2), True, 'multiples of 0.01'),
    ],
)
def test_the_unit_is_guessed_from_what_exporters_leave(change, metric, why):
    found = inspect(change(room(np.random.default_rng(1))))
    assert found.metric is metric
    assert why in found.unit


def test_planes_and_noise_are_those_of_the_room():
    rng = np.random.default_rng(2)
    found = inspect(room(rng))
    assert found.held > 0.2
    assert sum(found.planes) > 0.85
    assert 0.0003 < found.noise < 0.0015
    floor = np.column_stack([rng.random((3000, 2)), np.zeros(3000)])
    assert inspect(floor).held < 0.001


def test_a_corridor_is_held_but_along_its_length():
    rng = np.random.default_rng(4)
    points = rng.random((8000, 3)) * (12.0, 2.0, 2.5)
    points[::2, 2] = 0.0
    points[1::4, 1], points[3::4, 1] = 0.0, 2.0
    found = inspect(points + rng.normal(0, 5e-3, points.shape))
    assert found.held < LOOSE
    assert abs(found.loosest[0]) > 0.99
    door = rng.random((300, 3)) * (0.0, 0.9, 2.0) + (6.0, 0.0, 0.0)  # that stands open
    assert inspect(np.concatenate([points, door])).held > LOOSE


def test_a_pair_is_told_its_scale_and_what_will_be_hard():
    rng = np.random.default_rng(3)
    target = depth_image(rng).astype(float)
    text = expectation(inspect(target / 5.0), inspect(target))
    assert 'scale    5 target units' in text
    assert 'estimate_scale' not in text  # the smaller one is metric by the same guess only if its reach is a sensor's
    assert '--set scale.estimate_scale=false' in expectation(inspect(target), inspect(target))
    floor = np.column_stack([rng.random((3000, 2)), np.zeros(3000)])
    assert 'stops a slide' in expectation(inspect(floor), inspect(target))
