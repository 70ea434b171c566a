"""What a frame saw from where: a small range image that tells surfaces, free space and shadow apart."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from csgm_ros.cloud.kernels import kernel

STEP = np.radians(1.25)  # between two rays of the image
COLUMNS, ROWS = round(2 * np.pi / STEP), round(np.pi / STEP)


class View(NamedTuple):
    """One frame as seen from its viewpoint.

    Attributes
    ----------
    nearest, farthest : (ROWS, COLUMNS) float32 ndarray
        Range of the returns of each ray, sensor units; infinite and 0 where there is none.
    matrix : (4, 4) ndarray
        Rigid, from the sensor's frame into the frame the points to compare are in.
    """

    nearest: np.ndarray
    farthest: np.ndarray
    matrix: np.ndarray


def look(points: np.ndarray, matrix: np.ndarray | None = None) -> View:
    """Return what (N, 3) points in the sensor's frame look like from its origin."""
    nearest = np.full((ROWS, COLUMNS), np.inf, np.float32)
    farthest = np.zeros((ROWS, COLUMNS), np.float32)
    _look(points, nearest, farthest)
    return View(nearest, farthest, np.eye(4) if matrix is None else matrix)


def seen(points: np.ndarray, transform: np.ndarray, view: View, tolerance: float) -> np.ndarray:
    """Tell what a frame says of points.

    Parameters
    ----------
    points : (N, 3) ndarray
    transform : (4, 4) ndarray
        Similarity from the points' frame into the frame that ``view.matrix`` leads to.
    tolerance : float
        Range by which a point may miss the surface, relative to the range.

    Returns
    -------
    (N,) int8 ndarray
        1 on the surface that was seen, -1 in front of it, where the sensor looked through it, 0 where the frame
        cannot tell: outside its view, or behind what it saw.
    """
    rigid = view.matrix
    inverse = np.eye(4)
    inverse[:3, :3] = rigid[:3, :3].T
    inverse[:3, 3] = -rigid[:3, :3].T @ rigid[:3, 3]
    told = np.zeros(len(points), np.int8)
    _seen(points, inverse @ transform, view.nearest, view.farthest, tolerance, told)
    return told


@kernel(inline=True)
def _cell(x, y, z, distance):
    column = int((np.arctan2(x, z) + np.pi) / STEP)
    row = int((np.arcsin(min(max(y / distance, -1.0), 1.0)) + np.pi / 2) / STEP)
    return min(row, ROWS - 1), column % COLUMNS


@kernel
def _look(points, nearest, farthest):
    for p in range(len(points)):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        distance = np.sqrt(x * x + y * y + z * z)
        if distance > 1e-9:
            row, column = _cell(x, y, z, distance)
            nearest[row, column] = min(nearest[row, column], distance)
            farthest[row, column] = max(farthest[row, column], distance)


@kernel
def _seen(points, m, nearest, farthest, tolerance, told):
    most = farthest.max() * (1.0 + tolerance)
    for p in range(len(points)):
        a, b, c = points[p, 0], points[p, 1], points[p, 2]
        x = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c + m[0, 3]
        y = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c + m[1, 3]
        z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c + m[2, 3]
        distance = np.sqrt(x * x + y * y + z * z)
        if distance < 1e-9 or distance > most:  # most of a large map is farther than anything seen
            continue
        row, column = _cell(x, y, z, distance)
        if farthest[row, column] == 0.0:
            continue
        if distance < nearest[row, column] * (1.0 - tolerance):
            told[p] = -1
        elif distance <= farthest[row, column] * (1.0 + tolerance):
            told[p] = 1
