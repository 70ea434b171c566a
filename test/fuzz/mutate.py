"""Seeded damage: what transfers, full disks, other tools and ill will do to a file."""

import re

import numpy as np

NUMBERS = (
    b'0',
    b'-1',
    b'1',
    b'255',
    b'65536',
    b'2147483648',
    b'4294967295',
    b'18446744073709551615',
    b'1e308',
    b'nan',
    b'1000000000000',
)
WORDS = (
    *(
        b'property list uchar int x\n',
        b'property list float float q\n',
        b'element vertex 1\n',
        b'end_header\n',
        b'list',
    ),
    *(b'double', b'uchar', b'ascii', b'binary_big_endian', b'DATA binary\n', b'binary_compressed', b'FIELDS x y z\n'),
    *(
        b'nan',
        b'inf',
        b'\x00',
        b'\xff\xfe',
        b'#',
        b'"',
        b',',
        b';',
        b'\n',
        b'\r',
        b': ',
        b'&a ',
        b'*a ',
        b'- ',
        b'!!',
        b'[',
        b'{',
    ),
    b'A' * 5000,
)


def mutated(data: bytes, others: list[bytes], rng: np.random.Generator) -> bytes:
    """Return ``data`` with one to four kinds of damage."""
    for _ in range(int(rng.integers(1, 5))):
        data = DAMAGES[int(rng.integers(len(DAMAGES)))](data, others, rng)
    return data


def _place(data: bytes, rng) -> int:
    """Anywhere, but more often in the first part, where headers are."""
    reach = len(data) if rng.random() < 0.5 else min(len(data), 400)
    return int(rng.integers(0, reach + 1))


def _cut(data, _, rng):
    return data[: _place(data, rng)] if rng.random() < 0.5 else data[: int(len(data) * rng.random())]


def _flip(data, _, rng):
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 6))):
        if out:
            out[min(_place(data, rng), len(out) - 1)] ^= 1 << int(rng.integers(8))
    return bytes(out)


def _overwrite(data, _, rng):
    at, size = _place(data, rng), int(rng.integers(1, 9))
    fill = (b'\xff' * size, b'\x00' * size, b'\x7f' + b'\xff' * (size - 1), rng.bytes(size))[int(rng.integers(4))]
    return data[:at] + fill + data[at + size :]


def _insert(data, _, rng):
    at, word = _place(data, rng), WORDS[int(rng.integers(len(WORDS)))]
    return data[:at] + word + data[at:]


def _remove(data, _, rng):
    at = _place(data, rng)
    return data[:at] + data[at + int(rng.integers(1, 64)) :]


def _repeat(data, _, rng):
    at, size = _place(data, rng), int(rng.integers(1, 200))
    return data[: at + size] + data[at : at + size] * int(rng.integers(1, 4)) + data[at + size :]


def _splice(data, others, rng):
    other = others[int(rng.integers(len(others)))]
    return data[: _place(data, rng)] + other[_place(other, rng) :]


def _renumber(data, _, rng):
    found = list(re.finditer(rb'\d+', data[:4000]))
    if not found:
        return data
    match = found[int(rng.integers(len(found)))]
    return data[: match.start()] + NUMBERS[int(rng.integers(len(NUMBERS)))] + data[match.end() :]


def _swap_lines(data, _, rng):
    lines = data.split(b'\n')
    first, second = rng.integers(0, min(len(lines), 25), 2)
    lines[first], lines[second] = lines[second], lines[first]
    return b'\n'.join(lines)


DAMAGES = (_cut, _flip, _flip, _overwrite, _insert, _remove, _repeat, _splice, _renumber, _renumber, _swap_lines)
