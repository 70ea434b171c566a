"""PointCloud2 in every layout a driver sends, and merging; the ROS message itself where rclpy is there."""

import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from csgm_ros.cloud.merge import merge
from csgm_ros.cloud.voxels import lattice_origin
from csgm_ros.errors import InputError
from csgm_ros.io.pointcloud2 import CODES, check_layout, decode, encode
from csgm_ros.types import Cloud, Similarity


def laid_out(points, *, order='<', kind='f4', before=0, after=4, row_padding=0, height=1, colors=None, dense=True):
    """Return a message with the given layout; ``points`` (height * width, 3)."""
    size = np.dtype(kind).itemsize
    names, offset, fields, columns = 'xyz', before, [], {}
    for axis, name in enumerate(names):
        fields.append(SimpleNamespace(name=name, offset=offset, datatype=CODES[kind], count=1))
        columns[name] = (order + kind, offset, points[:, axis])
        offset += size
    if colors is not None:
        fields.append(SimpleNamespace(name='rgb', offset=offset, datatype=CODES['f4'], count=1))
        packed = colors.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
        columns['rgb'] = (order + 'u4', offset, packed)
        offset += 4
    step = offset + after
    dtype = np.dtype(
        {
            'names': list(columns),
            'formats': [column[0] for column in columns.values()],
            'offsets': [column[1] for column in columns.values()],
            'itemsize': step,
        }
    )
    width = len(points) // height
    records = np.zeros((height, width), dtype)
    for name, column in columns.items():
        records[name] = column[2].reshape(height, width)
    rows = np.full((height, width * step + row_padding), 0xAB, np.uint8)
    rows[:, : width * step] = records.view(np.uint8).reshape(height, -1)
    return SimpleNamespace(
        header=SimpleNamespace(frame_id='camera', stamp=SimpleNamespace(sec=3, nanosec=4)),
        height=height,
        width=width,
        fields=fields,
        is_bigendian=order == '>',
        point_step=step,
        row_step=width * step + row_padding,
        data=rows.ravel(),
        is_dense=dense,
    )


POINTS = np.random.default_rng(0).normal(size=(24, 3)) * 3
COLORS = np.random.default_rng(1).integers(0, 256, (24, 3)).astype(np.uint8)


@settings(max_examples=60, deadline=None)
@given(
    order=st.sampled_from('<>'),
    kind=st.sampled_from(['f4', 'f8']),
    before=st.integers(0, 9),
    after=st.integers(0, 17),
    row_padding=st.integers(0, 33),
    height=st.sampled_from([1, 2, 4, 24]),
    colored=st.booleans(),
    dense=st.booleans(),
)
def test_every_layout_holds_the_same_points(order, kind, before, after, row_padding, height, colored, dense):
    colors = COLORS if colored else None
    cloud = decode(
        laid_out(
            POINTS,
            order=order,
            kind=kind,
            before=before,
            after=after,
            row_padding=row_padding,
            height=height,
            colors=colors,
            dense=dense,
        )
    )
    np.testing.assert_array_equal(cloud.points, POINTS.astype(kind).astype(float))
    assert (cloud.colors is None) == (colors is None)
    if colored:
        np.testing.assert_array_equal(cloud.colors, COLORS)
    assert (cloud.frame_id, cloud.stamp, cloud.dropped) == ('camera', 3_000_000_004, 0)


@pytest.mark.parametrize('dense', [True, False])
def test_not_finite_points_are_dropped_whatever_is_dense_claims(dense):
    points = POINTS.copy()
    points[3, 0], points[7, 1], points[8, 2] = np.nan, np.inf, -np.inf
    cloud = decode(laid_out(points, colors=COLORS, dense=dense))
    kept = np.isfinite(points).all(axis=1)
    assert cloud.dropped == 3
    np.testing.assert_array_equal(cloud.points, points[kept].astype('f4').astype(float))
    np.testing.assert_array_equal(cloud.colors, COLORS[kept])


def test_separate_and_unreadable_colours():
    message = laid_out(POINTS, after=3)
    at = message.point_step - 3
    message.fields += [SimpleNamespace(name=name, offset=at + i, datatype=2, count=1) for i, name in enumerate('rgb')]
    message.data.reshape(-1, message.point_step)[:, at:] = COLORS
    np.testing.assert_array_equal(decode(message).colors, COLORS)
    message.fields[3].datatype = 7
    assert decode(message).colors is None


class Endless:
    """Data of any length that nobody has to hold."""

    def __len__(self):
        return 2**62


def head(frame_id='camera', sec=3, nanosec=4):
    return SimpleNamespace(frame_id=frame_id, stamp=SimpleNamespace(sec=sec, nanosec=nanosec))


@pytest.mark.parametrize(
    ('change', 'complaint'),
    [
        ({'fields': []}, "no field 'x'"),
        ({'width': 0}, 'no points'),
        ({'height': 0}, 'no points'),
        ({'point_step': 0}, 'past the point step'),
        ({'point_step': 11}, 'past the point step'),
        ({'data': np.zeros(8, np.uint8)}, 'holds 8 bytes'),
        ({'width': 2**32 - 1, 'height': 2**32 - 1}, 'row step'),
        ({'width': 2**32 - 1, 'height': 1}, 'bytes of data'),
        ({'point_step': 2**31, 'width': 1}, 'bytes of data'),
        ({'point_step': 2**32 - 1, 'data': Endless()}, 'point step 4294967295 is above'),
        ({'header': head(nanosec=10**9)}, '1000000000 nanoseconds in a second'),
        ({'header': head(frame_id='f' * 10**6)}, 'frame_id has 1000000 characters'),
    ],
)
def test_contradictions_are_named(change, complaint):
    message = laid_out(POINTS)
    vars(message).update(change)
    with pytest.raises(InputError, match=complaint):
        decode(message)


@pytest.mark.parametrize(
    ('change', 'complaint'),
    [
        ({'datatype': 99}, 'datatype 99'),
        ({'datatype': 0}, 'datatype 0'),
        ({'count': 3}, 'count 3'),
        ({'offset': 4_000_000_000}, 'past the point step'),
        ({'name': 'w'}, "no field 'z'"),
    ],
)
def test_wrong_fields_are_named(change, complaint):
    message = laid_out(POINTS)
    vars(message.fields[2]).update(change)
    with pytest.raises(InputError, match=complaint):
        check_layout(message)


def test_coordinates_that_share_bytes_and_too_many_points_are_refused():
    """A message of one byte a point would cost forty times its size."""
    message = laid_out(POINTS)
    for field in message.fields:
        field.offset, field.datatype = 0, 2
    message.point_step, message.width, message.row_step = 1, len(message.data), len(message.data)
    with pytest.raises(InputError, match='overlap'):
        check_layout(message)
    with pytest.raises(InputError, match='24 points; max_points is 23'):
        check_layout(laid_out(POINTS), 23)


def test_decoding_costs_at_most_three_times_a_message_of_float32():
    message = laid_out(np.zeros((300_000, 3)), after=0)
    tracemalloc.start()
    decode(message)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3 * len(message.data)


def test_names_of_a_hostile_message_do_not_flood_the_answer():
    message = laid_out(POINTS)
    message.fields = [SimpleNamespace(name=f'{i}' + 'n' * 10**6, offset=0, datatype=7, count=1) for i in range(50)]
    with pytest.raises(InputError, match='and 30 more') as caught:
        check_layout(message)
    assert len(str(caught.value)) < 1200


@pytest.mark.parametrize('offset', [0.0, 4.2e6])
def test_points_keep_their_place_far_from_the_origin(offset):
    """Projected map coordinates: float32 would move them by 0.25 m."""
    points = POINTS * [1.0, 1.0, 0.1] + [offset / 8, offset, 0.0]
    parts = encode(points, COLORS, np.ones(len(points), np.uint8))
    assert {code for name, _, code in parts['fields'] if name in 'xyz'} == {CODES['f8' if offset else 'f4']}
    fields = [
        SimpleNamespace(name=name, offset=offset, datatype=code, count=1) for name, offset, code in parts['fields']
    ]
    cloud = decode(SimpleNamespace(**{**parts, 'fields': fields, 'header': head()}))
    assert np.abs(cloud.points - points).max() < 1e-6
    np.testing.assert_array_equal(cloud.colors, COLORS)


def test_cloud_without_a_finite_point_is_refused():
    with pytest.raises(InputError, match='none of the 24 points'):
        decode(laid_out(np.full((24, 3), np.nan)))


@settings(max_examples=40, deadline=None)
@given(height=st.sampled_from([0, 1, 3]), width=st.integers(1, 40), colored=st.booleans(), marked=st.booleans())
def test_encoding_and_decoding_are_inverse(height, width, colored, marked):
    shape = (height, width) if height else (width,)
    rng = np.random.default_rng(width)
    points = rng.normal(size=(*shape, 3)).astype('f4')
    colors = rng.integers(0, 256, (*shape, 3)).astype(np.uint8) if colored else None
    parts = encode(points, colors, np.ones(shape, np.uint8) if marked else None)
    fields = [
        SimpleNamespace(name=name, offset=offset, datatype=code, count=1) for name, offset, code in parts['fields']
    ]
    header = SimpleNamespace(frame_id='', stamp=SimpleNamespace(sec=0, nanosec=0))
    cloud = decode(SimpleNamespace(**{**parts, 'fields': fields, 'header': header}))
    np.testing.assert_array_equal(cloud.points, points.reshape(-1, 3).astype(float))
    if colored:
        np.testing.assert_array_equal(cloud.colors, colors.reshape(-1, 3))
    assert parts['height'] == max(height, 1)


def test_ros_message_round_trip():
    pytest.importorskip('sensor_msgs.msg')
    from rclpy.serialization import deserialize_message, serialize_message
    from sensor_msgs.msg import PointCloud2

    from csgm_ros.ros.cloud_msgs import cloud_message, header

    sent = cloud_message(header('map', 1_500_000_000), POINTS, COLORS)
    heard = deserialize_message(serialize_message(sent), PointCloud2)
    assert heard == sent
    cloud = decode(heard)
    np.testing.assert_array_equal(cloud.points, POINTS.astype('f4').astype(float))
    np.testing.assert_array_equal(cloud.colors, COLORS)
    assert (cloud.frame_id, cloud.stamp) == ('map', 1_500_000_000)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_rotation_and_quaternion_agree(seed):
    pytest.importorskip('sensor_msgs.msg')
    from csgm_ros.ros.cloud_msgs import quaternion

    rng = np.random.default_rng(seed)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.linalg.det(rotation)
    found = quaternion(rotation)
    assert found[3] >= 0.0
    np.testing.assert_allclose(Similarity.from_quaternion(np.array(found), np.zeros(3)).rotation, rotation, atol=1e-12)


def test_merging_averages_each_voxel_once():
    first, second = (np.random.default_rng(seed).uniform(-1, 1, (4000, 3)) for seed in (0, 1))
    clouds = [Cloud(first, None, 'map', 5, 1), Cloud(second, None, 'map', 9, 2)]
    merged = merge(clouds, 0.05)
    assert (merged.frame_id, merged.stamp, merged.dropped) == ('map', 9, 3)
    assert 1000 < len(merged.points) < 8000
    everything = np.concatenate([first, second])
    edge = 0.05 * np.linalg.norm(everything - everything.mean(axis=0), axis=1).max()
    cells = np.floor((merged.points - lattice_origin(everything, edge)) / edge)
    assert len(np.unique(cells, axis=0)) == len(merged.points)
    assert len(merge(clouds, 0.0).points) == 8000
    assert merge(clouds[:1], 0.05) is clouds[0]


def test_merging_keeps_colours_only_where_all_have_them():
    colored, plain = Cloud(POINTS, COLORS, 'map'), Cloud(POINTS, None, 'map')
    np.testing.assert_array_equal(merge([colored, colored], 0.0).colors, np.tile(COLORS, (2, 1)))
    assert merge([colored, colored], 1e-6).colors.shape == (24, 3)
    assert merge([colored, plain], 0.0).colors is None


def test_merging_different_frames_is_refused():
    with pytest.raises(InputError, match='different frames'):
        merge([Cloud(POINTS, None, 'a'), Cloud(POINTS, None, 'b')], 0.01)
