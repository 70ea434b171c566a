"""Fast point feature histograms (FPFH) of a cloud's surroundings of arbitrary places.

Rusu et al. 2009: each pair of points with normals gives three angles; their histograms, 11 bins each, make the
simplified feature (SPFH) of a point, and a weighted mean of those around a place makes its FPFH.
"""

from __future__ import annotations

import numpy as np

from csgm_ros.cloud.kernels import kernel

BINS = 11
WIDTH = 3 * BINS
MAX_POINTS = 3000  # more are thinned: pairs grow with their square, and what they tell does not


def fpfh(points: np.ndarray, normals: np.ndarray, radius: float, places: np.ndarray) -> np.ndarray:
    """Return the FPFH of (n, 3) places among (v, 3) points, (n, 33); zeros where no pair of points is near.

    Parameters
    ----------
    points, normals : (v, 3) ndarray
        A cloud and its unit normals with a consistent sign; points without a normal (NaN or
        zero) are left out.
    radius : float
        Both for the pairs of an SPFH and for the SPFHs of a place, in the unit of the points.
    places : (n, 3) ndarray
        They need not be points of the cloud.

    Returns
    -------
    (n, 33) ndarray
        Each of the three histograms sums to 100.

    Notes
    -----
    An SPFH weighs ``1 / (d^2 + (radius / 10)^2)``. The original weighs ``1 / d^2`` and adds the point's own; a
    place that is no point has none, and may have a point at d = 0.
    """
    defined = np.isfinite(normals).all(1) & (normals != 0).any(1)
    points, normals = points[defined], normals[defined]
    if not len(points):
        return np.zeros((len(places), WIDTH))
    axis = int(np.argmax(np.ptp(points, axis=0)))
    order = np.argsort(points[:, axis], kind='stable')[:: -(-len(points) // MAX_POINTS)]
    points = np.ascontiguousarray(points[order], np.float64)
    features = _spfh(points, np.ascontiguousarray(normals[order], np.float64), radius, axis)
    return _weighted_means(points, features, radius, np.ascontiguousarray(places, np.float64))


@kernel
def _spfh(points, normals, radius, axis):
    """Return the SPFH of each point; the points are sorted along ``axis``, so a sweep finds the pairs."""
    counts = np.zeros((len(points), WIDTH))
    for i in range(len(points)):
        for j in range(i + 1, len(points)):
            if points[j, axis] - points[i, axis] > radius:
                break
            x, y, z = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
            distance = np.sqrt(x * x + y * y + z * z)
            if distance > radius or distance == 0:
                continue
            defined, theta, alpha, phi = _pair_bins(normals, i, j, x / distance, y / distance, z / distance)
            if defined:
                for p in (i, j):
                    counts[p, theta] += 1
                    counts[p, BINS + alpha] += 1
                    counts[p, 2 * BINS + phi] += 1
    for i in range(len(points)):
        total = counts[i, :BINS].sum()
        if total > 0:
            counts[i] *= 100 / total
    return counts


@kernel
def _pair_bins(normals, i, j, x, y, z):
    """Return whether a pair with unit direction d = (x, y, z) from i to j has angles, and their bins.

    The frame u, v = d x u, w = u x v sits at the point whose normal u is nearer to the direction, so that either
    order of the points gives the same. With the other normal n, ``w . n = (d . n - (u . d) (u . n)) / |d x u|``.
    """
    along_u = normals[i, 0] * x + normals[i, 1] * y + normals[i, 2] * z
    along_n = normals[j, 0] * x + normals[j, 1] * y + normals[j, 2] * z
    if abs(along_u) < abs(along_n):
        i, j, x, y, z, along_u, along_n = j, i, -x, -y, -z, -along_n, -along_u
    sine = np.sqrt(max(1 - along_u * along_u, 0.0))
    if sine < 1e-9:
        return False, 0, 0, 0
    ux, uy, uz = normals[i, 0], normals[i, 1], normals[i, 2]
    nx, ny, nz = normals[j, 0], normals[j, 1], normals[j, 2]
    between = ux * nx + uy * ny + uz * nz
    triple = nx * (y * uz - z * uy) + ny * (z * ux - x * uz) + nz * (x * uy - y * ux)
    theta = np.arctan2((along_n - along_u * between) / sine, between)
    return True, _bin(theta / np.pi), _bin(triple / sine), _bin(along_u)


@kernel
def _bin(value):
    """Return the bin of a value in [-1, 1]."""
    return min(max(int(BINS * (value + 1) / 2), 0), BINS - 1)


@kernel
def _weighted_means(points, features, radius, places):
    """Return the weighted mean feature of the points within the radius of each place."""
    means = np.zeros((len(places), WIDTH))
    for k in range(len(places)):
        for i in range(len(points)):
            squared = 0.0
            for a in range(3):
                squared += (points[i, a] - places[k, a]) ** 2
            if squared <= radius * radius:
                means[k] += features[i] / (squared + (0.1 * radius) ** 2)
        total = means[k].sum()
        if total > 0:
            means[k] *= 300 / total
    return means
