"""The map made ready once: thinned, with normals, at the resolution that a scale asks for; saved and loaded."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from csgm_ros.cloud.prepare import finite_points, normals_of
from csgm_ros.cloud.voxels import voxel_means
from csgm_ros.errors import InputError
from csgm_ros.io.atomic import replacing
from csgm_ros.tracking import surface
from csgm_ros.tracking.surface import Surface

VERSION = 1
MOST = 60000  # points of a prepared map at most
NEIGHBORS = 20


class Level(NamedTuple):
    """The map at one scale.

    Attributes
    ----------
    points, normals : (N, 3) ndarray
        Map units; unit normals of any sign.
    near : Surface
        Finds what lies within 2.5 voxels of the sensor.
    """

    points: np.ndarray
    normals: np.ndarray
    near: Surface


class PreparedMap(NamedTuple):
    """A map ready for tracking.

    Attributes
    ----------
    points, normals : (N, 3) ndarray
        Evenly thinned, map units; unit normals of any sign.
    voxel : float
        Edge of the voxels it was thinned with, map units.
    """

    points: np.ndarray
    normals: np.ndarray
    voxel: float

    def level(self, voxel: float) -> Level:
        """Return the map for a sensor whose voxels have an edge of ``voxel`` map units."""
        thin = surface.build(self.points, self.normals, max(voxel, self.voxel), oriented=False)
        return Level(thin.points, thin.normals, self.near(voxel))

    def near(self, voxel: float) -> Surface:
        """Return what finds the map's points within 2.5 voxels of a sensor's."""
        return surface.build(self.points, self.normals, 2.5 * voxel, oriented=False)


def prepare_map(points: np.ndarray) -> PreparedMap:
    """Thin (N, 3) points of a map and estimate normals.

    Raises
    ------
    InputError
        For points that are no cloud of surfaces.
    """
    points = finite_points(points, 'map')
    low, high = np.quantile(points, (0.01, 0.99), axis=0)
    voxel = float(np.linalg.norm(high - low)) / 400
    means = voxel_means(points, voxel)
    while len(means) > MOST:
        voxel *= 1.1 * np.sqrt(len(means) / MOST)
        means = voxel_means(points, voxel)
    return PreparedMap(means, normals_of(means, min(NEIGHBORS, len(means))), voxel)


def read_map(path: str | Path) -> PreparedMap:
    """Read a map, prepared or not.

    Raises
    ------
    InputError
        For a file that is missing, damaged, or no map.
    """
    from csgm_ros.io.files import read_cloud

    path = Path(path)
    if path.suffix == '.npz' and path.is_file() and zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as file:
            if 'csgm_map.npy' in file.namelist():
                return load_map(path)
    try:
        return prepare_map(read_cloud(path).points)
    except InputError as error:
        raise InputError(str(error) if str(path) in str(error) else f'{error} ({path})') from None


def save_map(path: str | Path, prepared: PreparedMap) -> None:
    """Write a prepared map as .npz.

    Raises
    ------
    InputError
        Where it cannot be written.
    """
    path = Path(path)
    if path.suffix != '.npz':
        raise InputError(f'{path}: a prepared map ends with .npz; choose another name')
    with replacing(path) as file:
        np.savez_compressed(file, csgm_map=VERSION, **prepared._asdict())


def load_map(path: str | Path) -> PreparedMap:
    """Read what :func:`save_map` wrote.

    Raises
    ------
    InputError
        For a file that is missing, no prepared map, of another version, or damaged.
    """
    path = Path(path)
    again = f'make it again with csgm prepare-map MAP -o {path}'
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except FileNotFoundError:
        raise InputError(f'{path}: no such file; check the path') from None
    except Exception:
        raise InputError(f'{path}: is damaged or no .npz file; {again}') from None
    version = arrays.pop('csgm_map', None)
    if version is None:
        raise InputError(f'{path}: is no prepared map; {again}')
    if version.shape != () or int(version) != VERSION:
        raise InputError(f'{path}: is a prepared map of version {version}, not {VERSION}; {again}')
    if set(arrays) != set(PreparedMap._fields) or not _sound(arrays):
        raise InputError(f'{path}: is damaged; {again}')
    return PreparedMap(arrays['points'], arrays['normals'], float(arrays['voxel']))


def _sound(arrays: dict[str, np.ndarray]) -> bool:
    points, normals, voxel = (arrays[name] for name in PreparedMap._fields)
    return (
        points.ndim == 2
        and points.shape[1] == 3
        and points.shape == normals.shape
        and points.dtype == normals.dtype == np.float64
        and bool(np.isfinite(points).all() and np.isfinite(normals).all())
        and voxel.shape == ()
        and bool(voxel > 0)
    )
