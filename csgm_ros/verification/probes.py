"""Symmetry probes: transforms that would fit as well if the scene repeated itself, turned onto itself or had no scale.

The search finds what competes with its winner only by chance. A corridor slid along itself, a table turned by half a
turn or a corner blown up is easily proposed, once the winner is known.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

SLIDES = np.array([-1.2, -1.0, -0.8, -0.6, -0.4, -0.2, 0.2, 0.4, 0.6, 0.8, 1.0, 1.2])  # RMS radii of the overlap
TURNS = (90.0, 180.0, 270.0)
FINER_TURNS = (30.0, 60.0, 72.0, 120.0, 144.0)  # about the axis of revolution, if there were one
SCALES = (0.7, 0.8, 0.88, 0.94, 1.06, 1.14, 1.25, 1.43)
MIRRORS = 96  # planes in all directions: that in which an object is nearly symmetric may be any, and is missed by 40
SAME_AXIS, SAME_SLIDE = 0.97, 0.995  # cosines from which two axes are one


def symmetries(transform: np.ndarray, points: np.ndarray, normals: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return (S, 4, 4) slides and turns of a (4, 4) transform, along and about the axes of its overlap.

    Parameters
    ----------
    points, normals : (I, 3) ndarray
        Where the clouds agree, in the target's frame.
    weights : (I,) ndarray
    """
    centre = points.mean(0)
    spread, along = np.linalg.eigh(np.cov((points - centre).T))
    length = np.sqrt(spread.sum())
    _, across = np.linalg.eigh((normals * weights[:, None]).T @ normals)  # weakest first: where nothing holds it
    found = []
    # what faces nearly one way has a plane of weak directions, and a wall its windows along its edges
    for axis in _different((across[:, 0], across[:, 1], along[:, 2], along[:, 1]), SAME_SLIDE):
        found += [_moved(axis * t * length) @ transform for t in SLIDES]
    middle = _middle(points, across)
    for axis in _different((*across.T, *along.T)):
        found += [_turned(middle, axis, a) @ transform for a in TURNS]
    axis = _revolution(spread, along)
    found += [_turned(middle, axis, a) @ transform for a in FINER_TURNS]
    return np.array(found)


def mirrors(
    transform: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    weights: np.ndarray,
    clouds: tuple[np.ndarray, np.ndarray],
    apart: float,
) -> np.ndarray:
    """Return (M, 4, 4): a (4, 4) transform, then a mirror, see :func:`symmetries`.

    The planes go through the middle of the overlap and of either of the ``clouds`` (N, 3) in the target's frame: of an
    object that is nearly its own mirror image two views may share only one side. Parallel ones are ``apart``.
    """
    _, along = np.linalg.eigh(np.cov(points.T))
    _, across = np.linalg.eigh((normals * weights[:, None]).T @ normals)
    axes = *_different((*across.T, *along.T)), *_hemisphere(MIRRORS)
    found = []
    middles = np.array([_middle(part, across) for part in (points, *clouds)])
    for axis in axes:
        kept: list[float] = []
        for offset in middles @ axis:
            if all(abs(offset - other) > apart for other in kept):
                kept.append(offset)
                change = np.eye(4)
                change[:3, :3] -= 2.0 * np.outer(axis, axis)
                change[:3, 3] = 2.0 * axis * offset
                found.append(change @ transform)
    return np.array(found)


def scales(transform: np.ndarray, points: np.ndarray, factors: Iterable[float] = SCALES) -> np.ndarray:
    """Return (F, 4, 4): a (4, 4) transform at other scales about the middle of (I, 3) points of its overlap."""
    centre = points.mean(0)
    found = []
    for factor in factors:
        change = np.diag([factor, factor, factor, 1.0])
        change[:3, 3] = (1.0 - factor) * centre
        found.append(change @ transform)
    return np.array(found)


def _hemisphere(count: int) -> np.ndarray:
    """Return (count, 3) directions spread evenly over half a sphere: a Fibonacci lattice."""
    height = (np.arange(count) + 0.5) / count
    angle = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(count)
    ring = np.sqrt(1.0 - height**2)
    return np.column_stack([ring * np.cos(angle), ring * np.sin(angle), height])


def _different(axes: Iterable[np.ndarray], same: float = SAME_AXIS) -> list[np.ndarray]:
    kept: list[np.ndarray] = []
    for axis in axes:
        if all(abs(axis @ other) < same for other in kept):
            kept.append(axis)
    return kept


def _middle(points: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Halfway between the ends along each axis: unlike the mean, it does not lean to where the points are dense."""
    return axes @ np.percentile(points @ axes, (2, 98), axis=0).mean(0)


def _revolution(spread: np.ndarray, along: np.ndarray) -> np.ndarray:
    """The axis across the two directions in which the points spread most alike."""
    return along[:, 2] if spread[1] - spread[0] < spread[2] - spread[1] else along[:, 0]


def _moved(offset: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = offset
    return matrix


def _turned(centre: np.ndarray, axis: np.ndarray, degrees: float) -> np.ndarray:
    angle = np.radians(degrees)
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix = np.eye(4)
    matrix[:3, :3] += np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    matrix[:3, 3] = centre - matrix[:3, :3] @ centre
    return matrix
