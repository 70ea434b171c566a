"""PCD of the Point Cloud Library: text, binary and compressed, fields of any order, type and case."""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from csgm_ros.errors import InputError
from csgm_ros.io.cloud_file import WANTED, CloudFile, Table
from csgm_ros.io.formats.tokens import Tokens

MAX_HEADER = 1 << 20
SIZES = {'F': (4, 8), 'I': (1, 2, 4, 8), 'U': (1, 2, 4, 8)}
MAX_INFLATION = 90  # LZF copies at most 264 bytes for 3
FLOAT_LOSS = 1e-6  # of the extent: what coordinates may lose before they are written as doubles


@dataclass(frozen=True)
class Header:
    """What the header of a PCD file declares.

    Attributes
    ----------
    fields : list of (str, str, int)
        Lower-case name, numpy kind, and items a point.
    rows : int
    storage : str
        ``ascii``, ``binary`` or ``binary_compressed``.
    start : int
        Offset of the data.
    """

    fields: list[tuple[str, str, int]]
    rows: int
    storage: str
    start: int

    @property
    def sizes(self) -> list[int]:
        """Bytes a point of each field."""
        return [int(kind[1]) * count for _, kind, count in self.fields]

    @property
    def wanted(self) -> dict[str, int]:
        """The fields of interest, by name, and where they stand."""
        places: dict[str, int] = {}
        for place, (name, _, count) in enumerate(self.fields):
            if name in WANTED and count == 1:
                if name in places:
                    raise InputError(f'its header names the field {name!r} twice; write it again')
                places[name] = place
        missing = [name for name in 'xyz' if name not in places]
        if missing:
            there = ', '.join(name for name, _, _ in self.fields)[:200]
            raise InputError(f'has no field {missing[0]!r}; its fields are {there}')
        return places


def read(path: Path) -> Table:
    """Read a PCD file; see :mod:`csgm_ros.io.formats`."""
    with path.open('rb') as file:
        declared = header(file)
        if declared.rows == 0:
            raise InputError('holds no points')
        if declared.storage == 'ascii':
            return _text(file.read(), declared)
        if declared.storage == 'binary_compressed':
            return _compressed(file.read(), declared)
        return _binary(path, os.fstat(file.fileno()).st_size - declared.start, declared)


def header(file: BinaryIO) -> Header:
    """Read the header; the file then stands at the data.

    Raises
    ------
    InputError
        For what is no header of a PCD file.
    """
    beginning, start = file.read(MAX_HEADER), 0
    if not beginning:
        raise InputError('is empty; write it again')
    entries: dict[str, list[str]] = {}
    while 'DATA' not in entries:
        end = beginning.find(b'\n', start)
        if end < 0:
            raise InputError('its header has no DATA line, so it is no PCD file; write it again')
        words = beginning[start:end].decode('ascii', 'replace').split()
        start = end + 1
        if words and not words[0].startswith('#'):
            entries[words[0].upper()] = words[1:]
    file.seek(start)
    try:
        return _declared(entries, start)
    except (KeyError, IndexError, ValueError):
        raise InputError('its header is not that of a PCD file; write it again') from None


def _declared(entries: dict[str, list[str]], start: int) -> Header:
    names = entries['FIELDS'] if 'FIELDS' in entries else entries['COLUMNS']
    sizes = [int(size) for size in entries['SIZE']]
    types = [kind.upper() for kind in entries.get('TYPE', ['F'] * len(names))]
    counts = [int(count) for count in entries.get('COUNT', ['1'] * len(names))]
    storage = entries['DATA'][0].lower()
    if storage not in ('ascii', 'binary', 'binary_compressed') or min(counts) < 0:
        raise ValueError
    fields = []
    for name, size, kind, count in zip(names, sizes, types, counts, strict=True):
        if size not in SIZES[kind]:
            raise ValueError
        fields.append((name.lower(), kind.lower() + str(size), count))
    shape = [int(entries[key][0]) for key in ('WIDTH', 'HEIGHT')] if 'WIDTH' in entries else []
    rows = int(entries['POINTS'][0]) if 'POINTS' in entries else shape[0] * shape[1]
    if rows < 0 or (shape and shape[0] * shape[1] != rows):
        raise InputError(f'its header counts {rows} points in {" x ".join(map(str, shape))}; write it again')
    return Header(fields, rows, storage, start)


def _require(rows: int, there: int) -> None:
    if there < rows:
        raise InputError(f'ends early ({max(there, 0)} of {rows} points are there); copy or write it again')


def _binary(path: Path, left: int, declared: Header) -> Table:
    places, sizes = declared.wanted, declared.sizes
    _require(declared.rows, left // sum(sizes))
    dtype = np.dtype(
        {
            'names': list(places),
            'formats': ['<' + declared.fields[place][1] for place in places.values()],
            'offsets': [sum(sizes[:place]) for place in places.values()],
            'itemsize': sum(sizes),
        }
    )

    def part(first: int, last: int) -> dict[str, np.ndarray]:
        rows = np.fromfile(path, dtype, last - first, offset=declared.start + first * dtype.itemsize)
        _require(last, first + len(rows))  # the file may have been cut since
        return {name: rows[name] for name in places}

    return Table(declared.rows, part)


def _text(body: bytes, declared: Header) -> Table:
    tokens, width = Tokens(body), sum(count for _, _, count in declared.fields)
    places = declared.wanted
    _require(declared.rows, len(tokens) // width)
    if len(tokens) > declared.rows * width:
        raise InputError('goes on after the last point that its header counts; write it again')
    values = tokens.numbers(0, declared.rows * width).reshape(declared.rows, width)
    columns = {}
    for name, place in places.items():
        kind = np.dtype(declared.fields[place][1])
        column = values[:, sum(count for _, _, count in declared.fields[:place])]
        if kind.kind in 'iu':
            limits = np.iinfo(kind)
            column = np.clip(np.nan_to_num(column), limits.min, limits.max).astype(kind)
        columns[name] = column.astype(kind) if name in ('rgb', 'rgba') else column
    return Table.of(columns)


def _compressed(body: bytes, declared: Header) -> Table:
    places, sizes = declared.wanted, declared.sizes
    if len(body) < 8:
        _require(declared.rows, 0)
    packed, size = struct.unpack_from('<II', body)
    if len(body) - 8 < packed:
        raise InputError(f'ends early ({len(body) - 8} of {packed} compressed bytes are there); copy or write it again')
    if size != declared.rows * sum(sizes):
        raise InputError(f'holds {size} bytes where its header counts {declared.rows * sum(sizes)}; write it again')
    if size > MAX_INFLATION * packed:
        raise InputError(f'cannot hold {declared.rows} points in {packed} bytes; write it again')
    data = np.empty(size, np.uint8)
    if _inflater()(np.frombuffer(body, np.uint8, packed, 8), data) != size:
        raise InputError('its compressed data is damaged; copy or write it again')
    columns = {}
    for name, place in places.items():
        start = declared.rows * sum(sizes[:place])
        columns[name] = data[start : start + declared.rows * sizes[place]].view('<' + declared.fields[place][1])
    return Table.of(columns)


def _inflater():
    """Return ``inflate(packed, data)``, which undoes LZF and returns the bytes written, -1 for damaged data."""
    from csgm_ros.io.formats.lzf import inflate

    return inflate


def write(file: BinaryIO, cloud: CloudFile, ending: str) -> None:
    """Write a binary PCD file; coordinates are floats, as PCL reads them, where that loses nothing to speak of."""
    kind = 'F4' if _fits_float(cloud.points) else 'F8'
    fields = [(name, kind) for name in 'xyz']
    fields += [(f'normal_{axis}', 'F4') for axis in 'xyz'] if cloud.normals is not None else []
    fields += [('rgb', 'F4')] if cloud.colors is not None else []
    rows = np.empty(len(cloud.points), [(name, '<' + kind.lower()) for name, kind in fields])
    for index, axis in enumerate('xyz'):
        rows[axis] = cloud.points[:, index]
        if cloud.normals is not None:
            rows[f'normal_{axis}'] = cloud.normals[:, index]
    if cloud.colors is not None:
        red, green, blue = np.rint(255 * np.asarray(cloud.colors)).astype('<u4').T
        rows['rgb'] = (red << 16 | green << 8 | blue).view('<f4')
    lines = [
        '# .PCD v0.7 - Point Cloud Data file format',
        'VERSION 0.7',
        'FIELDS ' + ' '.join(name for name, _ in fields),
        'SIZE ' + ' '.join(kind[1] for _, kind in fields),
        'TYPE ' + ' '.join(kind[0] for _, kind in fields),
        'COUNT ' + ' '.join('1' for _ in fields),
        f'WIDTH {len(rows)}',
        'HEIGHT 1',
        'VIEWPOINT 0 0 0 1 0 0 0',
        f'POINTS {len(rows)}',
        'DATA binary',
    ]
    file.write(('\n'.join(lines) + '\n').encode())
    file.write(rows.view(np.uint8).data)


def _fits_float(points: np.ndarray) -> bool:
    finite = points[np.isfinite(points).all(1)]
    if not len(finite):
        return True
    with np.errstate(over='ignore'):
        loss = np.abs(finite - finite.astype('f4')).max()
    return bool(loss <= FLOAT_LOSS * np.ptp(finite, axis=0).max())
