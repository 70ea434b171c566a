"""How well two clouds lie on each other under a transform: exact nearest points of finely sampled surfaces.

Unrelated surfaces can be laid on each other so that many points are close. What gives them away is that they cross
where they touch: their normals differ by more than those of one surface do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from csgm_ros.cloud.prepare import prepare
from csgm_ros.config import Config
from csgm_ros.transform.similarity import cosine
from csgm_ros.types import Similarity

MIN_NORMAL_ANGLE = 15.0  # degrees that normals may always differ by: surfaces bend within the inlier distance
SMOOTH_ROUGH = (7.5, 15.0)  # degrees between neighbouring normals: a surface; nothing but noise
MAX_GAP = 2.0  # inlier distances; farther from its points a surface may be anywhere


@dataclass(frozen=True, eq=False)
class Surface:
    """A finely sampled cloud of radius about 1 and what can be told from it about the surface.

    Attributes
    ----------
    points, normals : (N, 3) ndarray
    tree : cKDTree
        Of the points.
    sample : (S,) index array
        The points that are measured.
    gap : float
        How far aside of a point the surface still is: the distance to its fourth neighbour, as far as that exceeds
        the inlier distance, and at most twice that. 0 where noise hides how the surface goes on.
    bend : float
        Median angle in degrees between the normals across the neighbourhoods that these were estimated from:
        curvature, and noise.
    roughness : (S,) ndarray
        Angle in degrees between the normals of every measured point and its nearest neighbour: noise.
    """

    points: np.ndarray
    normals: np.ndarray
    tree: cKDTree
    sample: np.ndarray
    gap: float
    bend: float
    roughness: np.ndarray


@dataclass(frozen=True)
class Fit:
    """How two clouds lie on each other under one transform.

    Attributes
    ----------
    fitness_source, fitness_target : float
        Share of either side within the inlier distance of the other, normals agreeing.
    closeness : float
        The smaller side's mean closeness: 1 at distance 0, 0 at the inlier distance.
    rmse : float
        RMS distance of the inliers of both sides.
    """

    fitness_source: float
    fitness_target: float
    closeness: float
    rmse: float


def surface(points: np.ndarray, normalization: Similarity, config: Config, rng: np.random.Generator) -> Surface:
    """Sample a cloud of (N, 3) points in its own unit; ``rng`` draws the points that are measured."""
    part, neighbors = config.verification, config.preprocess.normal_neighbors
    cloud = prepare(points, normalization, part.fine_voxel_size, neighbors)
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
        sample,
        float(np.clip(spacing - part.inlier_distance, 0.0, MAX_GAP * part.inlier_distance) * known),
        float(np.median(angles[:, 1])),
        angles[:, 0],
    )


def normal_angle(source: Surface, target: Surface, config: Config) -> float:
    """Return the angle in degrees that the normals of two clouds may differ by: little more than in one of them."""
    part = config.verification
    return min(part.max_normal_angle, max(MIN_NORMAL_ANGLE, part.normal_tolerance * max(source.bend, target.bend)))


def attainable(source: Surface, target: Surface, max_angle: float) -> float:
    """Return the fitness that noise would leave two clouds of one surface: the noisier one's with itself."""
    return float(min((side.roughness <= max_angle).mean() for side in (source, target)))


def fit(transform: Similarity, source: Surface, target: Surface, gate: float, max_angle: float) -> Fit:
    """Measure a transform from both sides.

    Parameters
    ----------
    transform : Similarity
        Source to target.
    source, target : Surface
    gate : float
        Inlier distance, target units.
    max_angle : float
        Degrees that normals may differ by, up to their sign.
    """
    forth = _distances(transform, source, target, gate, max_angle)
    back = _distances(transform.inverse(), target, source, gate / transform.scale, max_angle) * transform.scale
    inliers = np.concatenate([side[side < gate] for side in (forth, back)])
    return Fit(
        float((forth < gate).mean()),
        float((back < gate).mean()),
        float(min(np.clip(1.0 - side / gate, 0.0, None).mean() for side in (forth, back))),
        float(np.sqrt((inliers**2).mean())) if len(inliers) else float('inf'),
    )


def _distances(transform: Similarity, moving: Surface, still: Surface, gate: float, max_angle: float) -> np.ndarray:
    """Distances of the moved sample to the other surface, (S,); infinite where far or where the normals disagree."""
    moved = transform.apply(moving.points[moving.sample])
    distances, near = still.tree.query(moved, distance_upper_bound=np.hypot(gate, gate + still.gap))
    near = np.minimum(near, len(still.points) - 1)  # where there is none, the distance is infinite
    normals = still.normals[near]
    height = ((moved - still.points[near]) * normals).sum(1)
    aside = np.sqrt(np.maximum(distances**2 - height**2, 0.0))
    cosines = np.abs(((moving.normals[moving.sample] @ transform.rotation.T) * normals).sum(1))
    return np.where(cosines >= cosine(max_angle), np.hypot(height, np.maximum(aside - still.gap, 0.0)), np.inf)
