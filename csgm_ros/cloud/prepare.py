"""What happens to a cloud before the five steps: checks, finite filter, voxel grid, normals."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from csgm_ros.cloud.outliers import without_extremes
from csgm_ros.cloud.plane_fit import fit_planes
from csgm_ros.cloud.thin import parts_of, thinned
from csgm_ros.cloud.voxels import voxel_means
from csgm_ros.errors import DegenerateCloudError, InputError, naming
from csgm_ros.progress import Look, unhurried
from csgm_ros.types import PreparedCloud

MIN_POINTS = 50
MAX_COORDINATE = 1e100  # squares, their sums and quotients of two clouds stay far from overflow


def finite_points(
    points: np.ndarray,
    name: str = 'cloud',
    most: int | None = None,
    threads: int = 1,
    look: Look = unhurried,
) -> np.ndarray:
    """Return the finite rows of an (N, 3) array as float64, or say what is wrong with it.

    A cloud of more than ``most`` points comes back as the means of at most so many voxels; ``look`` is asked between
    its parts.

    Raises
    ------
    InputError
        Not an (N, 3) array of numbers, or numbers too large to calculate with.
    DegenerateCloudError
        Fewer than 50 finite points, or all of them on one line.
    """
    try:
        points = np.asarray(points)
    except ValueError as error:
        raise InputError(f'{name}: not an array of numbers ({error}); give an (N, 3) array') from None
    if points.dtype.kind not in 'biuf':
        raise InputError(f'{name}: not an array of numbers but of {points.dtype}; give an (N, 3) array')
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f'{name}: shape {points.shape}; give an (N, 3) array of x, y, z')
    if most is not None and len(points) > most:
        with naming(name):
            points = thinned(_watched(parts_of(points), look), most, threads)
    else:
        points = points[np.isfinite(points).all(1)].astype(float)
    if len(points) < MIN_POINTS:
        raise DegenerateCloudError(f'{name}: {len(points)} finite points; at least {MIN_POINTS} are needed')
    if np.abs(points).max() > MAX_COORDINATE:
        raise InputError(f'{name}: coordinates beyond {MAX_COORDINATE:g}; choose a larger unit or remove such points')
    inner = without_extremes(points)  # one point far out would make a line of any cloud
    centred = inner - inner.mean(0)
    extents = np.linalg.eigvalsh(centred.T @ centred / len(inner))
    if extents[1] <= 1e-10 * extents[2] or extents[2] <= 0.0:
        raise DegenerateCloudError(f'{name}: all points in one place or on one line; give a cloud of surfaces')
    return points


def _watched(parts: Iterator[np.ndarray], look: Look) -> Iterator[np.ndarray]:
    for part in parts:
        look()
        yield part


def viewpoint(place: np.ndarray | None, name: str) -> np.ndarray | None:
    """Return where a sensor stood as three finite numbers, or say what is wrong with it; None where unknown.

    Raises
    ------
    InputError
    """
    if place is None:
        return None
    place = np.asarray(place)
    if place.shape != (3,) or place.dtype.kind not in 'biuf' or not np.isfinite(place).all():
        raise InputError(f'{name}: viewpoint {place.tolist()} is not a point; give three finite numbers, x, y, z')
    return place.astype(float)


def normals_of(points: np.ndarray, neighbors: int) -> np.ndarray:
    """Return unit normals (N, 3) from the nearest ``neighbors`` points; their sign is arbitrary."""
    return fit_planes(points, neighbors, points).normals


def prepare(points: np.ndarray, voxel_size: float, neighbors: int) -> PreparedCloud:
    """Bring a cloud to one point a voxel, with normals.

    Parameters
    ----------
    points : (N, 3) ndarray
        Finite points in the normalised frame, see :func:`csgm_ros.scale.normalize`.
    voxel_size : float
        Relative to the radius, which is 1.
    neighbors : int
        Points from which a normal is estimated.
    """
    means = voxel_means(points, voxel_size)
    return PreparedCloud(means, normals_of(means, min(neighbors, len(means))))
