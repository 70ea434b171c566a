"""PointCloud2 to numpy and back, for any layout a driver sends; no ROS import.

Works on anything with the message's attributes: the ROS message and what ``rosbags`` decodes from a file.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from csgm_ros.errors import InputError
from csgm_ros.types import Cloud

DATATYPES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}
CODES = {code: number for number, code in DATATYPES.items()}


def stamp_of(message: Any) -> int:
    """Return the header's stamp in nanoseconds."""
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def check_layout(message: Any) -> np.dtype:
    """Return the structured dtype that reads the message, without touching its points.

    Raises
    ------
    InputError
        When sizes, steps and fields contradict each other, when a coordinate is missing, or when there are
        no points. The message says which.
    """
    fields = {field.name: field for field in message.fields}
    missing = [name for name in 'xyz' if name not in fields]
    if missing:
        raise InputError(f'cloud has no field {missing[0]!r}; its fields are {", ".join(fields) or "none"}')
    if message.width * message.height == 0:
        raise InputError(f'cloud has no points (width {message.width}, height {message.height})')
    wanted = ['x', 'y', 'z', *color_fields(fields)]
    dtype = np.dtype(
        {
            'names': wanted,
            'formats': [field_format(fields[name], message) for name in wanted],
            'offsets': [fields[name].offset for name in wanted],
            'itemsize': message.point_step,
        }
    )
    needed = row_step_of(message) * (message.height - 1) + message.point_step * message.width
    if len(message.data) < needed:
        raise InputError(f'cloud holds {len(message.data)} bytes of data; its size and steps ask for {needed}')
    return dtype


def color_fields(fields: dict[str, Any]) -> list[str]:
    """Return the names of the fields that hold the colour, none where it cannot be read."""
    for name in ('rgb', 'rgba'):
        if name in fields and fields[name].datatype in (5, 6, 7):
            return [name]
    if all(name in fields and fields[name].datatype == 2 for name in 'rgb'):
        return ['r', 'g', 'b']
    return []


def field_format(field: Any, message: Any) -> str:
    """Return the numpy format of one field in the message's byte order."""
    if field.datatype not in DATATYPES:
        raise InputError(f'field {field.name!r} has datatype {field.datatype}; PointField knows 1 to 8')
    code = DATATYPES[field.datatype]
    if field.count > 1:
        raise InputError(f'field {field.name!r} has count {field.count}, not 1')
    if field.offset + int(code[1]) > message.point_step:
        raise InputError(f'field {field.name!r} ends past the point step of {message.point_step} bytes')
    if field.name in ('rgb', 'rgba'):
        code = 'u4'  # packed bits, whatever type the field claims
    return ('>' if message.is_bigendian else '<') + code


def row_step_of(message: Any) -> int:
    """Return the bytes from row to row; some drivers leave the field 0."""
    packed = message.point_step * message.width
    if message.height == 1 or message.row_step == 0:
        return packed
    if message.row_step < packed:
        raise InputError(f'row step {message.row_step} is below point step times width, {packed}')
    return message.row_step


def decode(message: Any) -> Cloud:
    """Read a PointCloud2-like message, organised or not, of either byte order and any padding.

    ``is_dense`` is not believed: real drivers set it wrongly.

    Raises
    ------
    InputError
        As :func:`check_layout`, and when no point is finite.
    """
    dtype = check_layout(message)
    rows = np.ndarray(
        (message.height, message.width),
        dtype,
        np.frombuffer(message.data, np.uint8),
        strides=(row_step_of(message), message.point_step),
    )
    points = np.stack([rows[axis].astype(np.float64).ravel() for axis in 'xyz'], axis=1)
    finite = np.isfinite(points).all(axis=1)
    dropped = len(points) - int(finite.sum())
    if dropped == len(points):
        raise InputError(f'none of the {len(points)} points of the cloud is finite')
    colors = decode_colors(rows)
    if dropped:
        points = points[finite]
        colors = None if colors is None else colors[finite]
    return Cloud(points, colors, message.header.frame_id, stamp_of(message), dropped)


def decode_colors(rows: np.ndarray) -> np.ndarray | None:
    """Return (N, 3) uint8 colours from packed ``rgb`` or separate fields; None without any."""
    names = rows.dtype.names[3:]
    if not names:
        return None
    if len(names) == 3:
        return np.stack([rows[name].ravel() for name in names], axis=1)
    packed = rows[names[0]].ravel()
    return np.stack([(packed >> shift & 0xFF).astype(np.uint8) for shift in (16, 8, 0)], axis=1)


def encode(points: np.ndarray, colors: np.ndarray | None = None, source_id: np.ndarray | None = None) -> dict[str, Any]:
    """Lay points out as PointCloud2 attributes: x y z float32, and if given rgb and source_id.

    Parameters
    ----------
    points : (N, 3) or (H, W, 3) ndarray
        An organised (H, W, 3) cloud keeps its rows; NaN marks a missing point.
    colors : ndarray of uint8, same shape, optional
        Packed into a float32 field ``rgb``, as PCL and RViz read it.
    source_id : ndarray of uint8, one a point, optional
        Which cloud the point is from.

    Returns
    -------
    dict
        ``height``, ``width``, ``fields`` as (name, offset, datatype), ``is_bigendian``, ``point_step``,
        ``row_step``, ``data`` ((bytes,) uint8 ndarray), ``is_dense``.
    """
    height, width = points.shape[:2] if points.ndim == 3 else (1, len(points))
    layout = [('x', 'f4', 0), ('y', 'f4', 4), ('z', 'f4', 8)]
    layout += [('rgb', 'f4', 12)] if colors is not None else []
    layout += [('source_id', 'u1', 16)] if source_id is not None else []
    step = 20 if source_id is not None else 16
    data = np.zeros((height * width, step), np.uint8)
    data[:, :12] = np.ascontiguousarray(points.reshape(-1, 3), '<f4').view(np.uint8)
    if colors is not None:
        data[:, 12:15] = colors.reshape(-1, 3)[:, ::-1]
    if source_id is not None:
        data[:, 16] = source_id.ravel()
    return {
        'height': height,
        'width': width,
        'fields': [(name, offset, CODES[code]) for name, code, offset in layout],
        'is_bigendian': False,
        'point_step': step,
        'row_step': step * width,
        'data': data.ravel(),
        'is_dense': bool(np.isfinite(points).all()),
    }
