"""PointCloud2 to numpy and back, for any layout a driver sends; no ROS import.

Works on anything with the message's attributes: the ROS message and what ``rosbags`` decodes from a file.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any

import numpy as np

from csgm_ros.errors import InputError
from csgm_ros.types import Cloud

DATATYPES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}
MAX_POINTS = 2**31 - 1  # of a message, where the caller does not say
MAX_NAME = 255  # characters of a frame_id
SHOWN_NAME, SHOWN_NAMES = 40, 20  # characters of a name and names that a message to a person quotes
COARSE = 1e-5  # of a cloud's extent: what rounding a coordinate may move a point by, 1 mm in 100 m
FLOAT32_MAX = float(np.finfo(np.float32).max)
CODES = {code: number for number, code in DATATYPES.items()}


def stamp_of(message: Any) -> int:
    """Return the header's stamp in nanoseconds."""
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def check_layout(message: Any, max_points: int = MAX_POINTS) -> np.dtype:
    """Return the structured dtype that reads the message, without touching its points.

    Parameters
    ----------
    message : PointCloud2-like
    max_points : int
        Points from which a message is refused. No two coordinates share a byte, so decoding costs at most nine
        times the bytes of a message, and twice those of one with float32 coordinates alone.

    Raises
    ------
    InputError
        When sizes, steps and fields contradict each other, when a coordinate is missing, or when there are
        no points or too many. The message says which.
    """
    fields = {field.name: field for field in message.fields}
    missing = [name for name in 'xyz' if name not in fields]
    if missing:
        raise InputError(f'cloud has no field {missing[0]!r}; its fields are {listed(fields)}')
    if message.width * message.height == 0:
        raise InputError(f'cloud has no points (width {message.width}, height {message.height})')
    if len(message.header.frame_id) > MAX_NAME:
        raise InputError(f'the frame_id has {len(message.header.frame_id)} characters; it may have {MAX_NAME}')
    if message.header.stamp.nanosec >= 10**9:
        raise InputError(f'the stamp has {message.header.stamp.nanosec} nanoseconds in a second')
    wanted = ['x', 'y', 'z', *color_fields(fields)]
    formats = [field_format(fields[name], message) for name in wanted]
    if overlapping(fields, formats):
        raise InputError('the fields x, y and z overlap; the driver lays its message out wrongly')
    needed = row_step_of(message) * (message.height - 1) + message.point_step * message.width
    if len(message.data) < needed:
        raise InputError(f'cloud holds {len(message.data)} bytes of data; its size and steps ask for {needed}')
    if message.point_step >= 2**31:
        raise InputError(f'point step {message.point_step} is above 2147483647 bytes')
    if message.width * message.height > max_points:
        raise InputError(f'cloud has {message.width * message.height} points; max_points is {max_points}')
    offsets = [fields[name].offset for name in wanted]
    return np.dtype({'names': wanted, 'formats': formats, 'offsets': offsets, 'itemsize': message.point_step})


def listed(names: Iterable[str]) -> str:
    """Return names for a message to a person, which a hostile message cannot flood."""
    names = list(names)
    shown = [name if len(name) <= SHOWN_NAME else f'{name[:SHOWN_NAME]}...' for name in names[:SHOWN_NAMES]]
    left = len(names) - len(shown)
    return (', '.join(shown) or 'none') + (f' and {left} more' if left else '')


def overlapping(fields: dict[str, Any], formats: list[str]) -> bool:
    """Return True where two coordinates share a byte."""
    spans = sorted((fields[name].offset, np.dtype(code).itemsize) for name, code in zip('xyz', formats, strict=False))
    return any(start + size > following[0] for (start, size), following in itertools.pairwise(spans))


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
    points = np.empty((rows.size, 3))
    finite = np.ones(rows.size, bool)
    for column, axis in enumerate('xyz'):
        points[:, column].reshape(rows.shape)[...] = rows[axis]
        finite &= np.isfinite(points[:, column])
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
    names = (rows.dtype.names or ())[3:]
    if not names:
        return None
    colors = np.empty((rows.size, 3), np.uint8)
    if len(names) == 3:
        for column, name in enumerate(names):
            colors[:, column] = rows[name].ravel()
        return colors
    packed = rows[names[0]].ravel()
    for column, shift in enumerate((16, 8, 0)):
        colors[:, column] = packed >> shift & 0xFF
    return colors


def encode(points: np.ndarray, colors: np.ndarray | None = None, source_id: np.ndarray | None = None) -> dict[str, Any]:
    """Lay points out as PointCloud2 attributes: x y z, and if given rgb and source_id.

    The coordinates are float32, as every tool reads them; float64 where that would move points, as in a projected
    map frame: :func:`needs_double`.

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
    kind = 'f8' if needs_double(points) else 'f4'
    size = int(kind[1])
    at = 3 * size
    layout = [(name, kind, column * size) for column, name in enumerate('xyz')]
    layout += [('rgb', 'f4', at)] if colors is not None else []
    layout += [('source_id', 'u1', at + 4)] if source_id is not None else []
    step = at + (4 if source_id is None else 8)
    data = np.zeros((height * width, step), np.uint8)
    data[:, :at] = np.ascontiguousarray(points.reshape(-1, 3), f'<{kind}').view(np.uint8)
    if colors is not None:
        data[:, at : at + 3] = colors.reshape(-1, 3)[:, ::-1]
    if source_id is not None:
        data[:, at + 4] = source_id.ravel()
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


def needs_double(points: np.ndarray) -> bool:
    """Return True where float32 steps in coarser ways than :data:`COARSE` of the cloud's extent, or overflows."""
    points = points.reshape(-1, 3)
    if points.dtype == np.float32 or not len(points):
        return False
    with np.errstate(invalid='ignore'):
        low, high = np.nanmin(points, axis=0, initial=np.inf), np.nanmax(points, axis=0, initial=-np.inf)
    extent, reach = float((high - low).max()), float(np.maximum(np.abs(low), np.abs(high)).max())
    if not np.isfinite(reach):
        return False
    if reach > FLOAT32_MAX:
        return True
    return float(np.spacing(np.float32(reach))) > COARSE * extent
