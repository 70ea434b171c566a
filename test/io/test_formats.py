"""Each format in the shapes that other tools write, and what is read against what is there."""

import json
import struct
import sys

import numpy as np
import pytest
from fuzz import corpus
from hypothesis import given
from hypothesis import strategies as st

from csgm_ros.errors import InputError
from csgm_ros.io.files import chunks, read_cloud, write_cloud
from csgm_ros.io.formats.lzf import inflate

POINTS = np.random.default_rng(1).normal(size=(500, 3)) * (3, 2, 1)
COLORS = np.random.default_rng(2).integers(0, 256, (500, 3)) / 255
NORMALS = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)
UTM = np.array([665171.0, 5648298.0, 228.0])
KEEPING = ('.ply', '.pcd', '.xyz', '.csv', '.npy', '.npz')


@pytest.mark.parametrize('suffix', KEEPING)
@pytest.mark.parametrize('offset', [UTM, -6.4e6, 1e-7, 0.0])
def test_coordinates_far_from_the_origin_are_kept(tmp_path, suffix, offset):
    unit = 1e-6 if np.ndim(offset) == 0 and offset == 1e-7 else 1.0
    write_cloud(tmp_path / f'far{suffix}', POINTS * unit + offset)
    assert (
        np.abs(read_cloud(tmp_path / f'far{suffix}').points - (POINTS * unit + offset)).max()
        <= 1e-6 * unit + 1e-9 * unit
    )


@pytest.mark.parametrize('suffix', ['.las', '.laz'])
@pytest.mark.parametrize('origin', [None, (665000.0, 5648000.0, 0.0), (0.0, 0.0, 0.0)])
def test_las_keeps_a_micrometre_and_the_offset_it_is_given(tmp_path, suffix, origin):
    path = tmp_path / f'far{suffix}'
    write_cloud(path, POINTS + UTM, COLORS, origin=origin)
    cloud = read_cloud(path)
    tolerance = 1e-6 if origin != (0.0, 0.0, 0.0) else 0.005  # 32 bits from the given offset reach no further
    assert np.abs(cloud.points - POINTS - UTM).max() < tolerance
    assert np.abs(cloud.colors - COLORS).max() < 1e-4
    assert origin is None or cloud.origin.tolist() == list(origin)


@pytest.mark.parametrize('suffix', ['.ply', '.pcd', '.xyz', '.csv', '.npz'])
def test_colors_and_normals_survive(tmp_path, suffix):
    path = tmp_path / f'cloud{suffix}'
    write_cloud(path, POINTS, COLORS, normals=NORMALS)
    cloud = read_cloud(path)
    np.testing.assert_allclose(cloud.colors, COLORS, atol=1e-6)
    np.testing.assert_allclose(cloud.normals, NORMALS, atol=1e-6)


def test_other_readers_read_what_is_written(tmp_path):
    import laspy
    import open3d

    for name in ('c.ply', 'c.pcd'):
        write_cloud(tmp_path / name, POINTS, COLORS, normals=NORMALS)
        cloud = open3d.io.read_point_cloud(str(tmp_path / name))
        np.testing.assert_allclose(np.asarray(cloud.points), POINTS, atol=1e-6)
        np.testing.assert_allclose(np.asarray(cloud.colors), COLORS, atol=1e-6)
    write_cloud(tmp_path / 'c.laz', POINTS, COLORS)
    np.testing.assert_allclose(laspy.read(tmp_path / 'c.laz').xyz, POINTS, atol=1e-6)


def test_every_scan_of_an_e57_file_is_read_in_the_frame_of_the_file(tmp_path):
    made, clouds = corpus.e57_files(tmp_path), []
    for data in made:
        (tmp_path / 'a.e57').write_bytes(data)
        clouds.append(read_cloud(tmp_path / 'a.e57'))
    posed, integers, spheres = clouds
    turn = np.array([[-0.28, -0.96, 0.0], [0.96, -0.28, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(posed.points, corpus.POINTS @ turn.T + (1, 2, 3), atol=1e-6)
    np.testing.assert_allclose(posed.colors, corpus.COLORS, atol=1e-9)
    valid = np.arange(len(corpus.POINTS)) % 5 != 1
    np.testing.assert_allclose(integers.points, corpus.POINTS[valid], atol=1e-4)
    np.testing.assert_allclose(integers.colors, corpus.COLORS[valid], atol=1e-4)
    np.testing.assert_allclose(spheres.points, np.concatenate([corpus.POINTS, corpus.POINTS]), atol=1e-9)
    assert spheres.colors is None
    for end in range(0, len(made[0]), 300):
        (tmp_path / 'a.e57').write_bytes(made[0][:end])
        with pytest.raises(InputError, match=r'a\.e57: (ends early|does not begin)'):
            read_cloud(tmp_path / 'a.e57')


def test_the_extra_of_a_library_that_is_missing_is_named(tmp_path, monkeypatch):
    for library in ('pye57', 'laspy'):
        monkeypatch.setitem(sys.modules, library, None)
    (tmp_path / 'a.e57').write_bytes(b'')
    with pytest.raises(InputError, match=r'a\.e57: needs pye57; install it by pip install "csgm_ros\[formats\]"'):
        read_cloud(tmp_path / 'a.e57')
    with pytest.raises(InputError, match=r'a\.las: needs laspy; install it by pip install "csgm_ros\[formats\]"'):
        write_cloud(tmp_path / 'a.las', POINTS)
    assert not (tmp_path / 'a.las').exists()


@pytest.mark.parametrize('lines', ['\n', '\r\n', '\r'])
@pytest.mark.parametrize('number', [0, 1, 2])
def test_ply_text_is_tokens_not_lines(tmp_path, lines, number):
    data = corpus.ply_texts()[number]
    head, end, body = data.partition(b'end_header\n')
    (tmp_path / 'a.ply').write_bytes(data)
    (tmp_path / 'b.ply').write_bytes((head + end).replace(b'\n', lines.encode()) + b'\t'.join(body.split()))
    (tmp_path / 'c.ply').write_bytes(head + end + b'\n\n'.join(body.split()))
    first, *others = (read_cloud(tmp_path / f'{name}.ply').points for name in 'abc')
    for other in others:
        np.testing.assert_array_equal(first, other)


def test_binary_ply_with_lists_inside_and_elements_before(tmp_path):
    for data in corpus.ply_texts()[4:]:
        (tmp_path / 'a.ply').write_bytes(data)
        assert len(read_cloud(tmp_path / 'a.ply').points) == 12


@pytest.mark.parametrize('length', [3000, 100_000])
def test_long_comments_and_names_are_no_matter(tmp_path, length):
    data = corpus.ply_texts()[0]
    for extra in (b'comment ' + b'a' * length + b'\n', b'property float ' + b'b' * length + b'\n'):
        head, place, body = data.partition(b'property float x\n')
        tokens = body.partition(b'end_header\n')
        numbers = (
            tokens[2] if extra.startswith(b'comment') else b'\n'.join(b'7 ' + row for row in tokens[2].splitlines())
        )
        (tmp_path / 'a.ply').write_bytes(head + extra + place + tokens[0] + tokens[1] + numbers)
        np.testing.assert_allclose(read_cloud(tmp_path / 'a.ply').points, corpus.SHORT, atol=1e-4)


@pytest.mark.parametrize('kind', ['ply', 'pcd', 'xyz', 'npy', 'las', 'laz', 'bin'])
@given(data=st.data())
def test_no_cut_file_is_taken_for_a_whole_one(tmp_path_factory, kind, data):
    folder = tmp_path_factory.getbasetemp() / f'cut_{kind}'
    folder.mkdir(exist_ok=True)
    name = 'points3D.bin' if kind == 'bin' else f'cloud.{kind}'
    seed = data.draw(st.sampled_from(corpus.files()[name]))
    end = data.draw(st.integers(0, len(seed.rstrip()) - (8 if kind == 'xyz' else 2)))
    (folder / name).write_bytes(seed)
    whole = read_cloud(folder / name).points
    (folder / name).write_bytes(seed[:end])
    try:
        cut = read_cloud(folder / name).points
    except InputError:
        return
    # whole rows of text, the last digits of a text, and the bytes after the last chunk are not missed
    assert kind in ('xyz', 'ply', 'pcd', 'laz')
    assert np.array_equal(cut[:-1], whole[: len(cut) - 1])


def test_pcd_fields_of_any_order_type_and_case(tmp_path):
    for data in corpus.pcd_texts():
        (tmp_path / 'a.pcd').write_bytes(data)
        cloud = read_cloud(tmp_path / 'a.pcd')
        expected = corpus.SHORT.copy()
        if b'_ y' in data:
            expected[:, 1] = 7
            assert (cloud.colors == np.array([16, 32, 48]) / 255).all()
        np.testing.assert_allclose(cloud.points, expected, atol=1e-4)


def test_lzf_follows_no_reference_out_of_the_data():
    packed = bytes([2]) + b'abc' + bytes([2 << 5, 2])  # three as they are, then four from three back
    data = np.zeros(7, np.uint8)
    assert inflate(np.frombuffer(packed, np.uint8), data) == 7
    assert data.tobytes() == b'abcabca'
    for wrong in (packed[:-1], bytes([2 << 5, 0]), packed + b'\x00', bytes([31])):
        assert inflate(np.frombuffer(wrong, np.uint8), data) == -1


ROWS = [[1.5, 2.25, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, -9.0]]


@pytest.mark.parametrize(
    'text',
    [
        '1.5 2.25 3\n4 5 6\n7 8 -9\n',
        '1.5,2.25,3\r\n4,5,6\r\n7,8,-9',
        '1.5;2.25;3\n4;5;6\n7;8;-9',
        '1,5;2,25;3\n4;5;6\n7;8;-9',
        '1,5 2,25 3,0\n4,0 5,0 6,0\n7,0 8,0 -9,0',
        '1.5\t2.25\t3\n4\t5\t6\n7\t8\t-9',
        '1.5 | 2.25 | 3\n4|5|6\n7|8|-9',
        '3\n1.5 2.25 3\n4 5 6\n7 8 -9',
        '\ufeff# a comment\n\n"x","y","z"\n1.5,2.25,3\n4,5,6\n7,8,-9',
        'x y z\n1.5 2.25 3\n4 5 6 # here\n// and there\n7 8 -9',
        'id;z [m];y;x\n1;3;2.25;1.5\n2;6;5;4\n3;-9;8;7',
        'Easting,Northing,Height\n1.5,2.25,3\n4,5,6\n7,8,-9',
        'Points:0,Points:1,Points:2\n1.5,2.25,3\n4,5,6\n7,8,-9',
        '   1.5   2.25   3.0e0\n 4  5  6\n 7 8 -9E0\n\n\n',
        'x,y,z,label\n1.5,2.25,3,\n4,5,6,\n7,8,-9,',
    ],
)
@pytest.mark.parametrize('encoding', ['utf-8', 'utf-16'])
def test_text_with_any_separator_header_mark_and_count(tmp_path, text, encoding):
    (tmp_path / 'a.csv').write_bytes(text.lstrip('\ufeff' if encoding == 'utf-16' else '').encode(encoding))
    if text.startswith('x,y,z,label'):
        with pytest.raises(InputError, match='names 4 columns and holds 3'):
            read_cloud(tmp_path / 'a.csv')
        return
    assert read_cloud(tmp_path / 'a.csv').points.tolist() == ROWS


@pytest.mark.parametrize(
    ('text', 'complaint'),
    [
        ('4\n1 2 3\n4 5 6\n7 8 9', 'ends early .3 of 4'),
        ('2\n1 2 3\n4 5 6\n7 8 9', 'first line counts 2'),
        ('1 2 3\n4 5 6\n7 8', 'ends early .row 3'),
        ('1 2 3\n4 5\n7 8 9', 'row 2 of the data has 2 columns'),
        ('1 2 3\n4 five 6\n7 8 9', "'five' stands where a number is due"),
        ('1 2 3\n4 5 6.7.8\n7 8 9', 'stands where a number is due'),
        ('1 2\n3 4', 'no rows of numbers'),
        ('x y\n', 'no rows of numbers'),
        ('x,z,i\n1,2,3', 'no field|has no'),
    ],
)
def test_text_that_is_not_whole_is_refused(tmp_path, text, complaint):
    (tmp_path / 'a.xyz').write_text(text)
    if text.startswith('x,z,i'):  # a header that names no cloud is a comment
        assert read_cloud(tmp_path / 'a.xyz').points.tolist() == [[1, 2, 3]]
        return
    with pytest.raises(InputError, match=complaint):
        read_cloud(tmp_path / 'a.xyz')


@pytest.mark.parametrize(
    ('columns', 'colored', 'directed'),
    [
        ([COLORS * 255], True, False),
        ([COLORS], True, False),
        ([NORMALS], False, True),
        ([COLORS * 255, NORMALS], True, True),
        ([NORMALS, COLORS * 255], True, True),
        ([np.full((500, 1), -123.5), COLORS * 255], True, False),
        ([COLORS * 255, np.full((500, 1), 0.5)], True, False),
        ([POINTS * 100], False, False),
    ],
)
def test_unnamed_columns_are_told_by_what_they_hold(tmp_path, columns, colored, directed):
    np.savetxt(tmp_path / 'a.txt', np.hstack([POINTS, *columns]), fmt='%.8g')
    cloud = read_cloud(tmp_path / 'a.txt')
    assert (cloud.colors is not None, cloud.normals is not None) == (colored, directed)
    if colored:
        np.testing.assert_allclose(cloud.colors, COLORS, atol=1e-6)
    if directed:
        np.testing.assert_allclose(cloud.normals, NORMALS, atol=1e-6)


def test_an_npz_bomb_is_refused_before_it_is_inflated(tmp_path):
    import tracemalloc
    import zipfile

    np.savez_compressed(tmp_path / 'a.npz', points=POINTS, huge=np.zeros(1))
    header = b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (4000000, 3), }"
    with (
        zipfile.ZipFile(tmp_path / 'b.npz', 'w', zipfile.ZIP_DEFLATED) as archive,
        archive.open('points.npy', 'w') as file,
    ):
        file.write(header.ljust(127) + b'\n')
        for _ in range(96):
            file.write(bytes(10**6))
    tracemalloc.start()
    with pytest.raises(InputError, match='no measured cloud'):
        read_cloud(tmp_path / 'b.npz')
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()
    assert len(read_cloud(tmp_path / 'a.npz').points) == 500


def test_colmap_models_and_their_folder(tmp_path):
    (tmp_path / 'points3D.bin').write_bytes(corpus.colmap_models()[0])
    for path in (tmp_path, tmp_path / 'points3D.bin'):
        cloud = read_cloud(path)
        np.testing.assert_allclose(cloud.points, corpus.SHORT)
        assert (cloud.colors[0] == np.array([1, 2, 3]) / 255).all()


@pytest.mark.parametrize('kind', ['stl', 'obj', 'glb', 'off'])
def test_meshes_are_sampled_evenly_over_their_faces(tmp_path, kind):
    import trimesh

    trimesh.creation.box((1, 2, 4)).export(tmp_path / f'box.{kind}')
    cloud = read_cloud(tmp_path / f'box.{kind}')
    outside = np.abs(cloud.points) / (0.5, 1.0, 2.0)
    np.testing.assert_allclose(outside.max(1), 1.0, atol=1e-5)
    face = outside.argmax(1)
    shares = np.bincount(face) / len(face)
    np.testing.assert_allclose(shares, np.array([8, 4, 2]) / 14, atol=0.01)  # the areas of the faces across x, y, z
    assert (np.abs(cloud.normals)[np.arange(len(face)), face] > 0.999).all()


@pytest.mark.parametrize(
    ('name', 'text'),
    [
        ('depth.txt', '500 0 2 0 400 1 0 0 1'),
        ('camera.json', json.dumps({'fx': 500, 'fy': 400, 'cx': 2, 'cy': 1})),
        ('depth.json', json.dumps({'intrinsic_matrix': [500, 0, 0, 0, 400, 0, 2, 1, 1]})),
        ('camera_info.yaml', 'k: [500, 0, 2, 0, 400, 1, 0, 0, 1]\ndepth_scale: 1000'),
    ],
)
def test_a_depth_image_with_its_camera(tmp_path, name, text):
    from PIL import Image

    depth = np.zeros((3, 5), np.uint16)
    depth[1, 2], depth[2, 4] = 1500, 65535
    Image.fromarray(depth).save(tmp_path / 'depth.png')
    with pytest.raises(InputError, match='matrix of its camera'):
        read_cloud(tmp_path / 'depth.png')
    (tmp_path / name).write_text(text)
    z = 65.535
    np.testing.assert_allclose(read_cloud(tmp_path / 'depth.png').points, [[0, 0, 1.5], [2 * z / 500, z / 400, z]])
    (tmp_path / name).write_text(text.replace('500', '-5'))
    with pytest.raises(InputError, match='no camera matrix'):
        read_cloud(tmp_path / 'depth.png')


@pytest.mark.parametrize('suffix', ['.ply', '.pcd', '.npy', '.xyz', '.npz', '.laz'])
def test_a_cloud_comes_in_parts_too(tmp_path, suffix):
    write_cloud(tmp_path / f'a{suffix}', POINTS, COLORS)
    whole, parts = read_cloud(tmp_path / f'a{suffix}'), list(chunks(tmp_path / f'a{suffix}', 120))
    assert [len(part.points) for part in parts] == [120, 120, 120, 120, 20]
    np.testing.assert_array_equal(np.concatenate([part.points for part in parts]), whole.points)
    if whole.colors is not None:
        np.testing.assert_array_equal(np.concatenate([part.colors for part in parts]), whole.colors)


def test_a_pcd_whose_header_lies_about_its_memory_is_refused_at_once(tmp_path):
    data = corpus.pcd_texts()[2].replace(b'12\n', b'4000000000\n').replace(b'HEIGHT 4000000000', b'HEIGHT 1')
    (tmp_path / 'a.pcd').write_bytes(data)
    with pytest.raises(InputError, match=r'a\.pcd'):
        read_cloud(tmp_path / 'a.pcd')
    start = data.partition(b'DATA binary_compressed\n')
    (tmp_path / 'b.pcd').write_bytes(
        start[0] + start[1] + struct.pack('<II', 100, 4000000000 * 12 % 2**32) + bytes(100)
    )
    with pytest.raises(InputError, match=r'b\.pcd'):
        read_cloud(tmp_path / 'b.pcd')
