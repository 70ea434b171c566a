"""Step 5, ICP: local refinement of a transform (Sec. III-E). The iteration itself is Open3D's."""

from __future__ import annotations

import os

import numpy as np

from csgm_ros.progress import Look, unhurried
from csgm_ros.types import Similarity


def refine(
    source: np.ndarray,
    target: np.ndarray,
    start: Similarity,
    max_correspondence_distances: tuple[float, ...],
    *,
    iterations: int = 30,
    estimate_scale: bool = True,
    threads: int = 0,
    look: Look = unhurried,
) -> Similarity:
    """Refine a transform by point-to-point ICP, one run per distance, wide to narrow.

    Parameters
    ----------
    source, target : (N, 3), (M, 3) ndarray
        Clouds in one frame and unit each.
    start : Similarity
        Transform to start from.
    max_correspondence_distances : tuple of float
        Target units.
    iterations : int, optional
        At most, per run; 0 leaves the transform alone.
    estimate_scale : bool, optional
        Refine the scale too. The paper leaves it at Eq. (1), whose error reaches 42 %.
    threads : int, optional
        Threads at most; 0 takes every core.
    look : callable, optional
        Asked before every run.

    Returns
    -------
    Similarity
    """
    if iterations == 0:
        return start
    import open3d

    if hasattr(open3d.utility, 'set_max_threads'):  # from Open3D 0.20 on
        open3d.utility.set_max_threads(threads or os.cpu_count() or 1)
    registration = open3d.pipelines.registration
    clouds = [open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)) for points in (source, target)]
    criteria = registration.ICPConvergenceCriteria(max_iteration=iterations)
    estimation = registration.TransformationEstimationPointToPoint(estimate_scale)
    matrix = start.matrix
    for distance in max_correspondence_distances:
        look()
        result = registration.registration_icp(*clouds, distance, matrix, estimation, criteria)
        if len(result.correspondence_set) < 3:
            break
        matrix = result.transformation
    return Similarity.from_matrix(matrix)
