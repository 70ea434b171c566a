"""The sparse model of COLMAP: points3D.bin or points3D.txt, with colours."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from csgm_ros.errors import InputError
from csgm_ros.io.cloud_file import CloudFile

POINT = struct.Struct('<Q3d3BdQ')  # id, position, colour, reprojection error, length of the track
TRACK_ITEM = 8
TEXT_COLUMNS = 8


def read(path: Path) -> CloudFile:
    """Read the points of a sparse model; see :mod:`csgm_ros.io.formats`."""
    rows = _binary(path.read_bytes()) if path.suffix.lower() == '.bin' else _text(path.read_text(encoding='utf-8'))
    if not rows:
        raise InputError('holds no points')
    table = np.array(rows, float)
    return CloudFile(table[:, :3].copy(), np.clip(table[:, 3:] / 255.0, 0.0, 1.0))


def _binary(data: bytes) -> list[tuple]:
    if len(data) < 8:
        raise InputError('is shorter than the header of a COLMAP model; copy or write it again')
    (count,), place, rows = struct.unpack_from('<Q', data), 8, []
    if count > (len(data) - 8) // POINT.size:
        raise InputError(f'ends early (at most {(len(data) - 8) // POINT.size} of {count} points can be there)')
    for number in range(count):
        if place + POINT.size > len(data):
            raise InputError(f'ends early ({number} of {count} points are there); copy or write it again')
        _, x, y, z, red, green, blue, _, track = POINT.unpack_from(data, place)
        place += POINT.size + TRACK_ITEM * track
        rows.append((x, y, z, red, green, blue))
    if place != len(data):
        raise InputError('ends elsewhere than its last point does; copy or write it again')
    return rows


def _text(text: str) -> list[tuple]:
    rows = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith('#'):
            continue
        if len(words) < TEXT_COLUMNS or len(words) % 2:  # the track is made of pairs
            raise InputError(f'line {number} has {len(words)} columns, which no point of COLMAP has; write it again')
        rows.append(tuple(float(word) for word in words[1:7]))
    return rows
