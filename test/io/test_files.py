"""Clouds in files: what is written reads back, and what is no cloud is refused by name."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from csgm_ros.errors import InputError
from csgm_ros.io.files import SUFFIXES, read_cloud, write_cloud
from csgm_ros.io.resources import config_file

POINTS = np.random.default_rng(1).normal(size=(500, 3)) * (3, 2, 1)
COLORS = np.random.default_rng(2).integers(0, 256, (500, 3)) / 255


@pytest.mark.parametrize('suffix', SUFFIXES)
def test_what_is_written_reads_back(tmp_path, suffix):
    path = tmp_path / f'cloud{suffix}'
    write_cloud(path, POINTS)
    assert np.allclose(read_cloud(path).points, POINTS, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize('suffix', ['.ply', '.pcd'])
def test_colors_are_kept(tmp_path, suffix):
    path = tmp_path / f'cloud{suffix.upper()}'
    write_cloud(path, POINTS, COLORS)
    assert np.allclose(read_cloud(path).colors, COLORS, atol=1 / 255)


def test_a_mesh_gives_its_vertices(tmp_path):
    path = tmp_path / 'mesh.ply'
    path.write_text(
        'ply\nformat ascii 1.0\ncomment by hand\nelement vertex 3\nproperty float x\nproperty float y\n'
        'property float z\nproperty uchar quality\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n'
        '0 0 0 1\n1 0 0 2\n0 1 0 3\n3 0 1 2\n'
    )
    assert read_cloud(path).points.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


def test_missing_points_are_kept_as_nan_for_the_registration_to_leave_out(tmp_path):
    organised = POINTS.reshape(20, 25, 3).copy()
    organised[3, 4] = np.nan
    np.save(tmp_path / 'frame.npy', organised)
    points = read_cloud(tmp_path / 'frame.npy').points
    assert points.shape == (500, 3)
    assert np.isnan(points).any(axis=1).sum() == 1


@pytest.mark.parametrize('key', ['points', 'xyz', 'vertices', 'anything'])
def test_npz_keys(tmp_path, key):
    np.savez(tmp_path / 'c.npz', **{key: POINTS, 'index': np.arange(4)})
    assert np.array_equal(read_cloud(tmp_path / 'c.npz').points, POINTS)


def test_npz_prefers_the_named_array_and_refuses_to_guess(tmp_path):
    np.savez(tmp_path / 'a.npz', points=POINTS, normals=-POINTS)
    assert np.array_equal(read_cloud(tmp_path / 'a.npz').points, POINTS)
    np.savez(tmp_path / 'b.npz', left=POINTS, right=-POINTS)
    with pytest.raises(InputError, match='points or xyz or vertices'):
        read_cloud(tmp_path / 'b.npz')
    np.save(tmp_path / 'c.npy', np.zeros((4, 2)))
    with pytest.raises(InputError, match=r'\(N, 3\)'):
        read_cloud(tmp_path / 'c.npy')


def test_pickles_are_never_loaded(tmp_path):
    np.save(tmp_path / 'p.npy', np.array([{'a': 1}], dtype=object), allow_pickle=True)
    with pytest.raises(InputError):
        read_cloud(tmp_path / 'p.npy')


@pytest.mark.parametrize('suffix', ['.ply', '.pcd'])
@pytest.mark.parametrize('text', [True, False])
@pytest.mark.parametrize('share', [0.99, 0.5, 0.1])
def test_a_cut_file_is_refused_instead_of_read_as_arbitrary_memory(tmp_path, suffix, text, share):
    import open3d

    path = tmp_path / f'cut{suffix}'
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(POINTS))
    open3d.io.write_point_cloud(str(path), cloud, write_ascii=text)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError, match=path.name):
        read_cloud(path)


def test_compressed_pcd_reads_whole_and_is_refused_cut(tmp_path):
    import open3d

    path = tmp_path / 'c.pcd'
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(np.repeat(POINTS, 20, axis=0)))
    open3d.io.write_point_cloud(str(path), cloud, compressed=True)
    assert len(read_cloud(path).points) == 10000
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(InputError):
        read_cloud(path)


@pytest.mark.parametrize('suffix', SUFFIXES)
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(data=st.binary(max_size=400))
def test_garbage_is_refused_by_name_or_is_a_cloud(tmp_path, suffix, data):
    path = tmp_path / f'garbage{suffix}'
    start = {
        '.ply': b'ply\nformat binary_little_endian 1.0\nelement vertex 3\n',
        '.pcd': b'VERSION 0.7\nFIELDS x y z\n',
    }
    for content in (data, start.get(suffix, b'') + data):
        path.write_bytes(content)
        said = str(path)
        try:
            assert read_cloud(path).points.shape[1] == 3
        except InputError as error:
            said = str(error)
        assert str(path) in said
        assert '\n' not in said


@pytest.mark.parametrize('suffix', SUFFIXES)
def test_empty_missing_and_pointless_files_are_refused(tmp_path, suffix):
    path = tmp_path / f'empty{suffix}'
    with pytest.raises(InputError, match='no such file'):
        read_cloud(path)
    path.write_bytes(b'')
    with pytest.raises(InputError, match=path.name):
        read_cloud(path)
    if suffix in ('.las', '.laz'):  # which has no such number
        with pytest.raises(InputError, match='finite'):
            write_cloud(path, np.full((4, 3), np.nan))
        return
    write_cloud(path, np.full((4, 3), np.nan))
    with pytest.raises(InputError, match=path.name):
        read_cloud(path)


def test_other_kinds_and_places_are_refused(tmp_path):
    with pytest.raises(InputError, match='unknown kind'):
        read_cloud(tmp_path / 'cloud.doc')
    with pytest.raises(InputError, match='must end with'):
        write_cloud(tmp_path / 'cloud.stl', POINTS)
    with pytest.raises(InputError, match='does not exist'):
        write_cloud(tmp_path / 'nowhere' / 'cloud.ply', POINTS)


def test_configuration_files_are_found_and_others_are_not():
    assert config_file('csgm.yaml').is_file()
    with pytest.raises(InputError, match='not part of this install'):
        config_file('nothing.yaml')
