"""Refinement on the fine clouds: transform in, transform out (Sec. III-E)."""

from __future__ import annotations

import numpy as np

from csgm_ros.cloud.normals import cosine
from csgm_ros.config import Config
from csgm_ros.transform import icp
from csgm_ros.transform.batch_icp import refine_all
from csgm_ros.types import Similarity, Surface

MAX_CORRESPONDENCE_DISTANCES = (0.03, 0.015)  # of the short ICP, in radii


def refine_finalists(finalists: np.ndarray, source: Surface, target: Surface, config: Config) -> list[Similarity]:
    """Refine (F, 4, 4) transforms by a short ICP on the fine clouds."""
    if not len(finalists):
        return []
    refined = refine_all(
        finalists,
        source.grid,
        target.grid,
        (source.sample, target.sample),
        MAX_CORRESPONDENCE_DISTANCES,
        cosine(config.verification.max_normal_angle),
        estimate_scale=config.scale.estimate_scale,
    )
    return [Similarity.from_matrix(matrix) for matrix in refined]


def refine_best(
    start: Similarity, source: Surface, target: Surface, config: Config, *, estimate_scale: bool
) -> Similarity:
    """Return the transform after the final ICP of the paper."""
    part = config.icp
    return icp.refine(
        source.probe,
        target.points,
        start,
        part.max_correspondence_distances,
        iterations=part.iterations,
        estimate_scale=estimate_scale,
        threads=config.threads,
    )
