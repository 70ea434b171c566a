"""How well two clouds lie on each other under a transform: exact nearest points of finely sampled surfaces.

Unrelated surfaces can be laid on each other so that many points are close. What gives them away is that they cross
where they touch: their normals differ by more than those of one surface do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from csgm_ros.cloud.normals import cosine
from csgm_ros.types import Similarity, Surface


@dataclass(frozen=True, eq=False)
class Evidence:
    """What is measured of one transform.

    Attributes
    ----------
    transform : Similarity
        Between the normalised clouds.
    fitness_source, fitness_target : float
        Share of either side within the inlier distance of the other, normals agreeing.
    score : float
        The smaller side's mean truncated linear score: 1 at distance 0, 0 from the inlier distance on.
    rmse : float
        RMS distance of the inliers of both sides; infinite where there are none.
    """

    transform: Similarity
    fitness_source: float
    fitness_target: float
    score: float
    rmse: float

    @property
    def fitness(self) -> float:
        """The smaller fitness of the two sides."""
        return min(self.fitness_source, self.fitness_target)


def measure(
    transform: Similarity, source: Surface, target: Surface, inlier_distance: float, max_angle: float
) -> Evidence:
    """Measure a transform from both sides.

    Parameters
    ----------
    transform : Similarity
        Source to target.
    source, target : Surface
    inlier_distance : float
        Target units.
    max_angle : float
        Degrees that normals may differ by, up to their sign.
    """
    forth = _distances(transform, source, target, inlier_distance, max_angle)
    back = _distances(transform.inverse(), target, source, inlier_distance / transform.scale, max_angle)
    back = back * transform.scale
    inliers = np.concatenate([side[side < inlier_distance] for side in (forth, back)])
    return Evidence(
        transform,
        float((forth < inlier_distance).mean()),
        float((back < inlier_distance).mean()),
        float(min(np.clip(1.0 - side / inlier_distance, 0.0, None).mean() for side in (forth, back))),
        float(np.sqrt((inliers**2).mean())) if len(inliers) else float('inf'),
    )


def _distances(
    transform: Similarity, moving: Surface, still: Surface, inlier_distance: float, max_angle: float
) -> np.ndarray:
    """Distances of the moved sample to the other surface, (S,); infinite where far or where the normals disagree."""
    moved = transform.apply(moving.probe)
    distances, near = still.tree.query(
        moved, distance_upper_bound=np.hypot(inlier_distance, inlier_distance + still.gap)
    )
    near = np.minimum(near, len(still.points) - 1)  # where there is none, the distance is infinite
    normals = still.normals[near]
    height = ((moved - still.points[near]) * normals).sum(1)
    aside = np.sqrt(np.maximum(distances**2 - height**2, 0.0))
    cosines = np.abs(((moving.normals[moving.sample] @ transform.rotation.T) * normals).sum(1))
    return np.where(cosines >= cosine(max_angle), np.hypot(height, np.maximum(aside - still.gap, 0.0)), np.inf)
