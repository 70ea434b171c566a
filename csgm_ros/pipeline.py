"""The registration pipeline: Algorithm 1 of the paper, stage by stage."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from csgm_ros import partners
from csgm_ros.clock import Clock, Progress
from csgm_ros.config import Config, profile
from csgm_ros.hypotheses import from_triples
from csgm_ros.partners import GraphMatch
from csgm_ros.preprocess import finite_points
from csgm_ros.ransac import ransac
from csgm_ros.scale import normalizations, search_range
from csgm_ros.search import search
from csgm_ros.structure import extract
from csgm_ros.types import RegistrationResult, Similarity, StructureGraph, Verdict
from csgm_ros.verdict import Judge


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

    clock.enter('scale normalization', 0.0)
    clouds = finite_points(source, 'source'), finite_points(target, 'target')
    units = normalizations(*clouds, config.scale)
    clock.enter('structure extraction', 0.05)
    first, second = (extract(points, unit, config, rng) for points, unit in zip(clouds, units, strict=True))
    clock.enter('graph matching', 0.3)
    match = partners.match(first, second, config, clock)
    clock.enter('transformation estimation', 0.5)
    estimate = _paper_estimate if config.hypotheses.sources == 'ransac' else _searched_estimate
    judge = Judge(clouds, units, config, rng)
    best, verdict = estimate(clouds, (first, second), match, judge, config, rng, clock)
    clock.enter('done', 1.0)

    own = units[1].inverse() @ best @ units[0]
    graphs = [_own_unit(structure.graph, unit) for structure, unit in zip((first, second), units, strict=True)]
    offsets = best.apply(first.graph.nodes[match.pairs[:, 0]]) - second.graph.nodes[match.pairs[:, 1]]
    inliers = np.linalg.norm(offsets, axis=1) < config.ransac.inlier_distance
    return RegistrationResult(own, verdict, clock.timings, seed, config, *graphs, match.pairs, inliers)


def _paper_estimate(clouds, structures, match: GraphMatch, judge: Judge, config: Config, rng, clock: Clock):
    """Step 5 as the paper has it: RANSAC on the matched centroids, then ICP."""
    matched = (structure.graph.nodes[match.pairs[:, side]] for side, structure in enumerate(structures))
    start, _ = ransac(
        *matched,
        rng,
        iterations=config.ransac.iterations,
        inlier_distance=config.ransac.inlier_distance,
        estimate_scale=config.scale.estimate_scale,
    )
    clock.tick(0.7)
    # RANSAC's winner has no rivals of its own, and without rivals no verdict: search for some
    source, target = structures
    scales = search_range(*(side.surface.normalization for side in structures), config.scale, config.hypotheses.scale_factor)
    rivals = from_triples(partners.of_nodes(source, target, match, 1), rng, config.hypotheses, scales)
    judge.consider(search(rivals, source.surface, target.surface, config, rng, clock))
    best = judge.polish(start, config.scale.estimate_scale and config.icp.estimate_scale)
    return best, judge.verdict(best, judge.fit(best))


def _searched_estimate(clouds, structures, match: GraphMatch, judge: Judge, config: Config, rng, clock: Clock):
    """Step 5 extended: rounds of many hypotheses, verified from both sides, until one is accepted."""
    best, verdict = Similarity.identity(), None
    for number, (hypotheses, source, target) in enumerate(_rounds(clouds, structures, match, config, rng)):
        finalists = search(hypotheses, source.surface, target.surface, config, rng, clock)
        best, verdict = judge.consider(finalists)
        if verdict.accepted or not clock.tick(1.0 - 0.5 * 0.6 ** (number + 1)):
            break
    return best, verdict


def _rounds(clouds, structures, match: GraphMatch, config: Config, rng) -> Iterator[tuple]:
    """Yield hypotheses with the structures they are between: as configured, then with other relative lengths."""
    part = config.hypotheses
    source, target = structures
    for relative in (1.0, *(part.relative_scales if config.scale.estimate_scale else ())):
        if relative != 1.0:
            source = extract(clouds[0], structures[0].surface.normalization, config, rng, relative)
            match = partners.match(source, target, config, Clock())
        low, high = search_range(
            source.surface.normalization, target.surface.normalization, config.scale, part.scale_factor, relative
        )
        if part.sources in ('graph', 'both'):
            nodes = partners.of_nodes(source, target, match, part.partners)
            yield from_triples(nodes, rng, part, (low, high)), source, target
        if part.sources in ('local', 'both'):
            features = partners.of_features(source, target, part.partners)
            yield from_triples(features, rng, part, (low, high)), source, target


def _own_unit(graph: StructureGraph, unit: Similarity) -> StructureGraph:
    nodes = unit.inverse().apply(graph.nodes)
    return StructureGraph(nodes, graph.normals, graph.node_descriptors, graph.edges, graph.edge_descriptors)


def warm_up() -> None:
    """Compile every kernel by registering a small synthetic cloud with itself (cached on disk afterwards)."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(3000, 3))
    points *= np.array((3.0, 2.0, 1.0)) / np.linalg.norm(points, axis=1, keepdims=True)
    for name in ('robust', 'paper'):
        register(points, points, profile(name))


__all__ = ['RegistrationResult', 'Verdict', 'register', 'warm_up']
