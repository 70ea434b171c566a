"""The search for the right transform: coarse score of all, short ICP of the best, exact measure of the finalists."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from csgm_ros import nearest, refinement, verification
from csgm_ros.config import Config
from csgm_ros.preprocess import prepare
from csgm_ros.types import PreparedCloud, Similarity, Verdict

BATCH = 10  # hypotheses between two looks at the clock
FINE_GATES = (0.03, 0.015)


def search(
    candidates: np.ndarray,
    source: PreparedCloud,
    target: PreparedCloud,
    config: Config,
    rng: np.random.Generator,
    on_step: Callable[[float], bool],
) -> np.ndarray:
    """Return the best different transforms after a short ICP, best first.

    Parameters
    ----------
    candidates : (H, 4, 4) ndarray
        Hypotheses between the prepared clouds.
    on_step : callable
        Told the share done now and then; returns False when the time is up.

    Returns
    -------
    (F, 4, 4) ndarray
        At most ``config.verification.finalists``.
    """
    part = config.verification
    min_cosine = float(np.cos(np.radians(part.max_normal_angle)))
    grids = [nearest.build(cloud.points, cloud.normals, 0.025, 0.12) for cloud in (source, target)]
    orders = [rng.permutation(len(cloud.points)) for cloud in (source, target)]
    few = tuple(order[: part.coarse_samples] for order in orders)
    many = tuple(order[: part.samples] for order in orders)
    probe = source.points[few[0]]
    ranking = verification.scores(candidates, *grids, few, part.coarse_distance, min_cosine)
    kept = candidates[verification.best_distinct(candidates, ranking, probe, part.distinct, part.refined)]
    refined = [np.empty((0, 4, 4))]
    for first in range(0, len(kept), BATCH):
        batch = kept[first : first + BATCH]
        refined.append(
            refinement.refine_all(
                batch, *grids, many, part.gates, min_cosine, estimate_scale=config.scale.estimate_scale
            )
        )
        if not on_step((first + len(batch)) / len(kept)):
            break
    found = np.concatenate(refined)
    ranking = verification.scores(found, *grids, many, part.score_distance, min_cosine)
    return found[verification.best_distinct(found, ranking, probe, part.distinct, part.finalists)]


def judge(
    finalists: np.ndarray,
    clouds: tuple[np.ndarray, np.ndarray],
    normalizations: tuple[Similarity, Similarity],
    config: Config,
    rng: np.random.Generator,
    final: Callable[[Similarity], Similarity],
) -> tuple[Similarity, Verdict]:
    """Measure the finalists on fine clouds, polish the winner, and pass the verdict."""
    part = config.verification
    source, target = (
        prepare(points, normalization, part.fine_voxel_size, config.preprocess.normal_neighbors)
        for points, normalization in zip(clouds, normalizations, strict=True)
    )
    min_cosine = float(np.cos(np.radians(part.max_normal_angle)))
    grids = [nearest.build(cloud.points, cloud.normals, 0.015, 0.045) for cloud in (source, target)]
    samples = tuple(rng.permutation(len(cloud.points))[: part.fine_samples] for cloud in (source, target))
    finalists = refinement.refine_all(
        finalists, *grids, samples, FINE_GATES, min_cosine, estimate_scale=config.scale.estimate_scale
    )
    judge = verification.Judge(source, target, part, rng)
    measured = [(judge.fit(transform), transform) for transform in map(Similarity.from_matrix, finalists)]
    fit, best = max(measured, key=lambda pair: pair[0].closeness)
    polished = final(best)
    again = judge.fit(polished)
    if again.closeness > fit.closeness:
        fit, best = again, polished
    rivals = [other.closeness for other, transform in measured if _differ(best, transform, source, part.different)]
    return best, judge.verdict(fit, rivals, 1.0 / normalizations[1].scale)


def _differ(first: Similarity, second: Similarity, source: PreparedCloud, distance: float) -> bool:
    offset = first.apply(source.points) - second.apply(source.points)
    return float((offset**2).sum(1).mean()) > distance**2
