"""The registration pipeline: Algorithm 1 of the paper, stage by stage."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from csgm_ros import hypotheses, icp, local_features, nearest, preprocess, verification
from csgm_ros.config import Config, profile
from csgm_ros.scale import normalization
from csgm_ros.types import PreparedCloud, RegistrationResult, Similarity, Verdict

Progress = Callable[[str, float], None]


def register(
    source: np.ndarray,
    target: np.ndarray,
    config: Config | None = None,
    *,
    seed: int = 0,
    on_progress: Progress | None = None,
) -> RegistrationResult:
    """Find the similarity that lays the source on the target, ``x_target = s R x_source + t``.

    Parameters
    ----------
    source, target : (N, 3), (M, 3) ndarray
        Points in any unit and pose; rows that are not finite are ignored.
    config : Config, optional
        Default: profile ``robust``.
    seed : int, optional
        Same input, configuration and seed: same bits.
    on_progress : callable, optional
        Called as ``on_progress(stage, fraction)``; raise :class:`csgm_ros.errors.Cancelled` from it to stop.

    Returns
    -------
    RegistrationResult
        Look at ``accepted`` before you use ``transform``.

    Raises
    ------
    InputError
        A cloud that cannot be registered; the message names which one and why.
    Cancelled
        Whatever ``on_progress`` raised.
    """
    config = config or profile()
    rng = np.random.default_rng(seed)
    clock = _Clock(on_progress)
    clock.enter('prepare', 0.0)
    clouds = [preprocess.finite_points(cloud, name) for cloud, name in ((source, 'source'), (target, 'target'))]
    source_cloud, target_cloud = (_prepared(cloud, config) for cloud in clouds)
    clock.enter('hypotheses', 0.2)
    candidates = _local_hypotheses(source_cloud, target_cloud, config, rng)
    clock.enter('verification', 0.5)
    best, verdict = _verify(candidates, source_cloud, target_cloud, config, rng)
    clock.enter('icp', 0.8)
    best = _final_icp(clouds, best, target_cloud, config)
    clock.enter('done', 1.0)
    return RegistrationResult(best, verdict, clock.timings, seed, config)


class _Clock:
    """Names the running stage to the caller and keeps the wall seconds of each."""

    def __init__(self, on_progress: Progress | None):
        self.timings: dict[str, float] = {}
        self._on_progress = on_progress
        self._stage, self._since = '', time.perf_counter()

    def enter(self, stage: str, fraction: float) -> None:
        now = time.perf_counter()
        if self._stage:
            self.timings[self._stage] = self.timings.get(self._stage, 0.0) + now - self._since
        self._stage, self._since = stage, now
        if self._on_progress:
            self._on_progress(stage, fraction)


def _prepared(points: np.ndarray, config: Config) -> PreparedCloud:
    part = config.preprocess
    return preprocess.prepare(points, normalization(points), part.voxel_size, part.normal_neighbors)


def _local_hypotheses(source: PreparedCloud, target: PreparedCloud, config: Config, rng) -> np.ndarray:
    part, found = config.hypotheses, []
    chosen = rng.permutation(len(source.points))[: part.features]
    target_features = local_features.fpfh(target, part.feature_radius)
    for relative in part.relative_scales:
        source_features = local_features.fpfh(source, part.feature_radius * relative)[chosen]
        pairs = local_features.partners(source_features, target_features, part.partners)
        i, a = chosen[pairs[:, 0]], pairs[:, 1]
        matches = hypotheses.Correspondences(source.points[i], target.points[a], source.normals[i], target.normals[a])
        found.append(
            hypotheses.from_triples(
                matches,
                rng,
                part.trials,
                scale_range=(1 / relative / 1.3, 1 / relative * 1.3),
                min_length=part.min_side,
                side_tolerance=part.side_tolerance,
                limit=part.limit,
            )
        )
    return np.concatenate(found)


def _verify(candidates, source: PreparedCloud, target: PreparedCloud, config: Config, rng):
    part = config.verification
    grids = [nearest.build(c.points, c.normals, 0.025, 0.12) for c in (source, target)]
    samples = tuple(rng.permutation(len(c.points))[: part.samples] for c in (source, target))
    min_cosine = float(np.cos(np.radians(part.max_normal_angle)))
    scores = verification.both_coverages(candidates, *grids, part.coarse_distance, min_cosine, samples).min(1)
    probe = source.points[samples[0]]
    kept = verification.best_distinct(candidates, scores, probe, part.distinct, part.refined)
    refined = verification.refine_all(candidates[kept], *grids, part.gates, min_cosine)
    if len(refined) == 0:
        return Similarity.identity(), Verdict(False, 'no hypothesis', 0.0, 0.0, float('inf'), 0.0)
    fitness = verification.both_coverages(refined, *grids, part.inlier_distance, min_cosine)
    smaller = fitness.min(1)
    ranked = verification.best_distinct(refined, smaller, probe, part.distinct, 2)
    best = ranked[0]
    margin = float(smaller[best] / max(smaller[ranked[1]], 1e-9)) if len(ranked) > 1 else float('inf')
    accepted = bool(smaller[best] >= part.min_fitness and margin >= part.min_margin)
    reason = f'fitness {fitness[best, 0]:.2f} and {fitness[best, 1]:.2f}, margin {margin:.2f}'
    own = target.normalization.inverse() @ Similarity.from_matrix(refined[best]) @ source.normalization
    return own, Verdict(accepted, reason, float(fitness[best, 0]), float(fitness[best, 1]), 0.0, margin)


def _final_icp(clouds, start: Similarity, target: PreparedCloud, config: Config) -> Similarity:
    part, radius = config.icp, 1.0 / target.normalization.scale
    thin = [
        preprocess.voxel_means(clouds[0], part.voxel_size * radius / start.scale),
        preprocess.voxel_means(clouds[1], part.voxel_size * radius),
    ]
    gates = tuple(gate * radius for gate in part.gates)
    return icp.refine(*thin, start, gates, iterations=part.iterations, estimate_scale=config.scale.estimate_scale)


def warm_up() -> None:
    """Compile every kernel by registering a small synthetic cloud with itself (cached on disk afterwards)."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(2000, 3)) * (3.0, 2.0, 1.0)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    register(points * (3.0, 2.0, 1.0), points * (3.0, 2.0, 1.0))
