"""ESF and FPFH: PCL's and Open3D's, shapes whose answer is known, what may change them, shapes without an answer."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from csgm_ros.errors import InputError
from csgm_ros.structure.descriptors import context, esf, esf_of_groups, members_of
from csgm_ros.structure.fpfh import _spfh, fpfh

A3_OUT, D3_OUT, D2_IN, D2_OUT = (slice(64 * k, 64 * k + 64) for k in (1, 4, 6, 7))
SHAPES = ('ball', 'sphere', 'plane', 'rod', 'corner')


def rng(seed=0):
    return np.random.default_rng(seed)


def shape(name, count=1500, seed=0):
    draw = rng(seed)
    points = draw.uniform(-1, 1, (count, 3))
    if name == 'ball':
        return points[np.linalg.norm(points, axis=1) < 1]
    if name == 'sphere':
        return points / np.linalg.norm(points, axis=1, keepdims=True)
    if name == 'corner':
        points[np.arange(count), draw.integers(0, 3, count)] = -1
        return points
    return points * {'plane': [1, 0.7, 0], 'rod': [1, 0.08, 0.05]}[name]


def surface(count=1200, seed=0):
    """Points and outward normals of a bumpy surface z(x, y)."""
    x, y = rng(seed).uniform(-1, 1, (2, count))
    points = np.column_stack((x, y, 0.3 * np.sin(2 * x + y) + 0.2 * x * y))
    slope_x, slope_y = 0.6 * np.cos(2 * x + y) + 0.2 * y, 0.3 * np.cos(2 * x + y) + 0.2 * x
    normals = np.column_stack((-slope_x, -slope_y, np.ones(count)))
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


# PCL


@pytest.mark.parametrize('nodes', [50, 150, 400])
@pytest.mark.parametrize('model', ['bunny', 'cloud_bin_0'])
def test_esf_of_supervoxels_differs_from_pcl_as_pcl_differs_from_itself(shared, model, nodes):
    folder = shared / 'reference' / 'pcl'
    points = np.load(folder / f'{model}_points.npz')['points']
    reference = np.load(folder / f'{model}_{nodes}.npz')
    labels = reference['point_label'].astype(int) - 1
    own = esf_of_groups(points, *members_of(labels, labels.max() + 1), rng(1))[reference['esf_label'] - 1]
    distance = np.linalg.norm(own - reference['esf'], axis=1)
    assert distance.mean() < max(0.008, 1.1 * reference['esf_within_mean'])
    assert distance.max() < 0.04
    nearest = cdist(own, reference['esf']).argmin(1)
    assert np.mean(nearest == np.arange(len(own))) > reference['esf_rerun_top1'] - 0.03
    mass = (own - reference['esf']).reshape(-1, 10, 64).sum(2)
    assert np.abs(mass.mean(0)).max() < 0.001


@pytest.mark.parametrize('model', ['bunny', 'cloud_bin_0'])
def test_esf_of_a_whole_cloud_differs_from_pcl_as_pcl_differs_from_itself(shared, model):
    folder = shared / 'reference' / 'pcl'
    points = np.load(folder / f'{model}_points.npz')['points']
    whole = np.load(folder / f'{model}_50.npz')['esf_whole']
    assert np.linalg.norm(esf(points, rng(2)) - whole, axis=1).mean() < 0.006


# known answers


def test_esf_of_an_equilateral_triangle():
    """Three points: every triple is the same, its lines are outside, its angles 60 degrees."""
    corners = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
    found = esf(corners, rng(), 1000)
    angles, areas, distances = found[A3_OUT], found[D3_OUT], found[D2_OUT]
    assert np.flatnonzero(angles).tolist() == [42]  # 60 of 90 degrees in 63 steps
    assert np.flatnonzero(areas).tolist() == np.flatnonzero(distances).tolist() == [63]
    assert angles.sum() + areas.sum() + distances.sum() == pytest.approx(1)
    assert distances.sum() / areas.sum() == pytest.approx(12)  # three to one, weights 2 and 0.5


def test_esf_of_a_right_triangle():
    found = esf(np.array([[0.0, 0, 0], [3, 0, 0], [0, 4, 0]]), rng(), 1000)
    angles = found[A3_OUT]
    assert np.flatnonzero(angles).tolist() == [26, 37, 63]  # 36.9, 53.1 and 90 degrees
    # An angle weighs by the cells of the line opposite, and the line of length 5 has as many as that of 4.
    assert angles[[26, 37, 63]] / angles.sum() == pytest.approx(np.array([3, 4, 4]) / 11, rel=0.05)
    assert np.flatnonzero(found[D2_OUT]).tolist() == [38, 50, 63]  # 3, 4 and 5 of 5


def test_esf_of_a_solid_has_every_line_inside():
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, 33)] * 3)
    solid = np.column_stack((x.ravel(), y.ravel(), z.ravel()))
    by_histogram = esf(solid, rng(), 2000).reshape(10, 64).sum(1)
    assert by_histogram[[0, 3, 6]].sum() > 0.995  # the rest: triples of neighbours


def test_esf_tells_hollow_from_solid():
    ball, sphere = (esf(shape(name, 20000), rng()).reshape(10, 64).sum(1) for name in ('ball', 'sphere'))
    assert ball[6] > 2 * sphere[6]


# what may change it


@settings(max_examples=25, deadline=None)
@given(
    st.sampled_from(SHAPES),
    st.integers(0, 1000),
    st.floats(1e-6, 1e6),
    st.tuples(*[st.floats(-10, 10)] * 3),
)
def test_esf_stays_when_a_shape_is_turned_scaled_and_moved(name, seed, scale, shift):
    points = shape(name, seed=seed)
    rotation = Rotation.random(random_state=seed).as_matrix()
    moved = scale * (points @ rotation.T + np.array(shift))
    before, after = esf(points, rng(seed)), esf(moved, rng(seed + 1))
    assert np.linalg.norm(before - after) < 0.03
    others = [esf(shape(other, seed=seed), rng(seed)) for other in SHAPES if other != name]
    assert min(np.linalg.norm(other - after) for other in others) > np.linalg.norm(before - after)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 40), st.integers(0, 10000), st.integers(1, 60), st.floats(1e-9, 1e9), st.booleans())
def test_esf_sums_to_one_or_is_zero(count, seed, samples, scale, rounded):
    points = rng(seed).standard_normal((count, 3)) * scale
    points = np.round(points / scale) * scale if rounded else points
    found = esf(points, rng(seed), samples)
    assert found.shape == (640,)
    assert (found >= 0).all()
    assert found.sum() == pytest.approx(1) or not found.any()
    if not rounded and count >= 4:
        assert found.any()


def test_esf_follows_its_seed_alone():
    points = shape('corner')
    assert np.array_equal(esf(points, rng(5)), esf(points, rng(5)))
    assert not np.array_equal(esf(points, rng(5)), esf(points, rng(6)))


def test_groups_do_not_depend_on_threads_nor_on_each_other():
    points, labels = shape('corner', 4000), rng(1).integers(-1, 23, 4000)
    starts, members = members_of(labels, 23)
    one = esf_of_groups(points, starts, members, rng(7), 500, threads=1)
    for threads in (0, 2, 5):
        assert np.array_equal(esf_of_groups(points, starts, members, rng(7), 500, threads=threads), one)
    first = esf_of_groups(points, starts[:4], members[: starts[3]], rng(7), 500)
    assert np.array_equal(first, one[:3])


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(-1, 6), max_size=60))
def test_members_are_the_points_of_each_label(labels):
    labels = np.array(labels, np.int32)
    starts, members = members_of(labels, 7)
    for k in range(7):
        assert members[starts[k] : starts[k + 1]].tolist() == np.flatnonzero(labels == k).tolist()
    assert starts[-1] == len(members) == (labels >= 0).sum()


# shapes that span no triangle


@pytest.mark.parametrize(
    'points',
    [
        np.empty((0, 3)),
        np.ones((1, 3)),
        np.array([[0.0, 0, 0], [1, 2, 3]]),
        np.full((100, 3), 1 / 3),
        np.repeat([[0.0, 0, 0], [1, 2, 3]], 50, axis=0),
        np.linspace(0, 1, 300)[:, None] * [1, 0, 0],
        np.linspace(-1, 1, 300)[:, None] * [0.2, -0.7, 1.3] + 100,
        (np.linspace(-1, 1, 300)[:, None] * [0.2, -0.7, 1.3] + 1).astype(np.float32),
    ],
)
def test_esf_of_a_shape_without_a_triangle_is_zero(points):
    assert not esf(points, rng()).any()


def test_a_group_without_a_triangle_does_not_harm_its_neighbours():
    points = np.concatenate((shape('ball', 200), np.zeros((5, 3))))
    starts = [0, len(points) - 5, len(points) - 5, len(points)]
    found = esf_of_groups(points, starts, np.arange(len(points)), rng(), 300)
    assert found.any(1).tolist() == [True, False, False]
    assert found[0].sum() == pytest.approx(1)


def test_esf_of_a_shape_that_is_almost_a_line_makes_do():
    needle = shape('rod', 500) * [1, 1e-3, 1e-3]
    assert esf(needle, rng()).sum() == pytest.approx(1)


@pytest.mark.parametrize(
    ('points', 'starts', 'members', 'samples', 'says'),
    [
        ([[0, 0, np.nan]], [0, 1], [0], 10, 'finite'),
        ([[0, 0, np.inf]], [0, 1], [0], 10, 'finite'),
        ([[0, 0]], [0, 1], [0], 10, r'\(N, 3\)'),
        ([[0, 0, 0]], [0, 1], [1], 10, 'indices'),
        ([[0, 0, 0]], [0, 1], [-1], 10, 'indices'),
        ([[0, 0, 0]], [0, 2], [0], 10, 'starts'),
        ([[0, 0, 0]], [1, 1], [0], 10, 'starts'),
        ([[0, 0, 0]], [], [], 10, 'starts'),
        ([[0, 0, 0]], [0, 1, 0, 1], [0], 10, 'starts'),
        ([[0, 0, 0]], [0, 1], [0], 0, 'samples'),
    ],
)
def test_groups_that_do_not_fit_are_refused(points, starts, members, samples, says):
    with pytest.raises(InputError, match=says):
        esf_of_groups(points, starts, members, rng(), samples)


@pytest.mark.slow
def test_kernels_stay_within_their_arrays(tmp_path):
    """The compiled code checks no index; once, let it."""
    script = """
import numpy as np
from csgm_ros.structure.descriptors import context, esf
from csgm_ros.structure.supervoxels import segment
draw = np.random.default_rng(0)
for count in (3, 4, 30, 3000):
    for flat in ([1, 1, 1], [1, 1, 0], [1, 0, 1], [1, 1e-7, 1e-7]):
        esf(draw.standard_normal((count, 3)) * flat, draw, 300)
        esf(np.sign(draw.standard_normal((count, 3))) * flat, draw, 300)
points = draw.standard_normal((9000, 3))
points /= np.linalg.norm(points, axis=1, keepdims=True)
cut = segment(points, 0.08, 0.5, refinements=1)
context(cut.voxel_points, cut.voxel_normals, cut.centroids, 0.6, draw, 200)
segment(points, 0.02, 0.3)
print('within')
"""
    environment = os.environ | {'NUMBA_BOUNDSCHECK': '1', 'NUMBA_CACHE_DIR': str(tmp_path)}
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(
        [sys.executable, '-c', script], env=environment, cwd=root, capture_output=True, text=True, check=False
    )
    assert done.stdout.strip() == 'within', done.stderr


# FPFH and the context


def test_fpfh_is_that_of_open3d():
    open3d = pytest.importorskip('open3d', exc_type=ImportError)
    points, normals = surface(600)
    radius = 0.4
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.normals = open3d.utility.Vector3dVector(normals)
    search = open3d.geometry.KDTreeSearchParamRadius(radius)
    expected = np.asarray(open3d.pipelines.registration.compute_fpfh_feature(cloud, search).data).T
    order = np.argsort(points[:, 0], kind='stable')
    own = np.empty((len(points), 33))
    own[order] = _spfh(points[order], normals[order], radius, 0)
    distance = cdist(points, points)
    weights = np.where((distance > 0) & (distance <= radius), 1 / np.maximum(distance, 1e-12) ** 2, 0)
    around = (weights @ own).reshape(-1, 3, 11)
    around *= 100 / around.sum(2, keepdims=True)
    assert np.allclose(around.reshape(-1, 33) + own, expected, atol=1e-6)


def test_fpfh_of_a_plane_is_three_middle_bins():
    points = shape('plane', 400)
    normals = np.tile([0.0, 0, 1], (400, 1))
    found = fpfh(points, normals, 0.5, points[:7])
    assert np.allclose(found[:, [5, 16, 27]], 100)
    assert np.allclose(found.sum(1), 300)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000), st.floats(1e-3, 1e3), st.tuples(*[st.floats(-10, 10)] * 3))
def test_fpfh_stays_when_a_cloud_is_turned_scaled_and_moved(seed, scale, shift):
    points, normals = surface(400, seed)
    rotation = Rotation.random(random_state=seed).as_matrix()
    before = fpfh(points, normals, 0.4, points[:20])
    after = fpfh(
        *((scale * (points @ rotation.T + shift)), normals @ rotation.T),
        0.4 * scale,
        scale * (points[:20] @ rotation.T + shift),
    )
    assert np.allclose(before, after, atol=1.5)  # a pair at an edge of a bin may change its side


def test_fpfh_tells_a_bump_from_a_dent():
    points, normals = surface(800)
    bump = fpfh(points, normals, 0.5, points[:20])
    dent = fpfh(points, -normals, 0.5, points[:20])
    assert np.linalg.norm(bump - dent, axis=1).mean() > 20


def test_fpfh_leaves_out_points_without_a_normal():
    points, normals = surface(300)
    missing = normals.copy()
    missing[200:250], missing[250:] = np.nan, 0.0
    assert np.array_equal(fpfh(points, missing, 0.5, points[:9]), fpfh(points[:200], normals[:200], 0.5, points[:9]))
    assert not fpfh(points, np.full_like(points, np.nan), 0.5, points[:9]).any()


def test_context_describes_the_ball_around_each_node():
    points, normals = surface()
    nodes, radius = points[:40] + 0.01, 0.5
    shapes, features = context(points, normals, nodes, radius, rng(3), 2000)
    assert shapes.shape == (40, 640)
    assert features.shape == (40, 33)
    assert np.allclose(shapes.sum(1), 1)
    assert np.allclose(features.sum(1), 300)
    for k in range(0, 40, 10):
        ball = points[np.linalg.norm(points - nodes[k], axis=1) <= radius]
        assert np.linalg.norm(esf(ball, rng(k), 20000) - shapes[k]) < 0.03
    again = context(points, normals, nodes, radius, rng(3), 2000, threads=1)
    assert np.array_equal(shapes, again[0])
    assert np.array_equal(features, again[1])


def test_context_of_a_node_with_nothing_around_is_zero():
    points, normals = surface(300)
    shapes, features = context(points, normals, np.array([[50.0, 0, 0], points[0]]), 0.5, rng(), 200)
    assert shapes.any(1).tolist() == features.any(1).tolist() == [False, True]


@pytest.mark.parametrize('radius', [0.0, -1.0, np.nan, np.inf])
def test_context_refuses_a_radius_that_is_none(radius):
    points, normals = surface(50)
    with pytest.raises(InputError, match='radius'):
        context(points, normals, points[:2], radius, rng())


@pytest.mark.parametrize('nodes', [np.zeros(3), np.zeros((2, 2)), np.full((2, 3), np.nan)])
def test_context_refuses_nodes_that_are_none(nodes):
    points, normals = surface(50)
    with pytest.raises(InputError, match='nodes'):
        context(points, normals, nodes, 0.5, rng())
