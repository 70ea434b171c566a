"""A 16-bit depth image with the matrix of its camera beside it."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np

from csgm_ros.errors import ConfigError, InputError
from csgm_ros.io.cloud_file import CloudFile
from csgm_ros.io.config_files import parsed

CAMERA_FILES = ('camera.json', 'camera.yaml', 'camera_info.yaml', 'intrinsics.json', 'intrinsics.txt', 'camera.txt')
DEPTH_SCALE = 1000.0  # of the image per metre: millimetres, as OpenNI, RealSense and ROS write them
MAX_PIXELS = 1 << 26  # several times a large sensor's; more is an image that was made to fill the memory
MAX_CAMERA = 1 << 20  # bytes
MODES = ('I;16', 'I;16B', 'I;16L', 'I')
UNUSABLE = (
    *(OSError, ConfigError, ArithmeticError, LookupError, StopIteration),
    *(ValueError, TypeError, AttributeError, RecursionError),
)


def read(path: Path) -> CloudFile:
    """Project a depth image into space, x right, y down, z forward; see :mod:`csgm_ros.io.formats`.

    The camera is read from NAME.json, NAME.yaml or NAME.txt beside NAME.png, else from a file of `CAMERA_FILES` in
    the same folder.
    """
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter('ignore', Image.DecompressionBombWarning)  # the size is checked below
        opened = Image.open(path)
    with opened as image:
        if image.mode not in MODES:
            raise InputError(f'is an image of mode {image.mode}, not a 16-bit depth image')
        if image.width * image.height > MAX_PIXELS:
            raise InputError(f'has {image.width} x {image.height} pixels, more than {MAX_PIXELS}; write a smaller one')
        depth = np.asarray(image).astype(float)
    matrix, scale = camera(_camera_file(path))
    v, u = np.nonzero(depth > 0.0)
    z = depth[v, u] / scale
    return CloudFile(
        np.stack([(u - matrix[0, 2]) / matrix[0, 0] * z, (v - matrix[1, 2]) / matrix[1, 1] * z, z], axis=1)
    )


def _camera_file(path: Path) -> Path:
    names = [path.with_suffix(ending).name for ending in ('.json', '.yaml', '.txt')] + list(CAMERA_FILES)
    for name in names:
        if path.with_name(name).is_file():
            return path.with_name(name)
    raise InputError(f'needs the matrix of its camera beside it, as {names[0]}, {names[2]} or {CAMERA_FILES[0]}')


def camera(path: Path) -> tuple[np.ndarray, float]:
    """Read a camera: its (3, 3) matrix and the image's units per metre.

    Parameters
    ----------
    path : Path
        9 numbers of text, row by row; or JSON or YAML with `fx fy cx cy`, `K`, `k`, `camera_matrix` (its `data`) or
        Open3D's `intrinsic_matrix` (column by column), and `depth_scale` where it is not 1000.

    Raises
    ------
    InputError
        When the file holds no such camera.
    """
    try:
        with path.open(encoding='utf-8') as file:
            text = file.read(MAX_CAMERA)
        if path.suffix == '.txt':
            return _checked(np.array(text.split(), float), DEPTH_SCALE)
        values = json.loads(text) if path.suffix == '.json' else parsed(text, str(path))
        return _checked(_matrix(values), float(values.get('depth_scale', DEPTH_SCALE)))
    except UNUSABLE:
        raise InputError(f'its camera {path.name} holds no camera matrix (fx 0 cx 0 fy cy 0 0 1)') from None


def _matrix(values: dict) -> np.ndarray:
    if 'fx' in values:
        fx, fy, cx, cy = (float(values[name]) for name in ('fx', 'fy', 'cx', 'cy'))
        return np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0])
    if 'intrinsic_matrix' in values:
        return np.array(values['intrinsic_matrix'], float).reshape(3, 3).T.ravel()
    found = next(values[name] for name in ('K', 'k', 'camera_matrix') if name in values)
    return np.array(found['data'] if isinstance(found, dict) else found, float).ravel()


def _checked(matrix: np.ndarray, scale: float) -> tuple[np.ndarray, float]:
    if len(matrix) == 16:
        matrix = matrix.reshape(4, 4)[:3, :3].ravel()
    matrix = matrix[:9].reshape(3, 3)
    right = np.isfinite(matrix).all() and min(matrix[0, 0], matrix[1, 1], scale) > 0.0 and np.isfinite(scale)
    if not right or matrix[2].tolist() != [0.0, 0.0, 1.0]:
        raise ValueError
    return matrix, scale
