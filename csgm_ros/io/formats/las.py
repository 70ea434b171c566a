"""LAS and LAZ of laser scanners: read by the header's layout, points unpacked by lazrs, written by laspy."""

from __future__ import annotations

import io
import mmap
import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from csgm_ros.errors import InputError
from csgm_ros.io.apart import done_apart
from csgm_ros.io.cloud_file import CloudFile, Table, full_brightness

HEADER = struct.Struct('<4s20xBB64x4xHIIBHI20x6d48x')  # LAS 1.0 to 1.4, up to the bounding box
COUNT_PLACE = 247  # of the 64-bit count of LAS 1.4
RECORD_BYTES = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
COLOR_PLACE = {2: 20, 3: 28, 5: 28, 7: 30, 8: 30, 10: 30}
VLR = struct.Struct('<2x16sHH32x')
LASZIP = struct.Struct('<2xH8xI16xH')  # coder, chunk size, items
LASZIP_ITEM = struct.Struct('<HHH')
COMPRESSED = 0x80  # flag in the point format
VARIABLE = 2**32 - 1  # chunk size of chunks of different sizes
MAX_INFLATION = 300  # of a compressed file: what repeated points may come to
SPARE = 1 << 28  # bytes that the decompressor may take beside the points
FINEST = 1e-8
COUNT_LIMIT = 2.0**31 - 2  # coordinates are stored as 32-bit integers


@dataclass(frozen=True)
class Header:
    """What the header of a LAS file declares, checked against the size of the file.

    Attributes
    ----------
    rows : int
    start : int
        Offset of the point data.
    kind, row_bytes : int
        Point format and bytes a point.
    scales, origin : (3,) ndarray
        Coordinates are ``stored * scales + origin``.
    laszip : bytes or None
        What the decompressor is told; None for plain points.
    """

    rows: int
    start: int
    kind: int
    row_bytes: int
    scales: np.ndarray
    origin: np.ndarray
    laszip: bytes | None


def read(path: Path) -> CloudFile:
    """Read coordinates and colours; see :mod:`csgm_ros.io.formats`."""
    with path.open('rb') as file:
        declared = header(file, os.fstat(file.fileno()).st_size)
        file.seek(declared.start)
        packed = declared.laszip is not None
        data = _unpacked(path, declared) if packed else file.read(declared.rows * declared.row_bytes)
    fields: Any = {'names': ['xyz'], 'formats': ['(3,)<i4'], 'offsets': [0], 'itemsize': declared.row_bytes}
    if declared.kind in COLOR_PLACE:
        fields['names'] += ['rgb']
        fields['formats'] += ['(3,)<u2']
        fields['offsets'] += [COLOR_PLACE[declared.kind]]
    rows: Any = np.frombuffer(data, np.dtype(fields), declared.rows)
    colors = None
    if declared.kind in COLOR_PLACE and rows['rgb'].any():
        colors = rows['rgb'] / full_brightness(rows['rgb'], floats=False)
    return CloudFile(rows['xyz'] * declared.scales + declared.origin, colors, None, declared.origin)


def coordinates(path: Path) -> Table | CloudFile:
    """Read coordinates alone; of plain points only when they are asked for, as of files larger than memory."""
    with path.open('rb') as file:
        declared = header(file, os.fstat(file.fileno()).st_size)
    if declared.laszip is not None:
        return read(path)
    fields: Any = {'names': ['xyz'], 'formats': ['(3,)<i4'], 'offsets': [0], 'itemsize': declared.row_bytes}

    def part(first: int, last: int) -> dict[str, np.ndarray]:
        start = declared.start + first * declared.row_bytes
        packed: Any = np.fromfile(path, np.dtype(fields), last - first, offset=start)
        rows = packed['xyz']
        if len(rows) != last - first:  # the file may have been cut since
            raise InputError('ends early; copy or write it again')
        return dict(zip('xyz', (rows * declared.scales + declared.origin).T, strict=True))

    return Table(declared.rows, part)


def header(file: BinaryIO, size: int) -> Header:
    """Read and check the header.

    Raises
    ------
    InputError
        For what is no LAS file, or one that is cut.
    """
    start = file.read(COUNT_PLACE + 8)
    if len(start) < HEADER.size or start[:4] != b'LASF':
        raise InputError('does not begin as a LAS file does; copy or write it again')
    _, major, minor, header_size, offset, records, kind, row_bytes, rows, *numbers = HEADER.unpack_from(start)
    if (major, minor) >= (1, 4) and len(start) == COUNT_PLACE + 8:
        (rows,) = struct.unpack_from('<Q', start, COUNT_PLACE)
    packed, kind = bool(kind & COMPRESSED), kind & 0x3F
    scales, origin = np.array(numbers[:3]), np.array(numbers[3:])
    sizes_fit = HEADER.size <= header_size <= offset <= size and records * VLR.size <= offset - header_size
    if kind >= len(RECORD_BYTES) or row_bytes < RECORD_BYTES[kind] or major != 1 or not sizes_fit:
        raise InputError('its header is not that of a LAS file, or the file is cut; copy or write it again')
    if not (np.isfinite(scales).all() and np.isfinite(origin).all() and (scales != 0.0).all()):
        raise InputError('its header holds no usable scale and offset; write it again')
    if rows == 0:
        raise InputError('holds no points')
    there = (size - offset) * (MAX_INFLATION if packed else 1) // row_bytes
    if there < rows:
        raise InputError(f'ends early ({max(there, 0)} of {rows} points can be there); copy or write it again')
    laszip = None
    if packed:
        file.seek(header_size)
        laszip = _laszip(file.read(offset - header_size), records)
        file.seek(offset)
        _check_chunks(file, size, rows, row_bytes, laszip)
    return Header(rows, offset, kind, row_bytes, scales, origin, laszip)


def _laszip(data: bytes, records: int) -> bytes:
    """Return the record of the compressor."""
    place = 0
    for _ in range(records):
        if place + VLR.size > len(data):
            break
        user, number, length = VLR.unpack_from(data, place)
        place += VLR.size
        if user.rstrip(b'\0') == b'laszip encoded' and number == 22204 and place + length <= len(data):
            return data[place : place + length]
        place += length
    raise InputError('says that it is compressed, but not how; copy or write it again')


def _check_chunks(file: BinaryIO, size: int, rows: int, row_bytes: int, laszip: bytes) -> None:
    """Check what the decompressor would believe: the layout of a point, and the number of its chunks."""
    damaged = InputError('its compressed data is damaged or cut; copy or write it again')
    if len(laszip) < LASZIP.size:
        raise damaged
    _, chunk_size, items = LASZIP.unpack_from(laszip)
    if len(laszip) != LASZIP.size + items * LASZIP_ITEM.size:
        raise damaged
    sizes = [LASZIP_ITEM.unpack_from(laszip, LASZIP.size + index * LASZIP_ITEM.size)[1] for index in range(items)]
    start = file.tell()
    place = struct.unpack('<q', file.read(8).ljust(8, b'\0'))[0]
    if place == -1:
        file.seek(size - 8)
        place = struct.unpack('<q', file.read(8))[0]
    if sum(sizes) != row_bytes or chunk_size == 0 or not start + 8 <= place <= size - 8:
        raise damaged
    file.seek(place)
    _, chunks = struct.unpack('<II', file.read(8))
    if chunks > rows or (chunk_size != VARIABLE and chunks != -(-rows // chunk_size)):
        raise damaged


def _unpacked(path: Path, declared: Header) -> np.ndarray:
    """Decompress all points in a process of their own: on damaged data the decompressor may take it down."""
    import lazrs

    shared = mmap.mmap(-1, declared.rows * declared.row_bytes)
    data = np.frombuffer(shared, np.uint8)

    def decompress() -> None:
        with path.open('rb') as file:
            file.seek(declared.start)
            lazrs.LasZipDecompressor(file, declared.laszip).decompress_many(data)

    if not done_apart(decompress, 2 * data.size + SPARE):
        raise InputError('its compressed data is damaged or cut; copy or write it again')
    return data


def write(file: BinaryIO, cloud: CloudFile, ending: str) -> None:
    """Write LAS 1.4 from the cloud's own offset, as finely as 32 bits allow; points that are not finite are left out.

    Raises
    ------
    InputError
        When there is no finite point.
    """
    import laspy

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
