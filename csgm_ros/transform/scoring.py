"""Scores for thousands of candidate transforms (Sec. III-E, extended).

The paper trusts one transform from RANSAC and ICP. Here every hypothesis is scored by how well the source lies
on the target *and* the target on the source, and the smaller of the two counts: a one-sided score, or the sum,
prefers shrunken solutions. Points must agree in place and in normal, and a closer point counts more.
"""

from __future__ import annotations

import numpy as np

from csgm_ros.cloud.distinct import distinct
from csgm_ros.cloud.kernels import kernel
from csgm_ros.cloud.nearest_grid import lookup
from csgm_ros.types import NearestGrid


def scores(
    transforms: np.ndarray,
    source: NearestGrid,
    target: NearestGrid,
    samples: tuple[np.ndarray, np.ndarray],
    truncation: float,
    min_cosine: float,
) -> np.ndarray:
    """Score transforms by the truncated linear score of two clouds, the smaller side counting.

    Parameters
    ----------
    transforms : (H, 4, 4) ndarray
        Similarity matrices, source to target.
    samples : pair of index arrays
        Points of source and target that are looked at.
    truncation : float
        Distance in target units at which a point counts nothing; one at distance 0 counts 1.
    min_cosine : float
        Smallest cosine between the normals, up to their sign.

    Returns
    -------
    (H,) ndarray
        In [0, 1].
    """
    forth, back = np.empty(len(transforms)), np.empty(len(transforms))
    first, second = np.sort(samples[0]), np.sort(samples[1])  # as they lie in memory: voxel by voxel
    chosen_source = source.points[first], source.normals[first]
    chosen_target = target.points[second], target.normals[second]
    _truncated_linear(*chosen_source, transforms, target, truncation, min_cosine, False, forth)
    _truncated_linear(*chosen_target, _inverses(transforms), source, truncation, min_cosine, True, back)
    return np.minimum(forth, back)


@kernel
def _truncated_linear(points, normals, transforms, grid, truncation, min_cosine, backward, out):
    """Write the mean score under each transform; ``truncation`` is in target units also when going backward."""
    for h in range(len(transforms)):
        m = transforms[h]
        scale = np.sqrt(m[0, 0] ** 2 + m[1, 0] ** 2 + m[2, 0] ** 2)
        reach = truncation * scale if backward else truncation
        total = 0.0
        for p in range(len(points)):
            a, b, c = points[p, 0], points[p, 1], points[p, 2]
            x = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c + m[0, 3]
            y = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c + m[1, 3]
            z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c + m[2, 3]
            q = lookup(grid.index, grid.origin, grid.cell, x, y, z)
            if q < 0:
                continue
            dx, dy, dz = x - grid.points[q, 0], y - grid.points[q, 1], z - grid.points[q, 2]
            squared = dx * dx + dy * dy + dz * dz
            if squared >= reach * reach:
                continue
            a, b, c = normals[p, 0], normals[p, 1], normals[p, 2]
            product = (
                (m[0, 0] * a + m[0, 1] * b + m[0, 2] * c) * grid.normals[q, 0]
                + (m[1, 0] * a + m[1, 1] * b + m[1, 2] * c) * grid.normals[q, 1]
                + (m[2, 0] * a + m[2, 1] * b + m[2, 2] * c) * grid.normals[q, 2]
            )
            if abs(product) >= min_cosine * scale:
                total += 1.0 - np.sqrt(squared) / reach
        out[h] = total / len(points)


@kernel
def _inverses(transforms):
    out = np.zeros_like(transforms)
    for h in range(len(transforms)):
        m = transforms[h]
        squared = m[0, 0] ** 2 + m[1, 0] ** 2 + m[2, 0] ** 2
        for i in range(3):
            for j in range(3):
                out[h, i, j] = m[j, i] / squared
        for i in range(3):
            out[h, i, 3] = -(out[h, i, 0] * m[0, 3] + out[h, i, 1] * m[1, 3] + out[h, i, 2] * m[2, 3])
        out[h, 3, 3] = 1.0
    return out


def best_distinct(
    transforms: np.ndarray, ranking: np.ndarray, probe: np.ndarray, distance: float, count: int
) -> np.ndarray:
    """Return the indices of the ``count`` best transforms no two of which move ``probe`` alike.

    Parameters
    ----------
    transforms : (H, 4, 4) ndarray
    ranking : (H,) ndarray
        Larger is better; ties keep the given order.
    probe : (P, 3) ndarray
        Source points.
    distance : float
        RMS displacement of the probe below which two transforms are the same.
    """
    return distinct(transforms, np.argsort(-ranking, kind='stable'), probe, distance, count)
