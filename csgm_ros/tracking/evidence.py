"""What speaks for and against a pose in the map: surfaces that meet, and free space that was seen through.

The viewpoint of every frame is known, so a pose is contradicted by each map point that would lie where the sensor
looked through. What lies behind a seen surface, or beside the view, says nothing: a part is not blamed for the
rest of the whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from csgm_ros.cloud.kernels import kernel
from csgm_ros.tracking.surface import Surface, nearest
from csgm_ros.tracking.views import View, seen

TOLERANCE = 0.04  # of the range, by which a map point may miss the surface that was seen


class Evidence(NamedTuple):
    """How well a pose is supported.

    Attributes
    ----------
    on_map : float
        Mean closeness of the frame's points to the map's surface, in [0, 1]; 0 where the normals differ.
    share : float
        Share of the frame's points near the map's surface, normals aside.
    agreement : float
        Of the map points that the sensor must have seen or seen through, the share that it saw.
    told : int
        Number of those map points.
    """

    on_map: float
    share: float
    agreement: float
    told: int

    @property
    def score(self) -> float:
        """Both in one number, for ranking."""
        return self.on_map * self.agreement

    def reaches(self, least: tuple[float, float]) -> bool:
        """Return whether closeness on the map and agreement are at least so large."""
        return self.on_map >= least[0] and self.agreement >= least[1]


def weigh(
    points: np.ndarray,
    normals: np.ndarray,
    map_surface: Surface,
    map_points: np.ndarray,
    transform: np.ndarray,
    views: Sequence[View],
) -> Evidence:
    """Weigh a pose.

    Parameters
    ----------
    points, normals : (N, 3) ndarray
        Of the sensor's surface.
    map_surface : Surface
        In map units; its voxel is the distance that counts as near.
    map_points : (M, 3) ndarray
        Sample of the map.
    transform : (4, 4) ndarray
        Similarity from the points' frame to the map.
    views : sequence of View
        Their matrices lead to the points' frame.
    """
    on_map, share = meet(points, normals, map_surface, transform)
    inverse = np.linalg.inv(transform)
    for_, against = np.zeros(len(map_points), np.int32), np.zeros(len(map_points), np.int32)
    for view in views:
        told = seen(map_points, inverse, view, TOLERANCE)
        for_ += told > 0
        against += told < 0
    known = for_ + against > 0
    agreement = float((for_[known] / (for_ + against)[known]).mean()) if known.any() else 0.0
    return Evidence(on_map, share, agreement, int(known.sum()))


def meet(points: np.ndarray, normals: np.ndarray, map_surface: Surface, transform: np.ndarray) -> tuple[float, float]:
    """Return ``on_map`` and ``share`` of :class:`Evidence` of (N, 3) points with normals."""
    out = np.zeros(2)
    _meet(points, normals, map_surface, transform, 0.6, out)
    return float(out[0]), float(out[1])


@kernel
def _meet(points, normals, surface, m, min_cosine, out):
    scale = np.sqrt(m[0, 0] ** 2 + m[1, 0] ** 2 + m[2, 0] ** 2)
    close, near = 0.0, 0
    still, still_normals, keys, first, around, table, origin, voxel = surface
    for p in range(len(points)):
        a, b, c = points[p, 0], points[p, 1], points[p, 2]
        x = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c + m[0, 3]
        y = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c + m[1, 3]
        z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c + m[2, 3]
        q = nearest(still, keys, first, around, table, origin, voxel, x, y, z)
        if q < 0:
            continue
        dx, dy, dz = x - still[q, 0], y - still[q, 1], z - still[q, 2]
        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
        if distance >= voxel:
            continue
        near += 1
        a, b, c = normals[p, 0], normals[p, 1], normals[p, 2]
        product = (
            (m[0, 0] * a + m[0, 1] * b + m[0, 2] * c) * still_normals[q, 0]
            + (m[1, 0] * a + m[1, 1] * b + m[1, 2] * c) * still_normals[q, 1]
            + (m[2, 0] * a + m[2, 1] * b + m[2, 2] * c) * still_normals[q, 2]
        )
        if abs(product) >= min_cosine * scale:
            close += 1.0 - distance / voxel
    n = max(len(points), 1)
    out[0], out[1] = close / n, near / n
