"""One frame of the sensor made ready: thinned evenly, with normals, and as a picture of ranges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from csgm_ros.cloud.kernels import kernel
from csgm_ros.cloud.normals import plane_normals
from csgm_ros.cloud.voxels import voxelize
from csgm_ros.tracking import views
from csgm_ros.tracking.views import View


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame in the sensor's frame, metres.

    Attributes
    ----------
    points, normals : (N, 3) ndarray
        Voxel means, and unit normals towards the viewpoint; only where a normal is defined.
    counts : (N,) ndarray
        Returns in each voxel: what is near is seen by many.
    view : View
    """

    points: np.ndarray
    normals: np.ndarray
    counts: np.ndarray
    view: View

    def chosen(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points and normals (I, 3) of an index array."""
        return self.points[index], self.normals[index]

    def sample(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return (count, 3) points and normals that stand for the returns, not for the surface that they cover."""
        total = np.cumsum(self.counts)
        return self.chosen(np.searchsorted(total, (np.arange(count) + 0.5) * (total[-1] / count)))


def prepared(points: np.ndarray, voxel: float) -> Frame:
    """Thin finite (N, 3) points to voxels of edge ``voxel`` metres and give them normals."""
    return Frame(*_surface(points, voxel), views.look(points))


def _surface(points: np.ndarray, voxel: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    grid = voxelize(points, voxel)
    normals = plane_normals(grid, np.zeros(len(grid.keys), np.int32))
    means = grid.world(grid.centroids)
    normals *= -np.sign((means * normals).sum(1, keepdims=True))
    defined = np.abs(normals).sum(1) > 0.5
    return means[defined], normals[defined], np.bincount(grid.point_voxels, minlength=len(means))[defined]


def resolution(points: np.ndarray, share: float) -> float:
    """Return the edge of the voxels that suit a sensor: a share of the median range of (N, 3) points."""
    return share * float(np.median(np.linalg.norm(points, axis=1)))


@kernel
def returns(points):
    """Return the rows of (N, 3) points that are finite and not all zero, which some drivers send for no return."""
    kept = np.empty((len(points), 3))
    count = 0
    for p in range(len(points)):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        if np.isfinite(x) and np.isfinite(y) and np.isfinite(z) and (x != 0 or y != 0 or z != 0):
            kept[count, 0], kept[count, 1], kept[count, 2] = x, y, z
            count += 1
    return kept[:count]
