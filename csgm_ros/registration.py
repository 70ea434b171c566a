"""The registration pipeline: Algorithm 1 of the paper, stage by stage."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from csgm_ros.cloud.outliers import dense_part, smoothed, thickness, without_clutter, without_far_strays
from csgm_ros.cloud.prepare import finite_points
from csgm_ros.cloud.voxels import voxel_means
from csgm_ros.config import Config, profile, replaced
from csgm_ros.errors import DegenerateCloudError
from csgm_ros.progress import Clock, Progress
from csgm_ros.scale import normalizations, radius, search_range
from csgm_ros.structure.extract import Structure, cut, describe
from csgm_ros.transform import correspondences as partners
from csgm_ros.transform.correspondences import GraphMatch
from csgm_ros.transform.hypotheses import from_triples
from csgm_ros.transform.hypothesis_search import search
from csgm_ros.transform.ransac import ransac
from csgm_ros.transform.similarity import displacement
from csgm_ros.types import RegistrationResult, Similarity, StructureGraph, Verdict
from csgm_ros.verification.decide import Judge

MAX_SMOOTHING = 0.05  # of a cloud's points: averaged over more, little of its shape is left
EVEN_VOXEL = 0.03  # of the radius: the density at which thickness is told


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
    clouds = finite_points(source, 'source'), finite_points(target, 'target')
    clock = Clock(on_progress, config.time_budget)
    clock.enter('scale normalization')
    clouds, units = _normalized(clouds, config)
    judge = Judge(clouds, units, config, np.random.default_rng(seed))
    results: dict[int, RegistrationResult] = {}  # what each judge said last, by the smoothing of what it sees
    for number, attempt in enumerate(_attempts(clouds, config)):
        clock.begin(number)
        try:
            result = _attempt(clouds, units, attempt, judge, config, seed, clock)
        except DegenerateCloudError:
            if not results:
                raise
            continue  # smoothed, or at other lengths, a sparse cloud may have no structure left
        judge.look_again()
        results[attempt.smoothing] = result = _updated(results.get(attempt.smoothing), result)
        certain = attempt.smoothing or result.verdict.margin >= config.verification.certain_margin
        if (result.accepted and certain) or not clock.tick():
            break
    clock.finish()
    result = _unanimous(list(results.values()), config.verification.different / units[1].scale)
    return dataclasses.replace(result, timings=clock.timings)


def _unanimous(results: list[RegistrationResult], different: float) -> RegistrationResult:
    """Return the best result; rejected, where another look accepted a different transform."""
    best = max(results, key=_rank)
    nodes = best.source_graph.nodes
    for other in results:
        if other.accepted and displacement(best.transform, other.transform, nodes) > different:
            reason = 'ambiguous: the clouds as they are and the smoothed ones fit in different places'
            return dataclasses.replace(best, verdict=dataclasses.replace(best.verdict, accepted=False, reason=reason))
    return best


def _updated(earlier: RegistrationResult | None, result: RegistrationResult) -> RegistrationResult:
    """Keep the graphs and matches of the look that found the transform."""
    if earlier is None or not np.array_equal(earlier.T_target_source, result.T_target_source):
        return result
    return dataclasses.replace(earlier, verdict=result.verdict)


def _normalized(clouds, config: Config) -> tuple[tuple[np.ndarray, ...], tuple[Similarity, ...]]:
    """Step 1, and what would mislead it left out."""
    factor = config.preprocess.stray_factor
    if factor <= 0.0:
        return clouds, normalizations(*clouds, config.scale)
    clouds = tuple(map(without_clutter, clouds))
    units = normalizations(*(dense_part(cloud, factor) for cloud in clouds), config.scale)
    return tuple(without_far_strays(cloud, unit) for cloud, unit in zip(clouds, units, strict=True)), units


class Attempt(NamedTuple):
    """How the clouds are looked at.

    Attributes
    ----------
    smoothing : int
        Neighbours that noise is averaged over; 0 takes the clouds as they are.
    relative : float
        Lengths in the source relative to those in the target.
    """

    smoothing: int = 0
    relative: float = 1.0


def _attempts(clouds: tuple[np.ndarray, np.ndarray], config: Config) -> Iterator[Attempt]:
    """Yield the clouds as they are; while nothing is certain, smoothed if noisy, then at other relative lengths."""
    yield Attempt()
    if config.hypotheses.sources == 'ransac':
        return
    if max(map(thickness, map(_evened, clouds))) > config.preprocess.noise_threshold:
        most = MAX_SMOOTHING * min(map(len, clouds))
        yield from (Attempt(smoothing=count) for count in config.preprocess.smoothing if count <= most)
    if config.scale.estimate_scale:
        yield from (Attempt(relative=relative) for relative in config.hypotheses.relative_scales)


def _rank(result: RegistrationResult) -> tuple[bool, float]:
    return result.accepted, result.verdict.margin


def _attempt(
    clouds, units, attempt: Attempt, judge: Judge, config: Config, seed: int, clock: Clock
) -> RegistrationResult:
    """Steps 2 to 5 of Algorithm 1."""
    rng = np.random.default_rng(seed)
    clock.enter('structure extraction')
    if attempt.smoothing:
        smooth = [smoothed(unit.apply(cloud), attempt.smoothing) for cloud, unit in zip(clouds, units, strict=True)]
        clouds = tuple(unit.inverse().apply(cloud) for cloud, unit in zip(smooth, units, strict=True))
        judge = Judge(clouds, units, config, rng, smoothed=True)
    source, target = _structures(clouds, units, attempt, config, rng)
    clock.enter('graph matching')
    match = partners.match(source, target, config, clock)
    clock.enter('transformation estimation')
    scales = search_range(*units, config.scale, config.hypotheses.scale_factor, attempt.relative)
    estimate = _paper_estimate if config.hypotheses.sources == 'ransac' else _searched_estimate
    best, verdict = estimate(source, target, match, judge, scales, config, rng, clock)

    offsets = best.apply(source.graph.nodes[match.pairs[:, 0]]) - target.graph.nodes[match.pairs[:, 1]]
    inliers = np.linalg.norm(offsets, axis=1) < config.ransac.inlier_distance
    own = units[1].inverse() @ best @ units[0]
    if not config.scale.estimate_scale:
        own = dataclasses.replace(own, scale=1.0)  # which it is but for rounding
    graphs = (_own_unit(side.graph, unit) for side, unit in zip((source, target), units, strict=True))
    return RegistrationResult(own, verdict, {}, seed, config, *graphs, match.pairs, inliers)


def _structures(clouds, units, attempt: Attempt, config: Config, rng) -> tuple[Structure, Structure]:
    """Step 2 and the graphs of step 3, for both clouds at a time, with no more nodes than matching can take."""
    names, relatives = ('source', 'target'), (attempt.relative, 1.0)
    with ThreadPoolExecutor(1 if config.threads == 1 else 2) as pool:
        for last in (False, False, True):
            cuts = tuple(pool.map(cut, clouds, units, (config,) * 2, relatives))
            crowding = max(map(len, cuts)) / config.supervoxels.max_nodes
            if crowding <= 1.0 or last:
                break
            seed_size = min(config.supervoxels.seed_size * 1.1 * np.sqrt(crowding), 1.0)
            config = replaced(config, {'supervoxels.seed_size': float(seed_size)})
        return tuple(pool.map(_structure, names, cuts, units, (config,) * 2, rng.spawn(2), relatives))


def _structure(name: str, *inputs) -> Structure:
    try:
        return describe(*inputs)
    except DegenerateCloudError as error:
        raise DegenerateCloudError(f'{name}: {error}') from None


def _paper_estimate(source: Structure, target: Structure, match: GraphMatch, judge: Judge, scales, config, rng, clock):
    """Step 5 as the paper has it: RANSAC on the matched centroids, then ICP."""
    start, _ = ransac(
        source.graph.nodes[match.pairs[:, 0]],
        target.graph.nodes[match.pairs[:, 1]],
        rng,
        iterations=config.ransac.iterations,
        inlier_distance=config.ransac.inlier_distance,
        estimate_scale=config.scale.estimate_scale,
    )
    # RANSAC's winner has no rivals of its own, and without rivals no verdict: search for some
    for _ in _judged(('graph', 'local'), source, target, match, judge, scales, config, rng, clock):
        pass
    best = judge.polish(start, config.scale.estimate_scale and config.icp.estimate_scale)
    return best, judge.verdict(best, judge.fit(best))


def _searched_estimate(
    source: Structure, target: Structure, match: GraphMatch, judge: Judge, scales, config, rng, clock
):
    """Step 5 extended: many hypotheses from the graph, then from local features, verified from both sides."""
    sources = config.hypotheses.sources
    kinds = ('graph', 'local') if sources == 'both' else (sources,)
    for judged in _judged(kinds, source, target, match, judge, scales, config, rng, clock):
        _, verdict = judged
        # a narrow margin may only mean that the best rival has not been found yet
        if (verdict.accepted and verdict.margin >= config.verification.certain_margin) or not clock.tick():
            break
    return judged


def _judged(
    kinds, source: Structure, target: Structure, match: GraphMatch, judge: Judge, scales, config: Config, rng, clock
) -> Iterator[tuple[Similarity, Verdict]]:
    """Yield the best so far and its verdict after the hypotheses of each kind of source."""
    part = config.hypotheses
    for kind in kinds:
        if kind == 'graph':
            found = partners.of_nodes(source, target, match, part.partners)
        else:
            found = partners.of_features(source, target, part)
        hypotheses = from_triples(found, rng, part, scales)
        yield judge.consider(search(hypotheses, source.surface, target.surface, config, rng, clock))


def _evened(points: np.ndarray) -> np.ndarray:
    return voxel_means(points, EVEN_VOXEL * radius(points))


def _own_unit(graph: StructureGraph, unit: Similarity) -> StructureGraph:
    nodes = unit.inverse().apply(graph.nodes)
    return dataclasses.replace(graph, nodes=nodes)


def warm_up() -> None:
    """Compile every kernel by registering a small synthetic cloud with itself (cached on disk afterwards)."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(3000, 3))
    points *= np.array((3.0, 2.0, 1.0)) / np.linalg.norm(points, axis=1, keepdims=True)
    for name in ('robust', 'paper'):
        register(points, points, replaced(profile(name), {'time_budget': 1e-3}))  # one attempt meets every kernel
