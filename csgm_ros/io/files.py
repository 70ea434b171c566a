"""Clouds in files: one place that reads and writes every format of :mod:`csgm_ros.io.formats`."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import numpy as np

from csgm_ros.cloud.thin import PART, parts_of, thinned
from csgm_ros.errors import InputError
from csgm_ros.io.atomic import replacing
from csgm_ros.io.cloud_file import CloudFile, Table, cloud_of, color_limit, has_byte_colors
from csgm_ros.io.formats import READ, WRITTEN, format_of

__all__ = ['SUFFIXES', 'CloudFile', 'check_writable', 'chunks', 'read_cloud', 'read_points', 'write', 'write_cloud']

SUFFIXES = WRITTEN
CHUNK = 1_000_000  # rows


def read_cloud(path: str | Path) -> CloudFile:
    """Read the points of a file, and their colours and normals where it has them.

    Parameters
    ----------
    path : str or Path
        A file of one of the formats of :data:`csgm_ros.io.formats.FORMATS`, or the folder of a COLMAP model.

    Returns
    -------
    CloudFile

    Raises
    ------
    InputError
        For a file that is missing, of another kind, empty, cut or garbage; the message names it and the remedy.
    """
    path = _existing(path)
    with _named(path), np.errstate(all='ignore'):  # what overflows is not finite, and left out as such
        cloud = _module(path).read(path)
        if isinstance(cloud, Table):
            cloud = cloud_of(cloud.part(0, cloud.rows))
        if not np.isfinite(cloud.points).all(axis=1).any():
            raise InputError('holds no finite point; write it again')
        return cloud


def chunks(path: str | Path, rows: int = CHUNK) -> Iterator[CloudFile]:
    """Yield the points of a file part by part, without holding all of them where the format allows that.

    Binary .ply and .pcd and .npy files are read on demand; other formats are read whole and cut.

    Parameters
    ----------
    path : str or Path
    rows : int
        Points of a part at most.

    Raises
    ------
    InputError
        As :func:`read_cloud`; before the first part for what the header tells, else at the part concerned.
    """
    path = _existing(path)
    with _named(path):
        found = _module(path).read(path)
        whole = found.rows if isinstance(found, Table) else len(found.points)
        bounds = [(first, min(first + rows, whole)) for first in range(0, whole, rows)]
        limit = _color_limit(found, bounds) if isinstance(found, Table) else None
    for first, last in bounds:
        with _named(path), np.errstate(all='ignore'):
            if isinstance(found, Table):
                part = cloud_of(found.part(first, last), limit)
            else:
                cut = [None if each is None else each[first:last] for each in (found.colors, found.normals)]
                part = CloudFile(found.points[first:last], cut[0], cut[1], found.origin)
        yield part


def read_points(path: str | Path, most: int, threads: int = 1) -> np.ndarray:
    """Read the points of a file alone; a cloud of more than ``most`` comes thinned and is never held as a whole.

    Parameters
    ----------
    path : str or Path
    most : int
        `preprocess.max_points` of the registration that follows, which gives the same bits for the whole cloud.
    threads : int, optional
        Parts worked on at a time.

    Returns
    -------
    (N, 3) float64 ndarray

    Raises
    ------
    InputError
        As :func:`read_cloud`.
    """
    parts, _ = point_parts(path)
    held, rows = [], 0
    for part in parts:
        held.append(part)
        rows += len(part)
        if rows > most:
            with _named(Path(path)):
                return thinned(itertools.chain(held, parts), most, threads)
    points = np.concatenate(held)
    if not np.isfinite(points).all(axis=1).any():
        raise InputError(f'{path}: holds no finite point; write it again')
    return points


def point_parts(path: str | Path) -> tuple[Iterator[np.ndarray], int]:
    """Return the points of a file part by part, each (N, 3), and how many rows there are.

    Those of .npy, .las and binary .ply and .pcd are read on demand.

    Raises
    ------
    InputError
        As :func:`read_cloud`; for what only a part tells, when it is asked for.
    """
    path = _existing(path)
    with _named(path):
        module = _module(path)
        found = getattr(module, 'coordinates', module.read)(path)
    if not isinstance(found, Table):
        return parts_of(found.points), len(found.points)
    return _table_parts(path, found), found.rows


def _table_parts(path: Path, found: Table) -> Iterator[np.ndarray]:
    for first in range(0, found.rows, PART):
        with _named(path):
            columns = found.part(first, min(first + PART, found.rows))
            part = cloud_of({name: columns[name] for name in 'xyz' if name in columns}).points
        yield part


def write_cloud(
    path: str | Path,
    points: np.ndarray,
    colors: np.ndarray | None = None,
    *,
    normals: np.ndarray | None = None,
    origin: np.ndarray | None = None,
) -> None:
    """Write (N, 3) points, with (N, 3) colours in [0, 1] and normals where the kind of file has them.

    The file appears whole or not at all. ``origin`` is the offset that .las and .laz store coordinates from.

    Raises
    ------
    InputError
        For an unknown ending, a place that cannot be written or a full disk.
    """
    others = [None if part is None else np.asarray(part, float) for part in (colors, normals)]
    write(path, CloudFile(np.asarray(points, float), others[0], others[1], origin))


def write(path: str | Path, cloud: CloudFile) -> None:
    """Write a cloud; see :func:`write_cloud`."""
    path = check_writable(path)
    module = _module(path)
    with replacing(path) as file:
        try:
            module.write(file, cloud, path.suffix.lower())
        except InputError as error:
            raise InputError(f'{path}: {error}') from None
        except ModuleNotFoundError as error:
            raise InputError(_needs(path, error)) from None
        except (ValueError, OverflowError) as error:
            raise InputError(f'{path}: cannot be written ({_one_line(error)}); write another format') from None


def check_writable(path: str | Path, suffixes: tuple[str, ...] = SUFFIXES) -> Path:
    """Return ``path``, or raise InputError when its ending or its folder will not do."""
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise InputError(f'{path}: cannot be written; its name must end with one of {" ".join(suffixes)}')
    if not path.parent.is_dir():
        raise InputError(f'{path}: the folder {path.parent} does not exist; make it first')
    if path.is_dir():
        raise InputError(f'{path}: is a folder; name a file')
    return path


def _existing(path: str | Path) -> Path:
    """Return the path of a file that is there and of a known kind."""
    path = Path(path)
    if path.is_dir():
        model = next((path / name for name in ('points3D.bin', 'points3D.txt') if (path / name).is_file()), None)
        if model is None:
            raise InputError(f'{path}: is a folder without points3D.bin or points3D.txt; name a file')
        return model
    if format_of(path.name) is None:
        raise InputError(f'{path}: unknown kind of file; what can be read ends with one of {" ".join(READ)}')
    try:
        there = path.is_file() or path.exists()
    except (OSError, ValueError):
        there = False
    if not there:
        raise InputError(f'{path}: no such file; check the path')
    if not path.is_file():
        raise InputError(f'{path}: is no regular file; copy it into one')
    return path


def _module(path: Path):
    """Import the module of a file's format."""
    found = format_of(path.name)
    assert found is not None, path  # callers have asked before
    return import_module(f'csgm_ros.io.formats.{found.module}')


def _color_limit(table: Table, bounds: list[tuple[int, int]]) -> float | None:
    """Return the value of full brightness of all parts, which only wider types than bytes ask to be read for."""
    limits = [color_limit(table.part(*bounds[0]))] if bounds else []
    if limits and limits[0] is not None and not has_byte_colors(table.part(*bounds[0])):
        limits += [color_limit(table.part(*each)) for each in bounds[1:]]
    return max((each for each in limits if each is not None), default=None)


class _named:  # noqa: N801 - read as a word in a `with`
    """Put the path before every error of a reader; what a reader did not foresee is one line too."""

    def __init__(self, path: Path):
        self._path = path

    def __enter__(self) -> None:
        pass

    def __exit__(self, _, error, __) -> None:
        if isinstance(error, InputError):
            said = str(error)
            raise InputError(said if said.startswith(str(self._path)) else f'{self._path}: {said}') from None
        if isinstance(error, ModuleNotFoundError):
            raise InputError(_needs(self._path, error)) from None
        if isinstance(error, PermissionError):
            raise InputError(f'{self._path}: may not be read; check its permissions') from None
        if isinstance(error, MemoryError):
            raise InputError(f'{self._path}: is larger than the memory that is left; take fewer points') from None
        if isinstance(error, Exception):
            raise InputError(f'{self._path}: cannot be read ({_one_line(error)}); write it again') from None


def _needs(path: Path, error: ModuleNotFoundError) -> str:
    """Return that a library is missing, and the extra that brings it."""
    found = format_of(path.name)
    return f'{path}: needs {error.name}; install it by pip install "csgm_ros[{found.needs if found else ""}]"'


def _one_line(error: Exception) -> str:
    return ' '.join(str(error).split())[:160] or type(error).__name__
