"""E57 of laser scanners: all scans in the frame of the file, read by libE57 (pye57)."""

from __future__ import annotations

import mmap
import os
import struct
from pathlib import Path
from typing import Any

import numpy as np

from csgm_ros.errors import InputError
from csgm_ros.io.apart import done_apart
from csgm_ros.io.cloud_file import CloudFile, full_brightness

HEADER = struct.Struct('<8sII4Q')  # version, length of the file, place and length of its XML, bytes of a page
PAGE = 1024
POINT_BYTES = 3  # a byte a coordinate, of which no more than the file's size can be there
PART = 1 << 20  # points read at a time
SPARE = 1 << 28  # bytes that the library may take beside the points
SECONDS, SPEED = 10, 1 << 20  # CPU time of the library, and bytes of the file for each further second

CARTESIAN = ('cartesianX', 'cartesianY', 'cartesianZ')
SPHERICAL = ('sphericalRange', 'sphericalAzimuth', 'sphericalElevation')
COLORS = ('colorRed', 'colorGreen', 'colorBlue')


def read(path: Path) -> CloudFile:
    """Read the valid points of all scans, and their colours where all have them."""
    import pye57  # noqa: F401  # before the fork

    with path.open('rb') as file:
        size = os.fstat(file.fileno()).st_size
        _check(file.read(HEADER.size), size)
    most = size // POINT_BYTES
    shared = _memory(16 + 48 * most)
    count, colored = np.frombuffer(shared, np.int64, 2)[:, None]
    points, colors = np.frombuffer(shared, float, 6 * most, 16).reshape(2, most, 3)

    def work() -> None:
        count[0], colored[0] = _scans(path, points, colors)

    if not done_apart(work, shared.size() + SPARE, SECONDS + size // SPEED):
        raise InputError('its scans are damaged, or none holds coordinates; copy or write it again')
    if not count[0]:
        raise InputError('holds no points')
    rows = slice(int(count[0]))
    return CloudFile(points[rows], np.clip(np.nan_to_num(colors[rows]), 0.0, 1.0) if colored[0] else None)


def _memory(size: int) -> mmap.mmap:
    """Return memory to share with a child, of which only what is written to is taken."""
    descriptor = os.memfd_create('e57')
    try:
        os.ftruncate(descriptor, size)
        return mmap.mmap(descriptor, size)
    finally:
        os.close(descriptor)


def _check(start: bytes, size: int) -> None:
    """Check the header against the size of the file."""
    if len(start) < HEADER.size or start[:8] != b'ASTM-E57':
        raise InputError('does not begin as an E57 file does; copy or write it again')
    _, major, _, length, place, xml, page = HEADER.unpack(start)
    if size < length:
        raise InputError(f'ends early ({size} of {length} bytes are there); copy or write it again')
    if major != 1 or page != PAGE or length % PAGE or not HEADER.size <= place < size or not 0 < xml <= size:
        raise InputError('its header is not that of an E57 file; copy or write it again')


def _scans(path: Path, points: np.ndarray, colors: np.ndarray) -> tuple[int, bool]:
    """Fill in what all scans hold; return how many points that is, and whether all of them have colours."""
    from pye57 import libe57

    image = libe57.ImageFile(str(path), 'r')
    scans = image.root()['data3D']
    filled, colored = 0, True
    for index in range(scans.childCount()):
        scan = scans[index]
        declared = scan['points'].childCount()
        if declared > len(points) - filled:
            raise InputError('declares more points than can be there')
        rows = slice(filled, filled + declared)
        found, has_colors = _scan(libe57, image, scan, points[rows], colors[rows])
        filled, colored = filled + found, colored and has_colors
    return filled, colored


def _scan(libe57, image, scan, points: np.ndarray, colors: np.ndarray) -> tuple[int, bool]:
    """Fill in the valid points of one scan, part by part; return how many, and whether they have colours."""
    stored = scan['points']
    prototype = libe57.StructureNode(stored.prototype())
    names = next(names for names in (CARTESIAN, SPHERICAL) if _defined(prototype, names))
    state = names[0].removesuffix('X').removesuffix('Range') + 'InvalidState'
    has_colors = _defined(prototype, COLORS)
    wanted = [*names, *(COLORS if has_colors else ()), *([state] if prototype.isDefined(state) else [])]
    columns = {name: np.zeros(PART) for name in wanted}
    buffers: Any = libe57.VectorSourceDestBuffer()
    for name, column in columns.items():
        buffers.append(libe57.SourceDestBuffer(image, name, column, PART, True, True))
    reader = stored.reader(buffers)
    rotation, translation = _pose(scan)
    seen = filled = 0
    while count := reader.read():
        seen += count
        valid = columns[state][:count] == 0 if state in columns else np.ones(count, bool)
        rows = slice(filled, filled + int(valid.sum()))
        own = np.stack([columns[name][:count][valid] for name in names], axis=1)
        own = own if names is CARTESIAN else _cartesian(own)
        points[rows] = np.einsum('ij,nj->ni', rotation, own) + translation  # without BLAS, whose threads fork ends
        if has_colors:
            colors[rows] = np.stack([columns[name][:count][valid] for name in COLORS], axis=1)
        filled = rows.stop
    if seen != stored.childCount():
        raise InputError('a scan ends early')
    if has_colors:
        low, high = _color_limits(scan, colors[:filled])
        colors[:filled] = (colors[:filled] - low) / np.maximum(high - low, np.finfo(float).tiny)
    return filled, has_colors


def _defined(node, names: tuple[str, ...]) -> bool:
    return all(node.isDefined(name) for name in names)


def _cartesian(spherical: np.ndarray) -> np.ndarray:
    reach, azimuth, elevation = spherical.T
    level = reach * np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), reach * np.sin(elevation)], axis=1)


def _pose(scan) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation and translation from the scan's frame to the file's."""
    rotation, translation = np.eye(3), np.zeros(3)
    if scan.isDefined('pose') and scan['pose'].isDefined('rotation'):
        w, x, y, z = (scan['pose']['rotation'][name].value() for name in 'wxyz')
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        rotation = np.eye(3) + 2 * (w * cross + cross @ cross) / (w * w + x * x + y * y + z * z)
    if scan.isDefined('pose') and scan['pose'].isDefined('translation'):
        translation = np.array([scan['pose']['translation'][name].value() for name in 'xyz'])
    return rotation, translation


def _color_limits(scan, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the darkest and the brightest value of each colour as the scan says, else by what is usual."""
    if not scan.isDefined('colorLimits'):
        whole = bool((colors == np.rint(colors)).all())
        return np.zeros(3), np.full(3, full_brightness(colors, floats=not whole))
    limits = scan['colorLimits']
    low, high = ([limits[f'{name}{end}'].value() for name in COLORS] for end in ('Minimum', 'Maximum'))
    return np.array(low, float), np.array(high, float)
