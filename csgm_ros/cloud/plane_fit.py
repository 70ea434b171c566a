"""Planes through the neighbourhoods of points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from csgm_ros.cloud.kernels import kernel
from csgm_ros.cloud.normals import axes_of


class Planes(NamedTuple):
    """Planes through the neighbourhoods of P places.

    Attributes
    ----------
    means, normals : (P, 3) ndarray
        A point of each plane and its unit normal, of arbitrary sign; zeros where the neighbours are on a line.
    covariances : (P, 6) ndarray
        xx, xy, xz, yy, yz, zz of the neighbours.
    """

    means: np.ndarray
    normals: np.ndarray
    covariances: np.ndarray

    def extents(self) -> np.ndarray:
        """Return the standard deviations along the principal axes, (P, 3), ascending: the first is off the plane."""
        matrices = self.covariances[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        return np.sqrt(np.maximum(np.linalg.eigvalsh(matrices), 0.0))


def fit_planes(points: np.ndarray, neighbors: int, places: np.ndarray) -> Planes:
    """Fit a plane to the nearest points of each place by their covariance.

    Parameters
    ----------
    points : (N, 3) ndarray
        Finite points.
    neighbors : int
        Nearest points that a plane is fitted to.
    places : (P, 3) ndarray
    """
    from scipy.spatial import cKDTree

    count = min(neighbors, len(points))
    _, near = cKDTree(points).query(places, k=count)
    means, covariances = _moments(np.ascontiguousarray(points, float), near.reshape(len(places), count))
    return Planes(means, axes_of(covariances, False), covariances)


@kernel
def _moments(points, near):
    means, covariances = np.zeros((len(near), 3)), np.zeros((len(near), 6))
    count = near.shape[1]
    for p in range(len(near)):
        for n in near[p]:
            for k in range(3):
                means[p, k] += points[n, k] / count
        for n in near[p]:
            x, y, z = points[n, 0] - means[p, 0], points[n, 1] - means[p, 1], points[n, 2] - means[p, 2]
            covariances[p, 0] += x * x / count
            covariances[p, 1] += x * y / count
            covariances[p, 2] += x * z / count
            covariances[p, 3] += y * y / count
            covariances[p, 4] += y * z / count
            covariances[p, 5] += z * z / count
    return means, covariances
