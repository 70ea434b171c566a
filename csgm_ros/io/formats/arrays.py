"""numpy's .npy and .npz: the header is checked first, one array is read, and nothing is unpickled."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path
from typing import BinaryIO

import numpy as np

from csgm_ros.errors import InputError
from csgm_ros.io.cloud_file import CloudFile, Table, full_brightness

POINTS = ('points', 'xyz', 'vertices')
COLORS = ('colors', 'rgb')
NORMALS = ('normals',)
SUSPICIOUS = 100  # times smaller than what it inflates to: no measured cloud
HARMLESS = 1 << 26  # bytes that may inflate as they like


def read(path: Path) -> Table | CloudFile:
    """Read the (N, 3) or (H, W, 3) array of a file; see :mod:`csgm_ros.io.formats`."""
    return _archive(path) if path.suffix.lower() == '.npz' else _array_file(path)


def _array_file(path: Path) -> Table | CloudFile:
    with path.open('rb') as file:
        dtype, shape, fortran = _header(file)
        start, size = file.tell(), os.fstat(file.fileno()).st_size
    items = int(np.prod(shape, dtype=object))
    if size - start < items * dtype.itemsize:
        there = (size - start) // max(dtype.itemsize, 1)
        raise InputError(f'ends early ({there} of {items} items are there); copy or write it again')
    if dtype.names:
        columns = np.fromfile(path, dtype, items, offset=start)
        return Table.of({name.lower(): columns[name] for name in dtype.names if columns[name].ndim == 1})
    if not _fits(dtype, shape):
        raise InputError(f'holds {_described(dtype, shape)}; needs one numeric (N, 3) array')
    if fortran:
        values = np.fromfile(path, dtype, items, offset=start).reshape(shape, order='F').reshape(-1, 3)
        return Table.of(dict(zip('xyz', values.T, strict=True)))

    def part(first: int, last: int) -> dict[str, np.ndarray]:
        rows = np.fromfile(path, dtype, 3 * (last - first), offset=start + 3 * first * dtype.itemsize)
        return dict(zip('xyz', rows.reshape(-1, 3).T, strict=True))

    return Table(items // 3, part)


def _archive(path: Path) -> CloudFile:
    with zipfile.ZipFile(path) as archive:
        members = {info.filename.removesuffix('.npy'): info for info in archive.infolist()}
        found = {}
        for name, info in members.items():
            with archive.open(info) as file:
                try:
                    found[name] = _header(file)[:2]
                except (InputError, ValueError):
                    continue  # no array, or one of objects: not ours to read
        fitting = [name for name, (dtype, shape) in found.items() if _fits(dtype, shape)]
        named = [name for name in POINTS if name in fitting]
        plain = [name for name in fitting if name not in COLORS + NORMALS]
        if not named and len(plain) != 1:
            raise InputError(f'needs one numeric (N, 3) array, in an .npz named {" or ".join(POINTS)}')
        points = _member(archive, members[(named or plain)[0]]).reshape(-1, 3).astype(float)
        others = []
        for names in (COLORS, NORMALS):
            fit = next((name for name in names if name in fitting and np.prod(found[name][1]) == points.size), None)
            others.append(None if fit is None else _member(archive, members[fit]).reshape(-1, 3))
    colors, normals = others
    if colors is not None:
        limit = 255.0 if colors.dtype.itemsize == 1 else full_brightness(colors, floats=colors.dtype.kind == 'f')
        colors = np.clip(np.nan_to_num(colors / limit), 0.0, 1.0)
    return CloudFile(points, colors, None if normals is None else normals.astype(float))


def _member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    """Return one array of an archive, refused before it is inflated where its size cannot be true."""
    with archive.open(info) as file:
        dtype, shape, fortran = _header(file)
        size = int(np.prod(shape, dtype=object)) * dtype.itemsize
        if size > HARMLESS and size > SUSPICIOUS * info.compress_size:
            raise InputError(f'inflates from {info.compress_size} to {size} bytes, which no measured cloud does')
        if size > info.file_size:
            raise InputError(f'ends early ({info.file_size} of {size} bytes are there); copy or write it again')
        data = file.read(size)
        if len(data) < size or file.read(1):
            raise InputError(f'its array {info.filename!r} has another size than its header says; write it again')
    return np.frombuffer(data, dtype).reshape(shape, order='F' if fortran else 'C')


def _header(file) -> tuple[np.dtype, tuple[int, ...], bool]:
    """Return dtype, shape and whether the array is in Fortran's order; the file then stands at the data."""
    version = np.lib.format.read_magic(file)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
    if read is None:
        raise InputError(f'is an array file of version {version[0]}.{version[1]}; write it again')
    shape, fortran, dtype = read(file)
    if dtype.hasobject:
        raise InputError('holds Python objects, which are never loaded; write it as an array of numbers')
    if any(length < 0 for length in shape):
        raise InputError(f'has the shape {shape}; write it again')
    return dtype, shape, fortran


def _fits(dtype: np.dtype, shape: tuple[int, ...]) -> bool:
    return len(shape) in (2, 3) and shape[-1] == 3 and dtype.kind in 'fiu'


def _described(dtype: np.dtype, shape: tuple[int, ...]) -> str:
    return f'{str(dtype)[:60]} of shape {shape}'


def write(file: BinaryIO, cloud: CloudFile, ending: str) -> None:
    """Write the points alone (.npy), or points, colours and normals (.npz)."""
    if ending == '.npy':
        np.save(file, cloud.points)
        return
    parts = {'points': cloud.points, 'colors': cloud.colors, 'normals': cloud.normals}
    given = {name: part for name, part in parts.items() if part is not None}
    np.savez_compressed(file, **given)  # type: ignore[arg-type]  # the stub takes any name for allow_pickle
