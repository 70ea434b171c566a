"""Clouds as text: columns between any separators, with or without a header, a count line or a byte order mark."""

from __future__ import annotations

import codecs
import re
from pathlib import Path
from typing import BinaryIO

import numpy as np

from csgm_ros.errors import InputError
from csgm_ros.io.cloud_file import WANTED, CloudFile, Table, full_brightness
from csgm_ros.io.formats.tokens import Tokens

MARKS = ((codecs.BOM_UTF8, 'utf-8-sig'), (codecs.BOM_UTF16_LE, 'utf-16'), (codecs.BOM_UTF16_BE, 'utf-16'))
COMMENT = re.compile(rb'(#|//|%|!)[^\r\n]*')
DECIMAL_COMMA = re.compile(rb'[+-]?\d+,\d+(?:[eE][+-]?\d+)?')
SYNONYMS = {
    **dict.fromkeys(('easting', 'east', 'e', 'points:0', 'points_0', 'px', 'pos_x', 'coord_x', 'x_coord'), 'x'),
    **dict.fromkeys(('northing', 'north', 'n', 'points:1', 'points_1', 'py', 'pos_y', 'coord_y', 'y_coord'), 'y'),
    **dict.fromkeys(('elevation', 'height', 'altitude', 'alt', 'h', 'up'), 'z'),
    **dict.fromkeys(('points:2', 'points_2', 'pz', 'pos_z', 'coord_z', 'z_coord'), 'z'),
    **{'normalx': 'nx', 'normaly': 'ny', 'normalz': 'nz'},
}
PREAMBLE = 64  # lines before the numbers, at most
UNIT_TOLERANCE = 0.02
CHUNK = 100_000  # rows written at a time


def read(path: Path) -> Table:
    """Read columns of text; see :mod:`csgm_ros.io.formats`."""
    text = path.read_bytes()
    for mark, encoding in MARKS:
        if text.startswith(mark):
            text = text.decode(encoding).encode()
    if not text.strip():
        raise InputError('is empty; write it again')
    names, count, body = _preamble(text)
    values = _values(body)
    if count is not None and len(values) < count:
        raise InputError(f'ends early ({len(values)} of {count} points are there); copy or write it again')
    if count is not None and len(values) > count:
        raise InputError(f'holds {len(values)} points where its first line counts {count}; write it again')
    return Table.of(_named(values, names))


def _preamble(text: bytes) -> tuple[list[str], int | None, bytes]:
    """Return the names of the columns, the number of points where a line says it, and the text of the numbers."""
    names: list[str] = []
    count, start = None, 0
    for _ in range(PREAMBLE):
        end = min((place for mark in (b'\n', b'\r') if (place := text.find(mark, start)) >= 0), default=len(text))
        line = text[start:end].strip()
        if _is_row(line):
            return names, count, text[start:]
        if line.isdigit():
            count = int(line)
        elif line:
            found = [SYNONYMS.get(word, word) for word in _words(line)]
            names = found if {'x', 'y', 'z'} <= set(found) else names
        start = end + 1
        if start >= len(text):
            break
    raise InputError('holds no rows of numbers x, y, z; write it again')


def _is_row(line: bytes) -> bool:
    """Return True for a line of three numbers or more."""
    try:
        return len(line) > 0 and len([float(word) for word in _separated(line).split()]) >= 3
    except ValueError:
        return False


def _words(line: bytes) -> list[str]:
    """Return the lower-case column names of a header line, units in brackets left out."""
    text = re.sub(r'\[.*?\]|\(.*?\)', '', line.decode('utf-8', 'replace').lower()).lstrip('#/%!; \t')
    parts = re.split(r'[,;|\t]', text) if re.search(r'[,;|\t]', text) else text.split()
    return [part.strip().strip('"\'').strip() for part in parts]


def _separated(text: bytes) -> bytes:
    """Return numbers between spaces, an empty field as nan."""
    first = text.split(b'\n', 1)[0]
    words = first.split()
    if (
        b';' in first
        or (b'\t' in first and b',' in first and b'.' not in first)
        or (len(words) >= 3 and all(DECIMAL_COMMA.fullmatch(word) for word in words))
    ):
        text = text.replace(b',', b'.')
    for mark in (b',', b';', b'|', b'\t'):
        if mark in first:
            for _ in range(2):  # the second time for every other one of a row of marks
                text = re.sub(rb'%b[ ]*(?=%b)' % (re.escape(mark), re.escape(mark)), mark + b'nan', text)
    return text.translate(bytes.maketrans(b',;|\t"\'', b'      '))


def _values(body: bytes) -> np.ndarray:
    """Return the (N, columns) numbers; every line must hold as many.

    Raises
    ------
    InputError
        Naming the first line that does not.
    """
    body = body.replace(b'\r\n', b'\n').replace(b'\r', b'\n')
    if any(mark in body for mark in (b'#', b'//', b'%', b'!')):
        body = COMMENT.sub(b'', body)
    body = _separated(body)
    tokens = Tokens(body)
    line_ends = np.flatnonzero(np.frombuffer(body, np.uint8) == 10)
    widths = np.diff(np.searchsorted(tokens.starts, np.concatenate([[0], line_ends, [len(body)]])))
    filled = np.flatnonzero(widths)
    width = int(widths[filled[0]])
    odd = filled[widths[filled] != width]
    if len(odd):
        where = f'row {int(np.searchsorted(filled, odd[0])) + 1} of the data'
        if odd[0] == filled[-1] and widths[odd[0]] < width:
            raise InputError(f'ends early ({where} has {widths[odd[0]]} of {width} columns); copy or write it again')
        raise InputError(f'{where} has {widths[odd[0]]} columns, those before it {width}; write it again')
    return tokens.numbers(0, len(tokens)).reshape(-1, width)


def _named(values: np.ndarray, names: list[str]) -> dict[str, np.ndarray]:
    """Return the columns of interest by name; where the file names none, colours and normals by what they hold."""
    if names:
        if len(names) != values.shape[1]:
            raise InputError(f'names {len(names)} columns and holds {values.shape[1]}; write it again')
        return {name: values[:, place] for place, name in enumerate(names) if name in WANTED}
    columns = dict(zip('xyz', values.T[:3], strict=True))
    for start in range(3, values.shape[1] - 2):
        kind = _kind(values[:, start : start + 3])
        if kind == 'color' and 'red' not in columns:
            columns |= dict(zip(('red', 'green', 'blue'), values.T[start : start + 3], strict=True))
        elif kind == 'normal' and 'nx' not in columns:
            columns |= dict(zip(('nx', 'ny', 'nz'), values.T[start : start + 3], strict=True))
    return columns


def _kind(triple: np.ndarray) -> str:
    """Return ``normal``, ``color`` or nothing for three unnamed columns."""
    if not np.isfinite(triple).all():
        return ''
    if np.mean(np.abs(np.linalg.norm(triple, axis=1) - 1.0) < UNIT_TOLERANCE) > 0.95:
        return 'normal'
    whole = bool((triple == np.rint(triple)).all())
    limit = full_brightness(triple, floats=True)
    inside = triple.min() >= 0.0 and triple.max() <= limit
    return 'color' if inside and (whole if limit > 1.0 else not whole or not triple.any()) else ''


def write(file: BinaryIO, cloud: CloudFile, ending: str) -> None:
    """Write rows of x y z, then red green blue from 0 to 255, then nx ny nz, where the cloud has them.

    A .csv file gets a header and commas. 15 significant digits keep a tenth of a micrometre at 5,000 km.
    """
    parts, names, shape = [cloud.points], 'x y z', '%.15g %.15g %.15g'
    if cloud.colors is not None:
        parts.append(np.rint(255 * cloud.colors))
        names, shape = names + ' red green blue', shape + 3 * ' %d'
    if cloud.normals is not None:
        parts.append(cloud.normals)
        names, shape = names + ' nx ny nz', shape + 3 * ' %.7g'
    table = np.concatenate(parts, axis=1)
    if ending == '.csv':
        file.write((names.replace(' ', ',') + '\n').encode())
        shape = shape.replace(' ', ',')
    for first in range(0, len(table), CHUNK):
        rows = table[first : first + CHUNK]
        file.write(((shape + '\n') * len(rows) % tuple(rows.ravel())).encode())
