"""How far a cloud is from a surface."""

from __future__ import annotations

import numpy as np

from csgm_ros.cloud.plane_fit import fit_planes
from csgm_ros.cloud.voxels import voxel_means

SAMPLES = 2000
EVEN_VOXEL = 0.03  # of the radius: the density at which clouds are compared


def surface_variation(points: np.ndarray, neighbors: int = 40) -> float:
    """Return how far (N, 3) points are from a surface: median ratio of the two smaller extents of a neighbourhood.

    0 for planes, about 0.3 for scanned objects, 0.7 for the SfM cloud of a room, 0.8 and more for noise that hides
    the surface.

    Notes
    -----
    Pauly et al. 2002 divide the smallest variance by the sum of all three, which an edge lowers as much as a plane;
    the ratio of the two smaller extents tells a line of points from a sheet.
    """
    extents = fit_planes(points, neighbors, points[:: -(-len(points) // SAMPLES)]).extents()
    return float(np.median(extents[:, 0] / np.maximum(extents[:, 1], 1e-12)))


def even(points: np.ndarray, radius: float) -> np.ndarray:
    """Thin (N, 3) points of a radius to the density at which surface variation is compared."""
    return voxel_means(points, EVEN_VOXEL * radius)
