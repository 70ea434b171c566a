"""Thinning against means counted the plain way; by parts, threads and order; and what is refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import room

from csgm_ros.cloud import thin
from csgm_ros.cloud.prepare import finite_points
from csgm_ros.cloud.thin import thinned
from csgm_ros.errors import DegenerateCloudError, InputError
from csgm_ros.io.files import read_points, write_cloud

CLOUD = room(0)


def plain(points, edge):
    """Voxel means by numpy, on the lattice of the origin."""
    cells = np.floor(points / edge).astype(int)
    _, place, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    return np.stack([np.bincount(place.ravel(), column) for column in points.T], axis=1) / counts[:, None]


def test_means_are_those_of_voxels_of_a_power_of_two():
    found = thinned([CLOUD], 3000)
    edges = [2.0**power for power in range(-12, 3)]
    edge = next(edge for edge in edges if len(plain(CLOUD, edge)) <= 3000)
    assert len(found) == len(plain(CLOUD, edge))
    np.testing.assert_allclose(found, plain(CLOUD, edge), atol=edge * 1e-4)


@settings(max_examples=20)
@given(st.integers(0, 1000), st.integers(1, 4), st.integers(50, 4000))
def test_neither_order_nor_threads_nor_parts_change_a_bit(seed, threads, most):
    rng = np.random.default_rng(seed)
    first, rest = CLOUD[:2000], rng.permutation(CLOUD[2000:])
    cuts = np.sort(rng.integers(0, len(rest), 5))
    parts = [first, *np.split(rest, cuts)]
    np.testing.assert_array_equal(thinned(parts, most, threads), thinned([first, CLOUD[2000:]], most))


def test_a_far_outlier_and_missing_points_cost_the_cloud_nothing():
    dirty = np.concatenate([CLOUD, [(1e6, 0, 0)], np.full((5, 3), np.nan), [(np.inf, 0, 0)]])
    found = thinned([dirty], 3000)
    np.testing.assert_array_equal(found[:-1], thinned([CLOUD], 3000))
    np.testing.assert_allclose(found[-1], (1e6, 0, 0))


def test_what_has_no_place_in_a_lattice_is_refused():
    with pytest.raises(DegenerateCloudError, match='no finite point'):
        thinned([np.full((5, 3), np.nan)], 10)
    with pytest.raises(InputError, match='far from all others'):
        thinned([np.concatenate([CLOUD, [(1e60, 0, 0)]])], 10)
    assert len(thinned([np.zeros((100, 3))], 10)) == 1


@pytest.mark.parametrize('ending', ['.npy', '.ply', '.las', '.laz'])
def test_a_file_read_in_parts_gives_what_the_whole_cloud_gives(tmp_path, monkeypatch, ending):
    if ending in ('.las', '.laz'):
        pytest.importorskip('laspy')
    monkeypatch.setattr(thin, 'PART', 1000)
    monkeypatch.setattr('csgm_ros.io.files.PART', 1000)
    path = tmp_path / f'cloud{ending}'
    write_cloud(path, CLOUD)
    whole = read_points(path, len(CLOUD))
    assert len(whole) == len(CLOUD)
    for most in (500, 5000):
        found = read_points(path, most, threads=2)
        assert len(found) <= most
        np.testing.assert_array_equal(found, finite_points(whole, 'cloud', most))
        np.testing.assert_array_equal(found, finite_points(found, 'cloud', most))
