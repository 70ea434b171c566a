"""A cloud as a file holds it, made of the file's named columns."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from csgm_ros.errors import InputError

POINT_NAMES = (('x', 'y', 'z'),)
COLOR_NAMES = (('red', 'green', 'blue'), ('r', 'g', 'b'), ('diffuse_red', 'diffuse_green', 'diffuse_blue'))
NORMAL_NAMES = (('nx', 'ny', 'nz'), ('normal_x', 'normal_y', 'normal_z'))
PACKED_NAMES = ('rgb', 'rgba')
WANTED = {name for names in (*POINT_NAMES, *COLOR_NAMES, *NORMAL_NAMES) for name in names} | set(PACKED_NAMES)
MAX_LISTED = 200  # characters of field names in an error


@dataclass(frozen=True, eq=False)
class CloudFile:
    """A cloud as a file holds it.

    Attributes
    ----------
    points : (N, 3) float64 ndarray
        In the file's unit; may hold NaN, which registration leaves out.
    colors : (N, 3) float64 ndarray or None
        Red, green and blue in [0, 1].
    normals : (N, 3) float64 ndarray or None
        As the file has them; zeros where a point has none.
    origin : (3,) float64 ndarray or None
        Offset that the file's coordinates are stored from (.las, .laz).
    """

    points: np.ndarray
    colors: np.ndarray | None = None
    normals: np.ndarray | None = None
    origin: np.ndarray | None = None


@dataclass(frozen=True)
class Table:
    """Rows of a file that are known to be there, read on demand.

    Attributes
    ----------
    rows : int
    part : callable
        ``part(first, last)`` returns ``{lower-case name: (last - first,) ndarray}`` of the columns of interest.
    """

    rows: int
    part: Callable[[int, int], Mapping[str, np.ndarray]]

    @classmethod
    def of(cls, columns: Mapping[str, np.ndarray]) -> Table:
        """Return a table of columns in memory."""
        rows = len(next(iter(columns.values()))) if columns else 0
        return cls(rows, lambda first, last: {name: column[first:last] for name, column in columns.items()})


def cloud_of(columns: Mapping[str, np.ndarray], color_limit: float | None = None) -> CloudFile:
    """Assemble points, colours and normals from columns, recognised by their names.

    Parameters
    ----------
    columns : mapping of str to (N,) ndarray
        Lower-case names.
    color_limit : float, optional
        The value of full brightness; found by type and largest value when not given.

    Raises
    ------
    InputError
        When a coordinate is missing.
    """
    missing = [name for name in 'xyz' if name not in columns]
    if missing:
        there = ', '.join(columns)
        there = there if len(there) <= MAX_LISTED else there[:MAX_LISTED] + ' ...'
        raise InputError(f'has no field {missing[0]!r}; its fields are {there or "none"}')
    points = _stacked([columns[name] for name in 'xyz'])
    normals = next((_stacked([columns[n] for n in names]) for names in NORMAL_NAMES if _all(names, columns)), None)
    return CloudFile(points, _colors(columns, color_limit), normals)


def color_limit(columns: Mapping[str, np.ndarray]) -> float | None:
    """Return the value of full brightness of the colour columns; None where there are none or they are packed."""
    names = next((names for names in COLOR_NAMES if _all(names, columns)), None)
    if names is None:
        return None
    if has_byte_colors(columns):
        return 255.0
    largest = np.array([_largest(columns[name]) for name in names])
    return full_brightness(largest, floats=columns[names[0]].dtype.kind == 'f')


def has_byte_colors(columns: Mapping[str, np.ndarray]) -> bool:
    """Return True where the colour columns are bytes, whose full brightness needs no look at the values."""
    names = next((names for names in COLOR_NAMES if _all(names, columns)), ())
    return bool(names) and all(columns[name].dtype.itemsize == 1 for name in names)


def full_brightness(values: np.ndarray, *, floats: bool) -> float:
    """Return 1, 255 or 65535: the least of them that no value exceeds; whole numbers are never out of 1."""
    largest = _largest(values)
    if floats and largest <= 1.0:
        return 1.0
    return 255.0 if largest <= 255.0 else max(65535.0, largest)


def _all(names: tuple[str, ...], columns: Mapping[str, np.ndarray]) -> bool:
    return all(name in columns for name in names)


def _stacked(columns: list[np.ndarray]) -> np.ndarray:
    stacked = np.empty((len(columns[0]), len(columns)))
    for index, column in enumerate(columns):
        stacked[:, index] = column
    return stacked


def _largest(values: np.ndarray) -> float:
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    return float(values.max()) if len(values) else 0.0


def _colors(columns: Mapping[str, np.ndarray], limit: float | None) -> np.ndarray | None:
    names = next((names for names in COLOR_NAMES if _all(names, columns)), None)
    if names is not None:
        parts = [columns[name].view('u1') if columns[name].dtype == 'i1' else columns[name] for name in names]
        colors = _stacked(parts) / (limit or color_limit(columns))
        return np.clip(np.nan_to_num(colors, nan=0.0), 0.0, 1.0)
    for name in PACKED_NAMES:
        if name in columns and columns[name].dtype.itemsize == 4:
            packed = np.ascontiguousarray(columns[name])
            packed = packed.astype(packed.dtype.newbyteorder('=')).view(np.uint32)
            return np.stack([(packed >> shift & 0xFF) / 255.0 for shift in (16, 8, 0)], axis=1)
    return None
