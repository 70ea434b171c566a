"""Clouds in files: .ply, .pcd, .xyz, .npy and .npz in, .ply and the others out."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from csgm_ros.errors import InputError
from csgm_ros.io.headers import check_complete

SUFFIXES = ('.ply', '.pcd', '.xyz', '.npy', '.npz')
NPZ_KEYS = ('points', 'xyz', 'vertices')


@dataclass(frozen=True, eq=False)
class CloudFile:
    """A cloud as a file holds it.

    Attributes
    ----------
    points : (N, 3) float64 ndarray
        In the file's unit; may hold NaN, which registration leaves out.
    colors : (N, 3) float64 ndarray or None
        Red, green and blue in [0, 1].
    """

    points: np.ndarray
    colors: np.ndarray | None = None


def read_cloud(path: str | Path) -> CloudFile:
    """Read the points of a file, and their colours where it has them.

    Parameters
    ----------
    path : str or Path
        A .ply (its vertices), .pcd, .xyz (first three columns), .npy (N, 3) or .npz file; an .npz holds its points
        as `points`, `xyz` or `vertices`, or as its only (N, 3) array.

    Returns
    -------
    CloudFile

    Raises
    ------
    InputError
        For a file that is missing, of another kind, empty, cut or garbage; the message names it and the remedy.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f'{path}: unknown kind of file; use one of {" ".join(SUFFIXES)}')
    if not path.is_file():
        raise InputError(f'{path}: no such file; check the path')
    try:
        if suffix in ('.ply', '.pcd'):
            cloud = _read_with_open3d(path)
        elif suffix == '.xyz':
            cloud = CloudFile(_text_points(path))
        else:
            cloud = CloudFile(_numpy_points(path))
    except InputError:
        raise
    except PermissionError:
        raise InputError(f'{path}: may not be read; check its permissions') from None
    except Exception as error:
        raise InputError(f'{path}: cannot be read ({_one_line(error)}); write it again') from None
    if not np.isfinite(cloud.points).all(axis=1).any():
        raise InputError(f'{path}: holds no finite point; write it again')
    return cloud


def write_cloud(path: str | Path, points: np.ndarray, colors: np.ndarray | None = None) -> None:
    """Write (N, 3) points, with (N, 3) colours in [0, 1] where the kind of file has them.

    Raises
    ------
    InputError
        For an unknown ending or a place that cannot be written.
    """
    path = check_writable(path)
    points = np.asarray(points, float)
    suffix = path.suffix.lower()
    try:
        if suffix in ('.ply', '.pcd'):
            _write_with_open3d(path, points, colors)
        elif suffix == '.xyz':
            np.savetxt(path, points, fmt='%.9g')
        elif suffix == '.npy':
            np.save(path, points)
        else:
            np.savez_compressed(path, points=points, **({} if colors is None else {'colors': colors}))
    except OSError as error:
        raise InputError(f'{path}: cannot be written ({_one_line(error)}); choose another place') from None


def check_writable(path: str | Path, suffixes: tuple[str, ...] = SUFFIXES) -> Path:
    """Return ``path``, or raise InputError when its ending or its folder will not do."""
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise InputError(f'{path}: cannot be written; its name must end with one of {" ".join(suffixes)}')
    if not path.parent.is_dir():
        raise InputError(f'{path}: the folder {path.parent} does not exist; make it first')
    return path


def _read_with_open3d(path: Path) -> CloudFile:
    check_complete(path)
    import open3d

    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        cloud = open3d.io.read_point_cloud(str(path))
    if not cloud.has_points():
        raise InputError(f'{path}: holds no points that can be read; write it again')
    return CloudFile(np.array(cloud.points), np.array(cloud.colors) if cloud.has_colors() else None)


def _write_with_open3d(path: Path, points: np.ndarray, colors: np.ndarray | None) -> None:
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    if colors is not None:
        cloud.colors = open3d.utility.Vector3dVector(np.asarray(colors, float))
    if not open3d.io.write_point_cloud(str(path), cloud):
        raise OSError('the disk is full, or the folder is not yours')


def _text_points(path: Path) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')  # of an empty file, which is refused further on
        return np.loadtxt(path, usecols=(0, 1, 2), ndmin=2)


def _numpy_points(path: Path) -> np.ndarray:
    """Return the (N, 3) array of an .npy or .npz file; an organised (H, W, 3) one is flattened."""
    loaded = np.load(path, allow_pickle=False)
    if isinstance(loaded, np.ndarray):
        arrays = {'array': loaded}
    else:
        with loaded:
            arrays = {name: loaded[name] for name in loaded.files}
    fitting = {name: a for name, a in arrays.items() if a.ndim in (2, 3) and a.shape[-1] == 3 and a.dtype.kind in 'fiu'}
    named = [name for name in NPZ_KEYS if name in fitting]
    if not named and len(fitting) != 1:
        raise InputError(f'{path}: needs one numeric (N, 3) array, in an .npz named {" or ".join(NPZ_KEYS)}')
    return fitting[named[0] if named else next(iter(fitting))].reshape(-1, 3).astype(float)


def _one_line(error: Exception) -> str:
    return ' '.join(str(error).split())[:160]
