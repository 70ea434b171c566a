"""A transform as text, for people and for the tools that take it further: every digit that a double holds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from csgm_ros.errors import InputError
from csgm_ros.types import Similarity

MAX_RESULT = 1 << 26  # bytes of a result file


def matrix_text(matrix: np.ndarray) -> str:
    """Return a matrix as aligned rows; read back, each number is the same double."""
    rows = [[repr(float(value)) for value in row] for row in np.asarray(matrix)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return '\n'.join(
        '  ' + ' '.join(text.rjust(width) for text, width in zip(row, widths, strict=True)) for row in rows
    )


def similarity_of(matrix: Any) -> Similarity:
    """Return a 4x4 matrix, or its 16 numbers row by row, as the similarity that it is.

    Raises
    ------
    ValueError
        When it is none.
    """
    matrix = np.array(matrix, float)
    matrix = matrix.reshape(4, 4) if matrix.shape == (16,) else matrix
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or matrix[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise ValueError('no similarity')
    transform = Similarity.from_matrix(matrix)
    turned = transform.rotation @ transform.rotation.T
    if not transform.scale > 0.0 or np.abs(turned - np.eye(3)).max() > 1e-6:
        raise ValueError('no similarity')
    return transform


def read_result(path: str | Path) -> tuple[Similarity, bool]:
    """Return the transform of a result file and whether it was accepted.

    Parameters
    ----------
    path : str or Path
        What ``csgm register --json`` wrote; of other files, `T_target_source` alone is needed.

    Raises
    ------
    InputError
        When there is no similarity in it.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MAX_RESULT:
            raise ValueError
        values = json.loads(path.read_text(encoding='utf-8'))
        transform = similarity_of(values['T_target_source'])
    except OSError as error:
        raise InputError(f'{path}: cannot be read ({error.strerror}); check the path') from None
    except (ValueError, KeyError, TypeError, RecursionError, np.linalg.LinAlgError):
        raise InputError(f'{path}: holds no similarity T_target_source; csgm register --json writes one') from None
    return transform, bool(values.get('accepted', True))


def read_inputs(path: str | Path) -> dict[str, str]:
    """Return where the clouds of a result file came from: `source` and `target`, or `bag` and its two topics.

    Raises
    ------
    InputError
        When it does not say.
    """
    inputs = json.loads(Path(path).read_text(encoding='utf-8')).get('inputs')
    known = ({'source', 'target'}, {'bag', 'source_topic', 'target_topic'})
    if not isinstance(inputs, dict) or set(inputs) not in known or not all(isinstance(v, str) for v in inputs.values()):
        raise InputError(f'{path}: does not say which clouds it is of; name source and target after it')
    return inputs


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return the unit quaternion (w, x, y, z), w >= 0, of a (3, 3) rotation."""
    w, x, y, z = _largest_first(np.asarray(rotation, float))
    values = np.array([w, x, y, z])
    return values / np.linalg.norm(values) * (1.0 if w >= 0.0 else -1.0)


def _largest_first(r: np.ndarray) -> tuple[float, float, float, float]:
    """Return a multiple of the quaternion, from its largest component, so that nothing small is divided by."""
    trace = np.trace(r)
    squares = np.array([trace, r[0, 0], r[1, 1], r[2, 2]])
    largest = int(np.argmax(squares))
    if largest == 0:
        return 1.0 + trace, r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    i, j, k = ((0, 1, 2), (1, 2, 0), (2, 0, 1))[largest - 1]
    parts = {i: 1.0 + r[i, i] - r[j, j] - r[k, k], j: r[i, j] + r[j, i], k: r[i, k] + r[k, i]}
    return r[k, j] - r[j, k], parts[0], parts[1], parts[2]


def _colmap(transform: Similarity) -> str:
    """COLMAP: `model_transformer --transform_path`, scale, quaternion (w x y z) and translation in a line."""
    return _numbers([transform.scale, *quaternion(transform.rotation), *transform.translation]) + '\n'


def _cloudcompare(transform: Similarity) -> str:
    """CloudCompare: the 4x4 matrix of Edit > Apply transformation, or `-APPLY_TRANS FILE`."""
    return '\n'.join(_numbers(row) for row in transform.matrix) + '\n'


def _ros(transform: Similarity) -> str:
    """ROS 2: a static transform of the already scaled source; TF cannot carry the scale."""
    w, x, y, z = quaternion(transform.rotation)
    names = ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')
    values = (*transform.translation, x, y, z, w)
    pose = ' '.join(f'--{name} {float(value)!r}' for name, value in zip(names, values, strict=True))
    return (
        f'# scale {transform.scale!r}: TF cannot carry it; multiply the source by it first\n'
        f'ros2 run tf2_ros static_transform_publisher {pose} --frame-id target --child-frame-id source\n'
    )


def _matlab(transform: Similarity) -> str:
    """MATLAB: the matrix, and the simtform3d made of it."""
    rows = ';\n     '.join(_numbers(row) for row in transform.matrix)
    return f'T = [{rows}];  % x_target = T * [x_source; 1]\ntform = simtform3d(T);\n'


def _numbers(values) -> str:
    return ' '.join(repr(float(value)) for value in values)


EXPORTS = {'colmap': _colmap, 'cloudcompare': _cloudcompare, 'ros': _ros, 'matlab': _matlab}


def export(transform: Similarity, kind: str) -> str:
    """Return a transform the way another tool wants it; ``kind`` is a name of `EXPORTS`.

    Examples
    --------
    >>> import numpy as np
    >>> print(export(Similarity(2.0, np.eye(3), np.zeros(3)), 'cloudcompare'), end='')
    2.0 0.0 0.0 0.0
    0.0 2.0 0.0 0.0
    0.0 0.0 2.0 0.0
    0.0 0.0 0.0 1.0
    """
    return EXPORTS[kind](transform)
