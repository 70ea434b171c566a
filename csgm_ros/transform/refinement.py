"""Refinement on the fine clouds: transform in, transform out (Sec. III-E)."""

from __future__ import annotations

import numpy as np

from csgm_ros.cloud.normals import cosine
from csgm_ros.config import Config
from csgm_ros.progress import Look, unhurried
from csgm_ros.transform import icp
from csgm_ros.transform.batch_icp import refine_all
from csgm_ros.types import NearestGrid, Similarity, Surface

MAX_CORRESPONDENCE_DISTANCES = (0.03, 0.015)  # of the short ICP, in radii
MAX_PROBE_ANGLE = 40.0  # degrees


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


def refine_between(
    transforms: np.ndarray,
    grids: tuple[NearestGrid, NearestGrid],
    samples: tuple[np.ndarray, np.ndarray],
    max_correspondence_distances: tuple[float, ...],
    *,
    estimate_scale: bool,
    iterations: int = 8,
) -> np.ndarray:
    """Refine (H, 4, 4) transforms by a short ICP between two clouds as verification looks at them."""
    return refine_all(
        transforms,
        *grids,
        samples,
        max_correspondence_distances,
        cosine(MAX_PROBE_ANGLE),
        iterations=iterations,
        estimate_scale=estimate_scale,
    )


def refine_best(
    start: Similarity,
    source: Surface,
    target: Surface,
    config: Config,
    *,
    estimate_scale: bool,
    look: Look = unhurried,
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
        look=look,
    )
