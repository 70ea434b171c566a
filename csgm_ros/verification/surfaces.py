"""The clouds as verification sees them, finely sampled."""

from __future__ import annotations

import numpy as np

from csgm_ros.cloud import nearest_grid
from csgm_ros.cloud.prepare import prepare
from csgm_ros.config import Config
from csgm_ros.types import Surface

CELL, REACH = 0.015, 0.045  # of the look-up table, in radii
MIN_NORMAL_ANGLE = 15.0  # degrees that normals may always differ by: surfaces bend within the inlier distance
SMOOTH_ROUGH = (7.5, 15.0)  # degrees between neighbouring normals: a surface; nothing but noise
MAX_GAP = 2.0  # inlier distances; farther from its points a surface may be anywhere


def surface(points: np.ndarray, config: Config, rng: np.random.Generator) -> Surface:
    """Sample a cloud of (N, 3) points in the normalised frame; ``rng`` draws the points that are measured."""
    from scipy.spatial import cKDTree

    part, neighbors = config.verification, config.preprocess.normal_neighbors
    cloud = prepare(points, part.fine_voxel_size, neighbors)
    tree = cKDTree(cloud.points)
    sample = rng.permutation(len(cloud.points))[: part.fine_samples]
    distances, near = tree.query(cloud.points[sample], k=range(1, min(neighbors, len(cloud.points)) + 1))
    cosines = np.abs(
        np.einsum('sd,skd->sk', cloud.normals[sample], cloud.normals[near[:, [min(1, near.shape[1] - 1), -1]]])
    )
    angles = np.degrees(np.arccos(np.minimum(cosines, 1.0)))
    spacing = np.median(distances[:, :5][:, -1])
    known = np.interp(np.median(angles[:, 0]), SMOOTH_ROUGH, (1.0, 0.0))
    return Surface(
        cloud.points,
        cloud.normals,
        tree,
        nearest_grid.build(cloud.points, cloud.normals, CELL, REACH),
        sample,
        float(np.clip(spacing - part.inlier_distance, 0.0, MAX_GAP * part.inlier_distance) * known),
        float(np.median(angles[:, 1])),
    )


def normal_angle(source: Surface, target: Surface, config: Config) -> float:
    """Return the angle in degrees that the normals of two clouds may differ by: little more than in one of them."""
    part = config.verification
    return min(part.max_normal_angle, max(MIN_NORMAL_ANGLE, part.normal_tolerance * max(source.bend, target.bend)))
