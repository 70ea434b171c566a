"""LAS and LAZ of laser scanners, by laspy (compressed: with lazrs)."""

from __future__ import annotations

import io
from pathlib import Path
from typing import BinaryIO

import laspy
import numpy as np

from csgm_ros.errors import InputError
from csgm_ros.io.cloud_file import CloudFile, full_brightness

MAX_POINTS_PER_BYTE = 50  # of a compressed file: what repeated points may come to
SMALLEST_HEADER = 227
FINEST = 1e-8
COUNT_LIMIT = 2.0**31 - 2  # coordinates are stored as 32-bit integers


def read(path: Path) -> CloudFile:
    """Read coordinates and colours; see :mod:`csgm_ros.io.formats`."""
    size = path.stat().st_size
    if size < SMALLEST_HEADER:
        raise InputError('is shorter than the header of a LAS file; copy or write it again')
    with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as reader:
        header = reader.header
        rows, row_bytes = header.point_count, header.point_format.size
        if rows == 0:
            raise InputError('holds no points')
        left = size - header.offset_to_point_data
        there = left * MAX_POINTS_PER_BYTE if header.are_points_compressed else left // row_bytes
        if there < rows:
            raise InputError(f'ends early ({max(there, 0)} of {rows} points can be there); copy or write it again')
        points = reader.read_points(rows)
        if len(points) != rows:
            raise InputError(f'ends early ({len(points)} of {rows} points are there); copy or write it again')
    scales, origin = np.array(header.scales), np.array(header.offsets)
    if not (np.isfinite(scales).all() and np.isfinite(origin).all() and (scales != 0).all()):
        raise InputError('its header holds no usable scale and offset; write it again')
    stored = np.stack([points[axis] for axis in 'XYZ'], axis=1)
    colors = None
    if {'red', 'green', 'blue'} <= set(header.point_format.dimension_names):
        colors = np.stack([points[name] for name in ('red', 'green', 'blue')], axis=1).astype(float)
        colors = colors / full_brightness(colors, floats=False) if colors.any() else None
    return CloudFile(stored * scales + origin, colors, None, origin)


def write(file: BinaryIO, cloud: CloudFile, ending: str) -> None:
    """Write LAS 1.4 from the cloud's own offset, as finely as 32 bits allow; points that are not finite are left out.

    Raises
    ------
    InputError
        When there is no finite point.
    """
    kept = np.isfinite(cloud.points).all(1)
    points = cloud.points[kept]
    if not len(points):
        raise InputError('holds no finite point')
    header = laspy.LasHeader(version='1.4', point_format=6 if cloud.colors is None else 7)
    middle = (points.min(0) + points.max(0)) / 2
    origin = np.floor(middle) if cloud.origin is None else np.asarray(cloud.origin, float)
    reach = np.abs(points - origin).max()
    if reach > 1e6 * np.ptp(points, axis=0).max():
        origin = middle  # an offset that far away would eat up the digits
        reach = np.abs(points - origin).max()
    step = max(10.0 ** np.ceil(np.log10(max(reach, 1e-300) / COUNT_LIMIT)), min(FINEST, max(reach, 1e-300) / 1e6))
    header.offsets, header.scales = origin, np.full(3, step)
    las = laspy.LasData(header)
    las.points = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
    for axis, column in zip('XYZ', np.rint((points - origin) / step).astype(np.int32).T, strict=True):
        las.points[axis] = column
    if cloud.colors is not None:
        for name, column in zip(('red', 'green', 'blue'), np.rint(65535 * cloud.colors[kept]).T, strict=True):
            las.points[name] = column.astype(np.uint16)
    las.update_header()
    buffer = io.BytesIO()  # laspy closes what it writes to
    las.write(buffer, do_compress=ending == '.laz', laz_backend=laspy.LazBackend.Lazrs)
    file.write(buffer.getbuffer())
