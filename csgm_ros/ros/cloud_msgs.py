"""Numpy to the ROS messages that leave the node; the layout itself is in :mod:`csgm_ros.io.pointcloud2`."""

from __future__ import annotations

from array import array

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Float64MultiArray, Header, MultiArrayDimension

from csgm_ros.io.pointcloud2 import encode
from csgm_ros.types import Similarity


def header(frame_id: str, stamp: int) -> Header:
    """Return a header of a stamp in nanoseconds."""
    return Header(frame_id=frame_id, stamp=Time(sec=stamp // 10**9, nanosec=stamp % 10**9))


def cloud_message(
    head: Header, points: np.ndarray, colors: np.ndarray | None = None, source_id: np.ndarray | None = None
) -> PointCloud2:
    """Return a PointCloud2; the arrays are those of :func:`csgm_ros.io.pointcloud2.encode`."""
    parts = encode(points, colors, source_id)
    fields = [PointField(name=name, offset=offset, datatype=code, count=1) for name, offset, code in parts['fields']]
    data = array('B')
    data.frombytes(memoryview(parts['data']))  # the setter copies anything else byte by byte
    return PointCloud2(**{**parts, 'header': head, 'fields': fields, 'data': data})


def transform_message(head: Header, child_frame: str, transform: Similarity) -> TransformStamped:
    """Return the rigid part: rotation, and the translation of the already scaled source."""
    message = TransformStamped(header=head, child_frame_id=child_frame)
    rotation, translation = message.transform.rotation, message.transform.translation
    rotation.x, rotation.y, rotation.z, rotation.w = quaternion(transform.rotation)
    translation.x, translation.y, translation.z = map(float, transform.translation)
    return message


def quaternion(rotation: np.ndarray) -> tuple[float, float, float, float]:
    """Return (x, y, z, w) with w >= 0 of a (3, 3) rotation matrix."""
    from scipy.spatial.transform import Rotation  # heavy, and only needed once there is a result

    x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True)
    return float(x), float(y), float(z), float(w)


def matrix_message(matrix: np.ndarray) -> Float64MultiArray:
    """Return a matrix row by row, its layout labelled ``rows`` and ``columns``."""
    rows, columns = matrix.shape
    message = Float64MultiArray(data=[float(value) for value in matrix.ravel()])
    message.layout.dim = [
        MultiArrayDimension(label='rows', size=rows, stride=rows * columns),
        MultiArrayDimension(label='columns', size=columns, stride=columns),
    ]
    return message
