"""Dominant planes of a cloud in cells: floor, walls, table tops."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from csgm_ros.cloud.kernels import kernel

MOST = 4
CANDIDATES = 200
VOTERS = 4000  # cells that are asked
TOLERANCE = 1.5  # cells
MIN_COSINE = 0.85
MIN_SHARE = 0.03  # of the cells


class Plane(NamedTuple):
    """A plane with a side.

    Attributes
    ----------
    normal : (3,) ndarray
        Unit, towards the side with more of the cloud.
    point : (3,) ndarray
        Mean of its cells.
    """

    normal: np.ndarray
    point: np.ndarray


def frame(normal: np.ndarray) -> np.ndarray:
    """Return a rotation (3, 3) that takes the unit ``normal`` to z."""
    x = np.cross(np.eye(3)[np.argmin(np.abs(normal))], normal)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal])


def dominant_planes(
    points: np.ndarray, normals: np.ndarray, size: float, most: int = MOST, share: float = MIN_SHARE
) -> list[Plane]:
    """Return at most ``most`` planes on which a share of (n, 3) cells with edge ``size`` lies, largest first.

    Every so-manieth cell proposes the plane through it; the one with the most cells is fitted to them, then its
    cells are left out. Nothing is drawn: the same cells have the same planes.
    """
    voters = np.arange(0, len(points), max(1, len(points) // VOTERS))
    points, normals = points[voters], normals[voters]
    known = np.flatnonzero((normals != 0).any(1))
    if len(known) < 30:
        return []
    chosen = known[np.linspace(0, len(known) - 1, min(CANDIDATES, len(known))).astype(int)]
    on = _on_planes(points, normals, chosen, TOLERANCE * size)
    alive = np.ones(len(points), bool)
    planes: list[Plane] = []
    while len(planes) < most:
        counts = (on & alive).sum(1)
        best = counts.argmax()
        if counts[best] < share * len(points):
            break
        plane = _fitted(points, normals, on[best] & alive, size)
        near = np.abs((points - plane.point) @ plane.normal) < 2 * TOLERANCE * size
        alive &= ~(near | on[best])
        if not any(_same(plane, other, size) for other in planes):
            planes.append(plane)
    return planes


def _same(first: Plane, second: Plane, size: float) -> bool:
    offset = (first.point - second.point) @ second.normal
    return abs(first.normal @ second.normal) >= 0.97 and abs(offset) <= 4 * size


def _fitted(points: np.ndarray, normals: np.ndarray, on: np.ndarray, size: float) -> Plane:
    for _ in range(3):
        mean = points[on].mean(0)
        normal = np.linalg.eigh(np.cov((points[on] - mean).T))[1][:, 0]
        height = (points - mean) @ normal
        again = (np.abs(height) < TOLERANCE * size) & (np.abs(normals @ normal) > MIN_COSINE)
        if again.sum() < 10:
            break
        on = again
    above, below = (height > 2.5 * size).sum(), (height < -2.5 * size).sum()
    return Plane(normal if above >= below else -normal, mean)


@kernel
def _on_planes(points, normals, chosen, tolerance):
    on = np.zeros((len(chosen), len(points)), np.bool_)
    for c in range(len(chosen)):
        k = chosen[c]
        a, b, d = normals[k, 0], normals[k, 1], normals[k, 2]
        offset = a * points[k, 0] + b * points[k, 1] + d * points[k, 2]
        for i in range(len(points)):
            height = a * points[i, 0] + b * points[i, 1] + d * points[i, 2] - offset
            if abs(height) < tolerance:
                on[c, i] = abs(a * normals[i, 0] + b * normals[i, 1] + d * normals[i, 2]) > MIN_COSINE
    return on
