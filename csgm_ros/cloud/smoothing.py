"""Noise averaged away: points moved onto the planes of their neighbours."""

from __future__ import annotations

import numpy as np

from csgm_ros.cloud.plane_fit import fit_planes
from csgm_ros.cloud.voxels import voxel_means
from csgm_ros.progress import Look, unhurried

VOXEL = 0.02  # of the radius


def smoothed(points: np.ndarray, neighbors: int, rounds: int = 2, look: Look = unhurried) -> np.ndarray:
    """Move every voxel of a cloud of radius 1 onto the plane of its nearest neighbours, a few times.

    Parameters
    ----------
    points : (N, 3) ndarray
        Cloud of radius about 1.
    neighbors : int
        The noise falls with their root, and so does the detail.
    look : callable, optional
        Asked before every round.

    Returns
    -------
    (M, 3) ndarray
        One point a voxel.
    """
    moved = voxel_means(points, VOXEL)
    for _ in range(rounds):
        look()
        planes = fit_planes(moved, neighbors, moved)
        moved = moved - ((moved - planes.means) * planes.normals).sum(1, keepdims=True) * planes.normals
    return moved
