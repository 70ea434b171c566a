"""What the header of a PLY or PCD file promises: Open3D fills what a cut file lacks with arbitrary memory."""

from __future__ import annotations

from pathlib import Path

from csgm_ros.errors import InputError

PLY_BYTES = {
    **dict.fromkeys(('char', 'uchar', 'int8', 'uint8'), 1),
    **dict.fromkeys(('short', 'ushort', 'int16', 'uint16'), 2),
    **dict.fromkeys(('int', 'uint', 'float', 'int32', 'uint32', 'float32'), 4),
    **dict.fromkeys(('double', 'float64'), 8),
}


def check_complete(path: Path) -> None:
    """Refuse a PLY or PCD file that holds fewer points than its header says.

    Parameters
    ----------
    path : Path
        An existing file whose name ends with .ply or .pcd.

    Raises
    ------
    InputError
        When the header is not one, or the data ends early.
    """
    header, end = _header(path)
    try:
        text, rows, row_bytes = (_ply_promise if path.suffix.lower() == '.ply' else _pcd_promise)(header)
    except (KeyError, IndexError, ValueError, StopIteration):
        raise InputError(
            f'{path}: its header is not that of a {path.suffix[1:].upper()} file; write it again'
        ) from None
    if rows == 0:
        raise InputError(f'{path}: holds no points')
    there = rows
    if text:
        with path.open('rb') as file:
            file.seek(end)
            there = sum(1 for line in file if line.strip())
    elif row_bytes:
        there = (path.stat().st_size - end) // row_bytes
    if there < rows:
        raise InputError(f'{path}: ends early ({there} of {rows} rows are there); copy or write it again')


def _header(path: Path) -> tuple[list[list[str]], int]:
    """Return the words of each header line and the byte offset of the data."""
    last = b'end_header' if path.suffix.lower() == '.ply' else b'DATA'
    lines, size = [], 0
    with path.open('rb') as file:
        for line in file:
            size += len(line)
            lines.append(line.decode('ascii', 'replace').split())
            if line.startswith(last):
                return [words for words in lines if words], size
            if len(lines) > 1000 or size > 100_000:
                break
    return [], 0


def _ply_promise(header: list[list[str]]) -> tuple[bool, int, int]:
    """Return (text, rows, bytes a row) up to the last vertex; a list property before it leaves only a lower bound."""
    if header[0] != ['ply']:
        raise ValueError('magic')
    text = next(words[1] for words in header if words[0] == 'format') == 'ascii'
    elements: list[list] = []
    for words in header:
        if words[0] == 'element':
            elements.append([words[1], int(words[2]), 0])
        elif words[0] == 'property':
            elements[-1][2] += PLY_BYTES[words[2]] if words[1] == 'list' else PLY_BYTES[words[1]]
    names = [element[0] for element in elements]
    vertices = elements[names.index('vertex')]
    before = sum(rows for _, rows, _ in elements[: names.index('vertex')])
    return text, vertices[1] + (before if text and vertices[1] else 0), vertices[2]


def _pcd_promise(header: list[list[str]]) -> tuple[bool, int, int]:
    """Return (text, rows, bytes a row); compressed data is left to the reader, which notices."""
    fields = {words[0]: words[1:] for words in header}
    rows = int(fields['POINTS'][0]) if 'POINTS' in fields else int(fields['WIDTH'][0]) * int(fields['HEIGHT'][0])
    counts = [int(count) for count in fields.get('COUNT', ['1'] * len(fields['SIZE']))]
    kind = fields['DATA'][0]
    sizes = [int(size) for size in fields['SIZE']]
    row_bytes = sum(count * size for count, size in zip(counts, sizes, strict=True)) if kind == 'binary' else 0
    return kind == 'ascii', rows, row_bytes
