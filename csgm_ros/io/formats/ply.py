"""Stanford PLY: text or binary of either byte order, any elements and properties, lists among them."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from csgm_ros.errors import InputError
from csgm_ros.io.cloud_file import WANTED, CloudFile, Table
from csgm_ros.io.formats.tokens import Tokens

TYPES = {
    **{'char': 'i1', 'uchar': 'u1', 'short': 'i2', 'ushort': 'u2', 'int': 'i4', 'uint': 'u4'},
    **{'float': 'f4', 'double': 'f8', 'int8': 'i1', 'uint8': 'u1', 'int16': 'i2', 'uint16': 'u2'},
    **{'int32': 'i4', 'uint32': 'u4', 'int64': 'i8', 'uint64': 'u8', 'float32': 'f4', 'float64': 'f8'},
}
STRUCT = {'i1': 'b', 'u1': 'B', 'i2': 'h', 'u2': 'H', 'i4': 'i', 'u4': 'I', 'i8': 'q', 'u8': 'Q', 'f4': 'f', 'f8': 'd'}
ORDERS = {'ascii': '', 'binary_little_endian': '<', 'binary_big_endian': '>'}
VERTEX = ('vertex', 'vertices', 'point', 'points')
MAX_HEADER = 1 << 20
PADDING = 4  # bytes that may follow the data: a line break, or what a writer aligned to


class Property(NamedTuple):
    """A property of an element; ``length`` is the type of a list's count, empty for a scalar."""

    name: str
    kind: str
    length: str = ''


class Element(NamedTuple):
    """An element of the header."""

    name: str
    rows: int
    properties: list[Property]

    @property
    def fixed(self) -> bool:
        """True when every row has the same size."""
        return not any(each.length for each in self.properties)

    @property
    def least(self) -> int:
        """Bytes that a row takes at least."""
        return sum(int((each.length or each.kind)[1]) for each in self.properties)


def read(path: Path) -> Table:
    """Read the vertices of a PLY file; see :mod:`csgm_ros.io.formats`."""
    with path.open('rb') as file:
        order, elements, start = header(file)
        names = [element.name for element in elements]
        index = next((names.index(name) for name in VERTEX if name in names), None)
        if index is None:
            raise InputError('has no element "vertex"; write it again')
        vertex = elements[index]
        if vertex.rows == 0:
            raise InputError('holds no points')
        if not order:
            return _text(file.read(), elements, index)
        left = os.fstat(file.fileno()).st_size - start
        if all(element.fixed for element in elements[: index + 1]):
            before = sum(element.rows * element.least for element in elements[:index])
            after = elements[index + 1 :]
            _require(vertex.rows, (left - before) // max(vertex.least, 1))
            _check_end(left - before - vertex.rows * vertex.least, after, sum(e.rows * e.least for e in after))
            return _binary(path, start + before, vertex, order)
        return _walked(file.read(), elements, index, order)


def header(file: BinaryIO) -> tuple[str, list[Element], int]:
    """Return the byte order (empty for text), the elements, and the offset of the data, where the file then stands.

    Raises
    ------
    InputError
        For what is no header of a PLY file.
    """
    beginning = file.read(MAX_HEADER)
    if not beginning:
        raise InputError('is empty; write it again')
    if beginning[:3] != b'ply' or beginning[3:4] not in (b'\r', b'\n'):
        raise InputError('does not begin as a PLY file does; write it again')
    line_end = b'\r' if beginning[3:4] == b'\r' and beginning[4:5] != b'\n' else b'\n'
    elements: list[Element] = []
    order, start = None, 4
    while True:
        end = beginning.find(line_end, start)
        if end < 0:
            raise InputError('its header has no end; write it again')
        words = beginning[start:end].decode('ascii', 'replace').split()
        start = end + 1
        if words == ['end_header']:
            break
        if words and words[0] not in ('comment', 'obj_info'):
            order = _declared(words, elements, order)
    if order is None:
        raise InputError('its header names no format; write it again')
    file.seek(start)
    return order, elements, start


def _declared(words: list[str], elements: list[Element], order: str | None) -> str | None:
    """Take one line of the header."""
    try:
        match words:
            case ['format', name, '1.0']:
                return ORDERS[name]
            case ['element', name, count] if int(count) >= 0:
                elements.append(Element(name.lower(), int(count), []))
            case ['property', 'list', length, kind, name] if TYPES[length][0] in 'iu':
                elements[-1].properties.append(Property(name.lower(), TYPES[kind], TYPES[length]))
            case ['property', kind, name]:
                elements[-1].properties.append(Property(name.lower(), TYPES[kind]))
            case _:
                raise ValueError
    except (KeyError, IndexError, ValueError):
        line = ' '.join(words)
        raise InputError(f'its header holds {line[:60]!r}, which is not PLY; write it again') from None
    return order


def _wanted(vertex: Element) -> dict[str, int]:
    """Return the properties of interest, by name, and where they stand."""
    places: dict[str, int] = {}
    for place, each in enumerate(vertex.properties):
        if each.name in WANTED and not each.length:
            if each.name in places:
                raise InputError(f'its header names the property {each.name!r} twice; write it again')
            places[each.name] = place
    return places or {each.name: place for place, each in enumerate(vertex.properties) if not each.length}


def _require(rows: int, there: int) -> None:
    if there < rows:
        raise InputError(f'ends early ({max(there, 0)} of {rows} points are there); copy or write it again')


def _check_end(left: int, after: list[Element], least: int) -> None:
    """Compare what follows the vertices with what the header says shall follow."""
    if left < least:
        raise InputError(f'ends early (within the element {_first(after)!r}); copy or write it again')
    if all(element.fixed for element in after) and left > least + PADDING:
        raise InputError('goes on after the last point that its header counts; write it again')


def _first(elements: list[Element]) -> str:
    return next((element.name for element in elements if element.rows), 'vertex')[:40]


def _binary(path: Path, start: int, vertex: Element, order: str) -> Table:
    places = _wanted(vertex)
    sizes = np.cumsum([0, *(int(each.kind[1]) for each in vertex.properties)])
    dtype = np.dtype(
        {
            'names': list(places),
            'formats': [order + vertex.properties[place].kind for place in places.values()],
            'offsets': [int(sizes[place]) for place in places.values()],
            'itemsize': int(sizes[-1]),
        }
    )

    def part(first: int, last: int) -> dict[str, np.ndarray]:
        rows = np.fromfile(path, dtype, last - first, offset=start + first * dtype.itemsize)
        _require(last, first + len(rows))  # the file may have been cut since
        return {name: rows[name] for name in places}

    return Table(vertex.rows, part)


def _text(body: bytes, elements: list[Element], index: int) -> Table:
    tokens, place = Tokens(body), 0
    for element in elements[:index]:
        place = _skip_text(tokens, place, element)
    vertex, after = elements[index], elements[index + 1 :]
    width = len(vertex.properties)
    if vertex.fixed:
        _require(vertex.rows, (len(tokens) - place) // max(width, 1))
        end = place + vertex.rows * width
        values = tokens.numbers(place, end).reshape(vertex.rows, width)
    else:
        values, end = _text_rows(tokens, place, vertex)
    _check_tokens(len(tokens) - end, after)
    columns = {}
    for name, column in _wanted(vertex).items():
        kind = np.dtype(vertex.properties[column].kind)
        taken = values[:, column]
        if kind.kind in 'iu' and name not in 'xyz':
            limits = np.iinfo(kind)
            taken = np.clip(np.nan_to_num(taken), limits.min, limits.max).astype(kind)
        columns[name] = taken.astype('f4') if name in ('rgb', 'rgba') and kind == 'f4' else taken
    return Table.of(columns)


def _check_tokens(left: int, after: list[Element]) -> None:
    least = sum(element.rows * len(element.properties) for element in after)
    if left < least:
        raise InputError(f'ends early (within the element {_first(after)!r}); copy or write it again')
    if left > least and all(element.fixed for element in after):
        raise InputError('goes on after the last point that its header counts; write it again')


def _skip_text(tokens: Tokens, place: int, element: Element) -> int:
    if element.fixed:
        return place + element.rows * len(element.properties)
    return _text_rows(tokens, place, element)[1]


def _text_rows(tokens: Tokens, place: int, element: Element) -> tuple[np.ndarray, int]:
    """Return the scalars of rows with lists, 0 in a list's place, and the token after them."""
    _require(element.rows, (len(tokens) - place) // len(element.properties))
    numbers = tokens.numbers(place, len(tokens))
    values, at = np.zeros((element.rows, len(element.properties))), 0
    for row in range(element.rows):
        for column, each in enumerate(element.properties):
            if at >= len(numbers):
                _require(element.rows, row)
            if each.length:
                at += 1 + _length(numbers[at])
            else:
                values[row, column] = numbers[at]
                at += 1
        if at > len(numbers):
            _require(element.rows, row)
    return values, place + at


def _length(value: float) -> int:
    if not (value >= 0 and value == int(value)):
        raise InputError(f'has a list of {value:g} items; write it again')
    return int(value)


def _walked(body: bytes, elements: list[Element], index: int, order: str) -> Table:
    """Read binary rows one by one, as lists give each a length of its own."""
    rows: list = []
    place = 0
    for element in elements[: index + 1]:
        if element.fixed and element is not elements[index]:
            place += element.rows * element.least
        else:
            rows, place = _rows(body, place, element, order)
    after = elements[index + 1 :]
    _check_end(len(body) - place, after, sum(element.rows * element.least for element in after))
    columns = list(zip(*rows, strict=True))
    scalars = [column for column, each in enumerate(elements[index].properties) if not each.length]
    return Table.of(
        {
            name: np.array(columns[scalars.index(column)], elements[index].properties[column].kind)
            for name, column in _wanted(elements[index]).items()
        }
    )


def _rows(body: bytes, place: int, element: Element, order: str) -> tuple[list[tuple], int]:
    """Return the scalars of every row, and the offset after them."""
    _require(element.rows, (len(body) - place) // max(element.least, 1))
    segments = _segments(element, order)
    rows = []
    for number in range(element.rows):
        row: tuple = ()
        for scalars, length, item in segments:
            if place + scalars.size + (length.size if length else 0) > len(body):
                _require(element.rows, number)
            row += scalars.unpack_from(body, place)
            place += scalars.size
            if length:
                (count,) = length.unpack_from(body, place)
                place += length.size + item * _length(count)
        if place > len(body):
            _require(element.rows, number)
        rows.append(row)
    return rows, place


def _segments(element: Element, order: str) -> list[tuple[struct.Struct, struct.Struct | None, int]]:
    """Cut a row into runs of scalars, each with the count and item size of the list that ends it."""
    segments, run = [], order
    for each in element.properties:
        if each.length:
            count = struct.Struct(order + STRUCT[each.length])
            segments.append((struct.Struct(run), count, int(each.kind[1])))
            run = order
        else:
            run += STRUCT[each.kind]
    return [*segments, (struct.Struct(run), None, 0)]


def write(file: BinaryIO, cloud: CloudFile, ending: str) -> None:
    """Write a binary PLY file with coordinates as doubles, normals as floats and colours as bytes."""
    fields = [('x', '<f8'), ('y', '<f8'), ('z', '<f8')]
    fields += [('nx', '<f4'), ('ny', '<f4'), ('nz', '<f4')] if cloud.normals is not None else []
    fields += [('red', 'u1'), ('green', 'u1'), ('blue', 'u1')] if cloud.colors is not None else []
    rows = np.empty(len(cloud.points), fields)
    parts = [cloud.points, cloud.normals, None if cloud.colors is None else np.rint(255 * cloud.colors)]
    columns = [column for part in parts if part is not None for column in np.asarray(part).T]
    for (name, _), column in zip(fields, columns, strict=True):
        rows[name] = column
    words = {'<f8': 'double', '<f4': 'float', 'u1': 'uchar'}
    lines = ['ply', 'format binary_little_endian 1.0', f'element vertex {len(rows)}']
    lines += [f'property {words[kind]} {name}' for name, kind in fields]
    file.write(('\n'.join([*lines, 'end_header']) + '\n').encode())
    file.write(rows.view(np.uint8).data)
