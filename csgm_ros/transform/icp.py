"""Step 5, ICP: local refinement of a transform (Sec. III-E). The iteration itself is Open3D's."""

from __future__ import annotations

import numpy as np

from csgm_ros.types import Similarity


def refine(
    source: np.ndarray,
    target: np.ndarray,
    start: Similarity,
    gates: tuple[float, ...],
    *,
    iterations: int = 30,
    estimate_scale: bool = True,
) -> Similarity:
    """Refine a transform by point-to-point ICP, one run per gate, wide to narrow.

    Parameters
    ----------
    source, target : (N, 3), (M, 3) ndarray
        Clouds in one frame and unit each.
    start : Similarity
        Transform to start from.
    gates : tuple of float
        Largest distance of a correspondence, target units.
    iterations : int, optional
        At most, per gate.
    estimate_scale : bool, optional
        Refine the scale too. The paper leaves it at Eq. (1), whose error reaches 42 %.

    Returns
    -------
    Similarity
    """
    import open3d

    registration = open3d.pipelines.registration
    clouds = [open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)) for points in (source, target)]
    criteria = registration.ICPConvergenceCriteria(max_iteration=iterations)
    estimation = registration.TransformationEstimationPointToPoint(estimate_scale)
    matrix = start.matrix
    for gate in gates:
        result = registration.registration_icp(*clouds, gate, matrix, estimation, criteria)
        if len(result.correspondence_set) < 3:
            break
        matrix = result.transformation
    return Similarity.from_matrix(matrix)
