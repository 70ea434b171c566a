"""Supervoxels: PCL's own, a partition, what may change them and what must not, clouds without structure."""

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.partitions import adjusted_rand, undersegmentation
from csgm_ros.cloud.normals import axis_of, plane_normals
from csgm_ros.cloud.voxels import unpacked, voxel_means, voxelize
from csgm_ros.errors import DegenerateCloudError, InputError
from csgm_ros.structure.region_growing import flow
from csgm_ros.structure.supervoxels import _seeds, segment

VOXEL, SEED = 0.06, 0.4


def blob(count=6000, seed=0):
    """Points on a closed bumpy surface of radius about 1, without symmetry."""
    directions = np.random.default_rng(seed).standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    x, y, z = directions.T
    return directions * (1 + 0.2 * np.sin(3 * x + 1) * np.cos(4 * y) + 0.15 * z * x)[:, None]


POINTS = blob()
CUT = segment(POINTS, VOXEL, SEED)


def pcl(shared, model, nodes):
    folder = shared / 'reference' / 'pcl'
    points = np.load(folder / f'{model}_points.npz')['points'].astype(float)
    return points, np.load(folder / f'{model}_{nodes}.npz'), np.load(folder / f'{model}_50.npz')


def same(first, second):
    assert np.array_equal(first.labels, second.labels)
    assert np.array_equal(first.adjacency, second.adjacency)
    assert np.array_equal(first.centroids, second.centroids)


# PCL


@pytest.mark.parametrize('model', ['bunny', 'cloud_bin_0'])
def test_voxels_and_their_normals_are_those_of_pcl(shared, model):
    points, _, reference = pcl(shared, model, 50)
    size = float(reference['voxel_res'])
    grid = voxelize(points, size, phase=0.0)
    distance, own = cKDTree(grid.world(grid.centroids)).query(reference['voxel_xyz'])
    assert len(grid.keys) == len(reference['voxel_xyz']) == len(np.unique(own))
    assert distance.max() < 1e-3 * size
    axes, expected = plane_normals(grid, np.zeros(len(own), np.int32))[own], reference['voxel_normal'].astype(float)
    undefined = np.isnan(expected).any(1)
    assert not axes[undefined].any()
    defined = axes.any(1) & ~undefined
    assert (~defined).sum() <= 1.5 * undefined.sum()
    assert np.abs((axes * expected).sum(1))[defined].min() > 0.999


@pytest.mark.parametrize('nodes', [50, 150, 400])
@pytest.mark.parametrize('model', ['bunny', 'cloud_bin_0'])
def test_seeds_on_the_voxels_of_pcl_are_those_of_pcl(shared, model, nodes):
    points, reference, voxels = pcl(shared, model, nodes)
    size = float(reference['voxel_res'])
    grid = voxelize(points, size, phase=0.0)
    seeds = grid.world(grid.centroids[_seeds(grid, float(reference['seed_res']) / size)])
    expected = np.unique(voxels['voxel_xyz'][reference['seed_voxel']], axis=0)
    distance, own = cKDTree(seeds).query(expected)
    assert len(seeds) == len(expected)
    matched = distance < 1e-3 * size
    assert len(np.unique(own[matched])) == matched.sum() >= 0.99 * len(expected)


@pytest.mark.parametrize('nodes', [50, 150, 400])
@pytest.mark.parametrize('model', ['bunny', 'cloud_bin_0'])
def test_supervoxels_are_as_near_to_pcl_as_its_own_refinement_is(shared, model, nodes):
    points, reference, _ = pcl(shared, model, nodes)
    cut = segment(points, float(reference['voxel_res']), float(reference['seed_res']))
    labels = reference['point_label'].astype(int) - 1
    reached = (labels >= 0) & (cut.labels >= 0)
    yardstick = adjusted_rand(reference['voxel_label'], reference['voxel_label_refined3'])
    assert adjusted_rand(cut.labels[reached], labels[reached]) > yardstick - 0.07
    assert undersegmentation(cut.labels[reached], labels[reached]) < 0.25
    assert abs(reached.mean() - (labels >= 0).mean()) < 0.005
    theirs, ours = len(reference['sv_label']), len(cut)
    assert theirs <= ours <= 1.03 * theirs  # PCL loses seeds to their neighbours
    assert len(cut.adjacency) / ours == pytest.approx(len(reference['sv_adjacency']) / theirs, rel=0.06)
    assert cut.sizes.std() == pytest.approx(reference['sv_nvoxels'].std(), rel=0.15)


# a partition


@settings(max_examples=25, deadline=None)
@given(
    count=st.integers(200, 3000),
    seed=st.integers(0, 1000),
    ratio=st.floats(2, 9),
    refinements=st.integers(0, 2),
    spatial_weight=st.floats(0, 3),
)
def test_every_reached_point_is_in_one_supervoxel_and_nothing_vanishes(count, seed, ratio, refinements, spatial_weight):
    points = blob(count, seed)
    cut = segment(points, 0.15, 0.15 * ratio, refinements=refinements, spatial_weight=spatial_weight)
    assert cut.labels.shape == cut.point_voxels.shape == (count,)
    assert cut.labels.dtype == cut.adjacency.dtype == np.int32
    assert np.array_equal(np.unique(cut.labels[cut.labels >= 0]), np.arange(len(cut)))
    assert cut.labels.min() >= -1
    assert np.array_equal(cut.labels, cut.voxel_labels[cut.point_voxels])
    assert np.array_equal(np.bincount(cut.voxel_labels[cut.voxel_labels >= 0]), cut.sizes)
    for k in range(len(cut)):
        assert np.allclose(cut.voxel_points[cut.voxel_labels == k].mean(0), cut.centroids[k], atol=1e-9)
    defined = np.isfinite(cut.normals).all(1)
    assert np.allclose(np.linalg.norm(cut.normals[defined], axis=1), 1)


def test_voxels_hold_their_points_and_nothing_is_lost():
    grid = voxelize(POINTS, VOXEL)
    cells = np.floor((POINTS - grid.origin) / VOXEL).astype(int)
    assert np.array_equal(unpacked(grid.keys)[grid.point_voxels], cells)
    for v in range(0, len(grid.keys), 97):
        assert np.allclose(grid.world(grid.centroids)[v], POINTS[grid.point_voxels == v].mean(0), atol=1e-9)
    assert np.array_equal(voxel_means(POINTS, VOXEL), grid.world(grid.centroids))


def test_neighbors_are_the_occupied_ones_of_the_26():
    grid = voxelize(blob(20000), 0.03)  # more voxels than the first hash table holds
    cells = unpacked(grid.keys)
    assert len(cells) > 4096
    expected = cKDTree(cells).query_ball_point(cells, 1.1, p=np.inf)
    for v, near in enumerate(expected):
        assert list(grid.neighbors[grid.starts[v] : grid.starts[v + 1]]) == sorted(set(near) - {v})


def test_two_planes_that_meet_are_not_mixed():
    rng = np.random.default_rng(1)
    floor, wall = rng.uniform(0, 1, (8000, 3)), rng.uniform(0, 1, (8000, 3))
    floor[:, 2], wall[:, 0] = 0.0, 0.0
    cut = segment(np.concatenate((floor, wall)), 0.03, 0.25)
    truth = np.repeat([0, 1], 8000)
    assert undersegmentation(cut.labels, truth) < 0.03
    assert len(cut) > 20
    floor_normals = cut.voxel_normals[np.unique(cut.point_voxels[:8000][floor[:, 0] > 0.15])]
    assert np.abs(floor_normals[:, 2]).min() > 0.999


def test_an_island_without_a_seed_is_not_labelled():
    rng = np.random.default_rng(2)
    plane = np.column_stack((rng.uniform(0, 1, (4000, 2)), np.zeros(4000)))
    cut = segment(np.concatenate((plane, [[0.5, 0.5, 0.2]])), 0.04, 0.25)
    assert cut.labels[-1] == -1
    assert (cut.labels[:-1] >= 0).all()


# adjacency


def test_adjacency_has_each_touching_pair_once_and_leads_away_from_the_middle():
    cells = unpacked(voxelize(POINTS, VOXEL).keys)
    touching = cKDTree(cells).query_pairs(1.1, p=np.inf, output_type='ndarray')
    pairs = CUT.voxel_labels[touching]
    pairs = pairs[(pairs[:, 0] != pairs[:, 1]) & (pairs >= 0).all(1)]
    expected = {tuple(pair) for pair in np.sort(pairs, axis=1)}
    assert {tuple(pair) for pair in np.sort(CUT.adjacency, axis=1)} == expected
    assert len(CUT.adjacency) == len(expected)
    distance = np.linalg.norm(CUT.centroids - CUT.voxel_points.mean(0), axis=1)
    assert (distance[CUT.adjacency[:, 0]] < distance[CUT.adjacency[:, 1]]).all()


# what must not change them


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_order_of_the_points_changes_nothing(seed):
    order = np.random.default_rng(seed).permutation(len(POINTS))
    permuted = segment(POINTS[order], VOXEL, SEED)
    assert np.array_equal(permuted.labels, CUT.labels[order])
    assert np.array_equal(permuted.voxel_points, CUT.voxel_points)
    assert np.array_equal(permuted.adjacency, CUT.adjacency)
    assert np.array_equal(permuted.centroids, CUT.centroids)


@settings(max_examples=15, deadline=None)
@given(
    st.tuples(*[st.integers(-(2**20), 2**20)] * 3),
    st.integers(-30, 30),
)
def test_an_exact_shift_and_a_power_of_two_change_no_label(shift, power):
    exact = np.round(POINTS * 2**20) / 2**20
    before = segment(exact, VOXEL, SEED)
    scale = 2.0**power
    after = segment((exact + np.array(shift) / 2**8) * scale, VOXEL * scale, SEED * scale)
    assert np.array_equal(after.labels, before.labels)
    assert np.array_equal(after.adjacency, before.adjacency)
    assert np.allclose(after.normals, before.normals, atol=1e-6)


@settings(max_examples=15, deadline=None)
@given(st.tuples(*[st.floats(-1e3, 1e3)] * 3), st.floats(1e-4, 1e4))
def test_any_shift_and_scale_change_next_to_nothing(shift, scale):
    after = segment((POINTS + np.array(shift)) * scale, VOXEL * scale, SEED * scale)
    assert len(after) == len(CUT)
    assert adjusted_rand(after.labels, CUT.labels) > 0.99
    # within the resolution of coordinates this far away
    assert np.allclose(after.centroids / scale - shift, CUT.centroids, atol=0.05)


def test_a_lattice_is_cut_the_same_wherever_it_lies():
    """Its points would all be on voxel faces, if the voxels were aligned with it: rounding must not decide."""
    x, y, z = np.meshgrid(np.arange(-20, 21), np.arange(-16, 17), np.arange(-12, 13), indexing='ij')
    lattice = np.stack((x, y, z), axis=-1).reshape(-1, 3)
    shell = lattice[(np.abs(lattice) == [20, 16, 12]).any(1)] * 0.1
    before = segment(shell, 0.2, 1.0)
    for shift in ([0.3, -7.7, 1.1], [1e3 / 3, 0.1, -5e2 / 7]):
        assert np.array_equal(segment(shell + shift, 0.2, 1.0).labels, before.labels)


@pytest.mark.parametrize('seed', range(3))
def test_a_rotated_cloud_is_cut_alike(seed):
    rotation = Rotation.random(random_state=seed).as_matrix()
    rotated = segment(POINTS @ rotation.T, VOXEL, SEED)
    assert len(rotated) == pytest.approx(len(CUT), rel=0.25)
    assert rotated.sizes.std() / rotated.sizes.mean() == pytest.approx(CUT.sizes.std() / CUT.sizes.mean(), abs=0.2)
    assert (rotated.labels >= 0).mean() > 0.99
    nearest, _ = cKDTree(rotated.centroids @ rotation).query(CUT.centroids)
    assert np.median(nearest) < 0.5 * SEED
    # the normals of voxels, other than the lattice of the seeds, do turn with the cloud
    cosine = (rotated.voxel_normals[rotated.point_voxels] @ rotation * CUT.voxel_normals[CUT.point_voxels]).sum(1)
    assert np.mean(cosine > 0.97) > 0.97


# normals


def test_normals_point_away_from_the_middle():
    middle = CUT.voxel_points.mean(0)
    assert ((CUT.normals * (CUT.centroids - middle)).sum(1) >= 0).all()
    assert ((CUT.voxel_normals * (CUT.voxel_points - middle)).sum(1) >= 0).all()


def test_given_normals_have_no_sign_and_may_be_missing():
    rng = np.random.default_rng(3)
    normals = CUT.voxel_normals[CUT.point_voxels]
    flipped = normals * rng.choice([-1.0, 1.0], (len(normals), 1))
    given_normals = segment(POINTS, VOXEL, SEED, normals=normals)
    same(segment(POINTS, VOXEL, SEED, normals=flipped), given_normals)
    assert adjusted_rand(given_normals.labels, CUT.labels) > 0.9
    missing = np.where(rng.random((len(normals), 1)) < 0.3, np.nan, normals)
    assert adjusted_rand(segment(POINTS, VOXEL, SEED, normals=missing).labels, CUT.labels) > 0.8
    nothing = segment(POINTS, VOXEL, SEED, normals=np.full_like(POINTS, np.nan))
    assert np.isnan(nothing.normals).all()
    assert (nothing.labels >= 0).all()


@settings(max_examples=200, deadline=None)
@given(st.lists(st.floats(-1, 1), min_size=9, max_size=9), st.booleans())
@example([0.0] * 8 + [1.75e-73], False)
def test_axes_are_eigenvectors(values, largest):
    root = np.array(values).reshape(3, 3)
    matrix = root @ root.T
    found = np.array(axis_of(*matrix[np.triu_indices(3)], largest))
    eigenvalues, vectors = np.linalg.eigh(matrix)
    chosen = 2 if largest else 0
    gap = np.delete(np.abs(eigenvalues - eigenvalues[chosen]), chosen).min()
    if gap > 1e-3 * max(eigenvalues[2], 1e-9):
        assert abs(found @ vectors[:, chosen]) > 1 - 1e-9
    assert np.linalg.norm(found) == pytest.approx(1) or not found.any()


# weights, refinement, determinism


def test_space_alone_makes_rounder_supervoxels_than_normals_alone():
    def spread(cut):
        return np.linalg.norm(POINTS - cut.centroids[cut.labels], axis=1).mean()

    by_space = segment(POINTS, VOXEL, SEED, spatial_weight=1.0, normal_weight=0.0)
    by_normals = segment(POINTS, VOXEL, SEED, spatial_weight=0.0, normal_weight=1.0)
    assert spread(by_space) < spread(CUT) < spread(by_normals)


def test_refinement_evens_out_the_sizes():
    refined = segment(POINTS, VOXEL, SEED, refinements=3)
    assert len(refined) == len(CUT)
    assert refined.sizes.std() < CUT.sizes.std()


def test_the_same_cloud_is_cut_the_same():
    same(segment(POINTS, VOXEL, SEED), CUT)
    same(segment(np.asfortranarray(POINTS), VOXEL, SEED), CUT)


def test_seeds_keep_their_voxel():
    grid = voxelize(POINTS, VOXEL)
    axes = plane_normals(grid, np.zeros(len(grid.keys), np.int32))
    seeds = _seeds(grid, SEED / VOXEL)
    crowded = np.unique(np.concatenate((seeds, grid.neighbors[grid.starts[seeds[0]] : grid.starts[seeds[0] + 1]])))
    labels, _, _ = flow(grid, axes, crowded, (grid.centroids[crowded], axes[crowded]), SEED / VOXEL, (1.0, 0.06))
    assert np.array_equal(labels[crowded], np.arange(len(crowded)))


# what cannot be cut


@pytest.mark.parametrize(
    ('points', 'says'),
    [
        (np.empty((0, 3)), 'at least three'),
        (np.zeros((1, 3)), 'at least three'),
        (np.array([[0.0, 0, 0], [1, 0, 0]]), 'at least three'),
        (np.full((50, 3), 0.7), 'one place'),
        (np.random.default_rng(0).uniform(0, 1e-3, (50, 3)), 'smaller voxel_size'),
        (np.linspace(0, 5, 200)[:, None] * [1, 0, 0], 'one line'),
        (np.linspace(0, 5, 200)[:, None] * [0.3, -0.7, 0.9] + 4, 'one line'),
        ((np.linspace(0, 5, 200)[:, None] * [0.3, -0.7, 0.9] + 4).astype(np.float32), 'one line'),
    ],
)
def test_a_cloud_without_a_surface_is_refused(points, says):
    with pytest.raises(DegenerateCloudError, match=says):
        segment(points, 0.1, 0.5)


def test_a_flat_cloud_is_fine():
    rng = np.random.default_rng(4)
    flat = np.column_stack((rng.uniform(0, 3, (5000, 2)), np.zeros(5000)))
    cut = segment(flat @ Rotation.random(random_state=5).as_matrix().T, 0.1, 0.6)
    assert (cut.labels >= 0).all()
    assert np.abs(cut.normals @ cut.normals[0]).min() > 1 - 1e-6


def test_dust_is_refused():
    dust = np.random.default_rng(6).uniform(0, 100, (300, 3))
    with pytest.raises(DegenerateCloudError, match='too sparse'):
        segment(dust, 0.1, 5.0)


@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf])
def test_points_that_are_not_finite_are_refused(value):
    points = POINTS.copy()
    points[17, 1] = value
    with pytest.raises(InputError, match='finite'):
        segment(points, VOXEL, SEED)


@pytest.mark.parametrize('shape', [(10,), (10, 2), (10, 4), (2, 5, 3)])
def test_points_of_another_shape_are_refused(shape):
    with pytest.raises(InputError, match=r'\(N, 3\)'):
        segment(np.zeros(shape), VOXEL, SEED)


@pytest.mark.parametrize('sizes', [(0.0, 1.0), (-0.1, 1.0), (0.5, 0.5), (0.5, 0.1), (np.nan, 1.0), (0.1, np.inf)])
def test_sizes_that_do_not_fit_each_other_are_refused(sizes):
    with pytest.raises(InputError, match='seed_size'):
        segment(POINTS, *sizes)


def test_a_voxel_too_small_for_the_cloud_is_refused():
    far = np.concatenate((POINTS, [[1e9, 0, 0]]))
    with pytest.raises(InputError, match='outliers far away'):
        segment(far, VOXEL, SEED)


def test_normals_of_another_shape_are_refused():
    with pytest.raises(InputError, match='one row a point'):
        segment(POINTS, VOXEL, SEED, normals=np.zeros((5, 3)))
