"""The registration pipeline: Algorithm 1 of the paper, stage by stage."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from csgm_ros import hypotheses, icp, local_features, preprocess
from csgm_ros import search as transform_search
from csgm_ros.config import Config, profile
from csgm_ros.scale import normalization
from csgm_ros.structure import Structure, extract
from csgm_ros.types import RegistrationResult, Similarity
from csgm_ros.voxels import voxel_means

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
    clock = Clock(on_progress, config.time_budget)

    clock.enter('normalization', 0.0)
    clouds = preprocess.finite_points(source, 'source'), preprocess.finite_points(target, 'target')
    normalizations = normalization(clouds[0]), normalization(clouds[1])
    clock.enter('structure', 0.05)
    structures = [extract(points, n, config) for points, n in zip(clouds, normalizations, strict=True)]
    clock.enter('hypotheses', 0.4)
    candidates = _hypotheses(*structures, config, rng)
    clock.enter('search', 0.6)
    surfaces = [structure.surface for structure in structures]
    finalists = transform_search.search(
        candidates, *surfaces, config, rng, lambda share: clock.tick(0.6 + 0.25 * share)
    )
    clock.enter('verdict', 0.85)
    polish = _final_icp(clouds, normalizations, config)
    best, verdict = transform_search.judge(finalists, clouds, normalizations, config, rng, polish)
    clock.enter('done', 1.0)
    own = normalizations[1].inverse() @ best @ normalizations[0]
    return RegistrationResult(own, verdict, clock.timings, seed, config)


class Clock:
    """Names the running stage to the caller, keeps the wall seconds of each and the time budget."""

    def __init__(self, on_progress: Progress | None, time_budget: float):
        self.timings: dict[str, float] = {}
        self._on_progress = on_progress
        self._stage, self._since = '', time.perf_counter()
        self._deadline = self._since + time_budget if time_budget > 0.0 else float('inf')

    def enter(self, stage: str, fraction: float) -> None:
        """End the running stage and begin another."""
        now = time.perf_counter()
        if self._stage:
            self.timings[self._stage] = now - self._since
        self._stage, self._since = stage, now
        self.tick(fraction)

    def tick(self, fraction: float) -> bool:
        """Report progress within a stage; False when the time budget is spent."""
        if self._on_progress:
            self._on_progress(self._stage, fraction)
        return time.perf_counter() < self._deadline


def _hypotheses(source: Structure, target: Structure, config: Config, rng: np.random.Generator) -> np.ndarray:
    part = config.hypotheses
    found = [np.empty((0, 4, 4))]
    if part.sources in ('graph', 'both'):
        pairs = local_features.partners(source.node_features, target.node_features, part.partners)
        found.append(_triples(source.supervoxels, target.supervoxels, pairs, config, rng))
    if part.sources in ('local', 'both'):
        pairs = local_features.partners(source.features, target.features, part.partners)
        found.append(_triples(source.keypoints, target.keypoints, pairs, config, rng))
    return np.concatenate(found)


def _triples(source, target, pairs, config, rng):
    part = config.hypotheses
    i, a = pairs.T
    matches = hypotheses.Correspondences(_places(source)[i], _places(target)[a], source.normals[i], target.normals[a])
    return hypotheses.from_triples(
        matches,
        rng,
        part.trials,
        scale_range=(1 / part.scale_factor, part.scale_factor),
        min_length=part.min_side,
        side_tolerance=part.side_tolerance,
        limit=part.limit,
    )


def _places(cloud):
    return cloud.points if hasattr(cloud, 'points') else cloud.centroids


def _final_icp(clouds, normalizations, config: Config):
    part = config.icp
    thin = [
        voxel_means(normalization.apply(points), part.voxel_size)
        for points, normalization in zip(clouds, normalizations, strict=True)
    ]
    thin[0] = thin[0][:: max(len(thin[0]) // 4000, 1)]

    def polish(start: Similarity) -> Similarity:
        return icp.refine(
            *thin, start, part.gates, iterations=part.iterations, estimate_scale=config.scale.estimate_scale
        )

    return polish


def warm_up() -> None:
    """Compile every kernel by registering a small synthetic cloud with itself (cached on disk afterwards)."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(3000, 3))
    points *= np.array((3.0, 2.0, 1.0)) / np.linalg.norm(points, axis=1, keepdims=True)
    for name in ('robust', 'paper'):
        register(points, points, profile(name))
