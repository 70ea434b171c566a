"""The registration: Algorithm 1 of the paper, step by step."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np

from csgm_ros.attempts import Attempt, Ranked, best_of, schedule
from csgm_ros.cloud.prepare import finite_points, viewpoint
from csgm_ros.cloud.smoothing import smoothed
from csgm_ros.config import Config, profile, replaced
from csgm_ros.errors import DegenerateCloudError, InputError, naming
from csgm_ros.exchange import exchanged, ordered
from csgm_ros.graph.affinity import affinity
from csgm_ros.graph.build import build
from csgm_ros.graph.support import support
from csgm_ros.matching.guided import match_guided
from csgm_ros.matching.match import match_graphs
from csgm_ros.progress import Clock, Progress, TimeUp
from csgm_ros.scale import normalize, search_range
from csgm_ros.structure.extract import cut, describe
from csgm_ros.structure.keypoints import describe_keypoints
from csgm_ros.transform.flight import collapsed, comparable
from csgm_ros.transform.hypothesis_search import search, search_grids
from csgm_ros.transform.ladder import APART, Ladder
from csgm_ros.transform.ransac import ransac
from csgm_ros.transform.refinement import refine_best, refine_between, refine_finalists
from csgm_ros.transform.sources import StructurePair, propose
from csgm_ros.types import (
    Details,
    Hypothesis,
    MatchedGraphs,
    NearestGrid,
    NormalizedPair,
    Prior,
    RegistrationResult,
    Similarity,
    Structure,
    StructureGraph,
    Verdict,
)
from csgm_ros.verification.decide import NOT_EXPECTED, no_hypothesis
from csgm_ros.verification.evidence import Evidence
from csgm_ros.verification.view import View, Viewpoints

NAMES = ('source', 'target')
GUIDED_WIDTH = 0.25  # seed spacings; with it, matched nodes are at most half of one apart
LIKELY = 16  # transforms that are compared at two lengths: at one alone, chance decides between parts of a map
AS_LIKELY = 0.4  # of the best one's evidence at the first length, below which the second does not help
LEADING = 2  # transforms that lead in another order and are compared at the second length too
MOST_SHOWN = 4  # hypotheses that people are shown: the answer and the best of what competed with it
LEAST_EFFORT = {
    'supervoxels.voxel_size': 0.1,
    'supervoxels.seed_size': 0.4,
    'descriptors.esf_samples': 100,
    'matching.alpha_steps': 2,
    'matching.search_effort': 0.1,
    'hypotheses.trials': 1000,
    'verification.fine_voxel_size': 0.1,
    'icp.iterations': 0,  # no kernel of ours
    'verification.min_margin': 100.0,  # so that every source is asked
    'preprocess.max_surface_variation': 1.0,  # and no second attempt made
    'scale.estimate_scale': False,
}


def register(
    source: np.ndarray,
    target: np.ndarray,
    config: Config | None = None,
    *,
    seed: int = 0,
    on_progress: Progress | None = None,
    details: bool = False,
    source_viewpoint: np.ndarray | None = None,
    target_viewpoint: np.ndarray | None = None,
    prior: Prior | None = None,
) -> RegistrationResult:
    """Find the similarity that lays the source on the target, ``x_target = s R x_source + t``.

    Parameters
    ----------
    source, target : (N, 3), (M, 3) ndarray
        Points in any unit and pose; rows that are not finite are ignored.
    config : Config, optional
        Default: profile ``robust``.
    seed : int, optional
        Same input, configuration and seed: same bits; the inverse where the clouds are exchanged.
    on_progress : callable, optional
        Called as ``on_progress(stage, fraction)``; raise :class:`csgm_ros.errors.Cancelled` from it to stop.
    details : bool, optional
        Keep for people how the result came about: :attr:`csgm_ros.types.RegistrationResult.details`.
    source_viewpoint, target_viewpoint : (3,) ndarray, optional
        Where the one sensor of a cloud stood, in the cloud's own frame and unit: what it has looked through is empty,
        and a transform that puts points there is rejected.
    prior : Prior, optional
        Where the transform is expected. The search begins there and no answer lies beyond three sigma; it is no
        evidence, so that a wrong one leads to no answer, not to a wrong one.

    Returns
    -------
    RegistrationResult
        Look at ``accepted`` before you use ``transform``.

    Raises
    ------
    InputError
        A cloud that cannot be registered, or a prior that is none; the message names which one and why.
    Cancelled
        Whatever ``on_progress`` raised.

    Examples
    --------
    >>> from csgm_ros.demo.simulation import simulate
    >>> made = simulate(seed=0)
    >>> result = register(made.source, made.target.reshape(-1, 3))
    >>> result.accepted
    True
    >>> f'{result.scale / made.truth.scale:.1f} of the true scale'
    '1.0 of the true scale'
    >>> result.transform.apply(made.source).shape == made.source.shape
    True
    """
    config = config or profile()
    clock = Clock(on_progress, config.time_budget)
    most, threads = config.preprocess.max_points, config.threads or os.cpu_count() or 1
    config = config if prior is None else narrowed(config, prior)
    viewpoints = viewpoint(source_viewpoint, NAMES[0]), viewpoint(target_viewpoint, NAMES[1])
    results: dict[int, Ranked] = {}
    clock.enter('scale normalization')
    with contextlib.suppress(TimeUp):
        first, second = (
            finite_points(points, name, most, threads, clock.check)
            for name, points in zip(NAMES, (source, target), strict=True)
        )
        clouds = first, second
        _attempts(clouds, viewpoints, prior, config, seed, clock, details, results)
    clock.finish()
    best = best_of(results.values()) if results else _unfinished(config)
    return dataclasses.replace(best, timings=clock.timings, seed=seed, config=config)


def _attempts(
    clouds: tuple[np.ndarray, np.ndarray],
    viewpoints: Viewpoints,
    prior: Prior | None,
    config: Config,
    seed: int,
    clock: Clock,
    details: bool,
    results: dict[int, Ranked],
) -> None:
    """Run one attempt of the schedule after the other until one is accepted, and put their results, by smoothing."""
    pair = normalize(clouds, config, clock.check)  # step 1
    if prior is None:  # its spreads are those of the source's place, and say nothing of the target's
        pair = ordered(pair)
        clock.check()
    if pair.exchanged:
        config, viewpoints = dataclasses.replace(config, scale=config.scale.exchanged()), viewpoints[::-1]
    ladder = Ladder(*pair.normalized, seed, clock.check)
    expected = prior and _normalized(prior, pair)
    views: dict[int, View] = {}
    for number, attempt in enumerate(schedule(pair, config)):
        clock.begin(number)
        try:
            rng = np.random.default_rng([seed, number] if number else seed)  # a stream of its own for each attempt
            best, result = _attempt(pair, ladder, viewpoints, expected, attempt, views, config, rng, clock, details)
        except DegenerateCloudError:
            if not results:
                raise
            continue  # smoothed, or at other lengths, a sparse cloud may have no structure left
        result = _updated(results.get(attempt.smoothing), result)
        results[attempt.smoothing] = Ranked(result, 0.0)  # kept should the time be up before its likelihood is known
        if result.accepted or clock.expired:
            break
        # on the clouds as they are: smoothed ones agree the better
        results[attempt.smoothing] = Ranked(result, _likelihood(best, views[0], ladder))


def _likelihood(transform: Similarity, view: View, ladder: Ladder) -> float:
    """Return how far two clouds agree at two lengths of their structure; at one alone, parts of a map do by chance."""
    at_first = float(ladder.scores(transform.matrix[None])[0])
    return at_first * view.score(transform) if at_first else 0.0


def _unfinished(config: Config) -> RegistrationResult:
    said = f'the time budget of {config.time_budget:g} s was spent before any transform could be judged; give it more'
    return RegistrationResult(Similarity.identity(), no_hypothesis(said), {}, 0, config)


def _attempt(
    pair: NormalizedPair,
    ladder: Ladder,
    viewpoints: Viewpoints,
    prior: Prior | None,
    attempt: Attempt,
    views: dict[int, View],
    config: Config,
    rng: np.random.Generator,
    clock: Clock,
    details: bool,
) -> tuple[Similarity, RegistrationResult]:
    """Steps 2 to 5 of Algorithm 1; the transform is between the normalised clouds."""
    clock.enter('structure extraction')
    if attempt.smoothing not in views:
        views[attempt.smoothing] = _view(pair, viewpoints, attempt, config, rng, clock)
    view = views[attempt.smoothing]
    clock.check()
    source, target = _structures(view.pair, attempt, config, rng, clock)  # step 2
    graphs = build(source, config.graph), build(target, config.graph)  # step 3
    clock.check()
    clock.enter('graph matching')
    scales = search_range(*view.pair.normalizations, config.scale, config.hypotheses.scale_factor, attempt.relative)
    matched = _matched(*graphs, scales, config, clock)  # step 4
    structures = _structure_pair(source, target, matched, scales, view, ladder, config, prior, clock)
    clock.enter('transformation estimation')
    estimate = {'search': _searched, 'ransac': _ransac}[config.hypotheses.method]  # step 5
    best, verdict = estimate(structures, view, config, rng, clock)
    if verdict.accepted and not _allowed(best, structures):
        verdict = dataclasses.replace(verdict, accepted=False, reason=NOT_EXPECTED)
    result = _result(best, verdict, matched, view.pair, config)
    if details:
        result = dataclasses.replace(result, details=_details(best, structures, matched, view, config))
    return best, exchanged(result) if view.pair.exchanged else result


def _view(
    pair: NormalizedPair,
    viewpoints: Viewpoints,
    attempt: Attempt,
    config: Config,
    rng: np.random.Generator,
    clock: Clock,
) -> View:
    if not attempt.smoothing:
        return View(pair, config, rng.spawn(1)[0], refine_between, viewpoints, look=clock.check)
    smooth = []
    for points, unit in zip(pair.normalized, pair.normalizations, strict=True):
        smooth.append(unit.inverse().apply(smoothed(points, attempt.smoothing, look=clock.check)))
        clock.check()
    pair = dataclasses.replace(pair, clouds=(smooth[0], smooth[1]))
    return View(pair, config, rng, refine_between, viewpoints, smoothed=True, look=clock.check)


def _structures(
    pair: NormalizedPair, attempt: Attempt, config: Config, rng: np.random.Generator, clock: Clock
) -> tuple[Structure, Structure]:
    """Step 2 for both clouds at a time, with no more nodes than matching can take."""
    relatives, names = (attempt.relative, 1.0), NAMES[::-1] if pair.exchanged else NAMES
    with ThreadPoolExecutor(1 if config.threads == 1 else 2) as pool:
        for last in (False, False, True):
            cuts = tuple(pool.map(_cut, names, pair.normalized, (config,) * 2, relatives))
            clock.check()
            crowding = max(map(len, cuts)) / config.supervoxels.max_nodes
            if crowding <= 1.0 or last:
                break
            seed_size = min(config.supervoxels.seed_size * 1.1 * np.sqrt(crowding), 1.0)
            config = replaced(config, {'supervoxels.seed_size': float(seed_size)})
        described = []
        for each in pool.map(_described, names, cuts, pair.normalizations, (config,) * 2, rng.spawn(2), relatives):
            clock.check()
            described.append(each)
        source, target = described
        return source, target


def _cut(name: str, *inputs):
    with naming(name):
        return cut(*inputs)


def _described(name: str, *inputs) -> Structure:
    with naming(name):
        return describe(*inputs)


def _matched(
    first: StructureGraph, second: StructureGraph, scales: tuple[float, float], config: Config, clock: Clock
) -> MatchedGraphs:
    """Affinities K_p and K_q, and step 4: enhanced factorised graph matching."""
    part = config.graph
    node_affinity = affinity(first.node_descriptors, second.node_descriptors, part.similarity, part.node_sigma)
    backing = support(first, second, node_affinity, scales) if part.support else None
    node_affinity = backing.added(node_affinity) if backing else node_affinity
    edge_affinity = affinity(first.edge_descriptors, second.edge_descriptors, part.similarity, part.edge_sigma)
    matching = match_graphs(
        node_affinity,
        edge_affinity,
        first.edges,
        second.edges,
        config=config.matching,
        positions_1=first.nodes,
        positions_2=second.nodes,
        is_cancelled=clock.check,  # raises where the caller wants to stop, or has no time left
    )
    return MatchedGraphs(first, second, node_affinity, edge_affinity, backing.held(matching) if backing else matching)


def _structure_pair(
    source: Structure,
    target: Structure,
    matched: MatchedGraphs,
    scales: tuple[float, float],
    view: View,
    ladder: Ladder,
    config: Config,
    prior: Prior | None,
    clock: Clock,
) -> StructurePair:
    @cache
    def keypoints():
        radius = config.hypotheses.feature_radius
        described = []
        for side in (source, target):
            described.append(describe_keypoints(side.surface, radius * side.unit))
            clock.check()
        return tuple(described)

    def found():
        return np.array([evidence.transform.matrix for evidence in view.measured]).reshape(-1, 4, 4)

    wide = search_range(*view.pair.normalizations, config.scale, config.hypotheses.plane_scale_factor)
    matches, node_affinity = matched.matching.pairs, matched.node_affinity
    known = source, target, matches, node_affinity, scales, keypoints, ladder, wide, found, prior
    return StructurePair(*known, look=clock.check)


def _ransac(
    structures: StructurePair, view: View, config: Config, rng: np.random.Generator, clock: Clock
) -> tuple[Similarity, Verdict]:
    """Step 5 as the paper has it: RANSAC on the matched centroids, then ICP."""
    start, _ = ransac(
        structures.source.nodes[structures.matches[:, 0]],
        structures.target.nodes[structures.matches[:, 1]],
        rng,
        iterations=config.ransac.iterations,
        inlier_distance=config.ransac.inlier_distance,
        estimate_scale=config.scale.estimate_scale,
    )
    scaled = config.scale.estimate_scale and config.icp.estimate_scale
    best = view.measure(refine_best(start, *view.surfaces, config, estimate_scale=scaled))
    verdict = view.judge(best)
    if verdict.accepted:  # knowing no competing hypotheses, as RANSAC has none: search for some before it is believed
        for _ in _candidates(config.hypotheses.sources, structures, view, config, rng, clock):
            pass
        verdict = view.judge(best)
    return best.transform, verdict


def _searched(
    structures: StructurePair, view: View, config: Config, rng: np.random.Generator, clock: Clock
) -> tuple[Similarity, Verdict]:
    """Step 5 extended: many hypotheses, from one source after the other, verified from both sides."""
    best, verdict = Similarity.identity(), None
    with contextlib.suppress(TimeUp):
        for _ in _candidates(config.hypotheses.sources, structures, view, config, rng, clock):
            evidence = _best(structures, view, config, clock) if view.measured else None
            clock.check()
            if evidence is not None:
                best, verdict = evidence.transform, view.judge(evidence)
            elif view.measured:
                verdict = no_hypothesis(NOT_EXPECTED) if structures.prior else no_hypothesis()
            clock.check()
            if verdict and verdict.accepted:
                break
    return best, verdict or (_unfinished(config).verdict if clock.expired else no_hypothesis())


def _best(structures: StructurePair, view: View, config: Config, clock: Clock) -> Evidence | None:
    """Return the best of all measured transforms, after the final ICP of the paper where that makes it better.

    Of those that the prior allows, where there is one; None where it allows none.

    Once the clouds have been looked at in lengths of their structure, these say which is best: shares of the clouds and
    lengths relative to their radii cannot, where one is much larger. A cloud too sparse for that leaves it to these.
    """
    ladder = structures.ladder
    allowed = [evidence for evidence in view.measured if _allowed(evidence.transform, structures)]
    if not allowed:
        return None
    best = max(allowed, key=lambda evidence: evidence.score)
    if not ladder.finalists or not ladder.sees(best.transform.scale):
        last = _settled(best, view, config, clock)
        best = last if last.score > best.score and _allowed(last.transform, structures) else best
        end = _polished(best, view)
        return end if _allowed(end.transform, structures) else best
    score = cache(lambda evidence: view.score(evidence.transform))
    ranks = ladder.scores(np.array([evidence.transform.matrix for evidence in allowed]))
    likely = _likely(allowed, ranks, ladder)
    place = allowed[max(likely, key=lambda number: ranks[number] * score(allowed[number]))].transform.matrix

    def fits(one: Evidence) -> bool:
        return ladder.alike(place, one.transform.matrix, APART) and _allowed(one.transform, structures)

    best = max(filter(fits, allowed), key=score)
    # the correspondence distances of the last ICP may be too wide for what the clouds show
    best = max([best, *filter(fits, [_settled(best, view, config, clock)])], key=score)
    end = _polished(best, view)
    return end if fits(end) or (score(end) > score(best) and _allowed(end.transform, structures)) else best


def _likely(measured: list[Evidence], ranks: np.ndarray, ladder: Ladder) -> np.ndarray:
    """Return which transforms are compared at a second length.

    The best at the first one, the best as shares of the clouds, which know nothing of that length, and the best parts,
    which are ranked by more than that length.
    """
    first = np.argsort(-ranks, kind='stable')[: min(LIKELY, (ranks >= AS_LIKELY * ranks.max()).sum())]
    second = np.argsort([-evidence.score for evidence in measured], kind='stable')[:LEADING]
    parts = ladder.finalists.get('parts', ())[:LEADING]
    third = [n for n, one in enumerate(measured) if any(ladder.alike(part, one.transform.matrix) for part in parts)]
    return np.unique(np.concatenate([first, second, third]).astype(int))


def _polished(best: Evidence, view: View) -> Evidence:
    """Return where all ends lead that are near: which of them fits best is chance, and so is how well."""
    return _once(view, 'polished', best, view.polished)


def _settled(best: Evidence, view: View, config: Config, clock: Clock) -> Evidence:
    """Return a transform after the final ICP of the paper."""
    scaled = config.scale.estimate_scale and config.icp.estimate_scale

    def settle(start: Similarity) -> Similarity:
        clock.check()
        return refine_best(start, *view.surfaces, config, estimate_scale=scaled, look=clock.check)

    return _once(view, 'settled', best, settle)


def _once(view: View, how: str, best: Evidence, refine: Callable[[Similarity], Similarity]) -> Evidence:
    """Return what a refinement makes of a transform: mostly of the best before, whatever another source has added."""
    key = how, best.transform.matrix.tobytes()
    if key not in view.refined:
        view.refined[key] = view.measure(_held(refine(best.transform), best.transform))
    return view.refined[key]


def _held(end: Similarity, start: Similarity) -> Similarity:
    """Return what an ICP ended with, or its start where it has shrunk the source onto a few points."""
    return start if collapsed(end.scale, start.scale) else end


def _allowed(transform: Similarity, structures: StructurePair) -> bool:
    expected = structures.prior is None or structures.prior.allows(transform, np.zeros(3))
    return comparable(transform.scale) and expected


def _candidates(
    sources: tuple[str, ...],
    structures: StructurePair,
    view: View,
    config: Config,
    rng: np.random.Generator,
    clock: Clock,
) -> Iterator[None]:
    """Propose, search, refine and measure; yield after each source that has proposed something, and once at least."""
    grids: tuple[NearestGrid, NearestGrid] | None = None
    finalists = structures.ladder.finalists
    searched = [name for name in sources if name in finalists]  # by an earlier attempt
    if not view.measured:
        for name in searched:
            _measure_finalists(finalists[name], structures, view, config)
            clock.check()
    others = [name for name in sources if name not in searched]
    judged = False
    for name in ('prior', *others) if structures.prior else others:
        hypotheses = propose(name, structures, config.hypotheses, rng)
        clock.check()
        if name in finalists:
            _measure_finalists(hypotheses, structures, view, config)
        elif len(hypotheses):
            grids = grids or search_grids(structures, config.verification)
            found = search(hypotheses, *grids, config, rng, clock)
            view.measured += map(view.measure, refine_finalists(found, *view.surfaces, config))
        clock.check()
        if len(hypotheses) and name != 'prior':  # judged beside what another source finds: it is no evidence
            yield
            judged = True
    if not judged:
        yield


def _measure_finalists(hypotheses: np.ndarray, structures: StructurePair, view: View, config: Config) -> None:
    """Measure (F, 4, 4) finalists, which have been searched for and refined already, in lengths of the structure."""
    ladder = structures.ladder
    places = ladder.places(ladder.news(hypotheses, structures.found()))
    best = [Similarity.from_matrix(place[0]) for place in places]
    if places:  # of the best place, the best on the fine clouds, whatever lengths refine it
        tried = [*map(Similarity.from_matrix, places[0]), *refine_finalists(places[0], *view.surfaces, config)]
        best[0] = max(tried, key=view.score)
    view.measured += map(view.measure, best)


def narrowed(config: Config, prior: Prior) -> Config:
    """Return the configuration with the scales that a prior allows.

    Raises
    ------
    InputError
        For a prior that is none, or whose scale the configuration excludes.
    """
    transform, sigma = prior.transform, np.asarray(prior.sigma, float)
    if not np.isfinite(transform.matrix).all() or transform.scale <= 0.0:
        raise InputError('prior: its transform is no similarity; give T_target_source')
    if sigma.shape != (3,) or not np.isfinite(sigma).all() or (sigma < 0.0).any():
        raise InputError(f'prior: sigma is {prior.sigma}; give place, degrees and relative scale, none below 0')
    factor = float(np.exp(3.0 * sigma[2]))
    low, high = config.scale.bounds if config.scale.estimate_scale else (1.0, 1.0)
    if not low / factor * (1 - 1e-6) <= transform.scale <= high * factor * (1 + 1e-6):
        raise InputError(f'prior: its scale {transform.scale:g} is not among those configured, {low:g} to {high:g}')
    if not config.scale.estimate_scale or config.scale.prior:
        return config
    values = {'scale.prior': float(transform.scale), 'scale.prior_factor': min(max(factor, 1.001), 1e6)}
    return replaced(config, values)


def _normalized(prior: Prior, pair: NormalizedPair) -> Prior:
    """Return a prior between the normalised frames; a scale that is known exactly is not held to rounding errors."""
    source, target = pair.normalizations
    shift = prior.sigma[0] * target.scale or 0.2
    transform = target @ prior.transform @ source.inverse()
    return Prior(transform, (shift, max(prior.sigma[1], 1e-3), max(prior.sigma[2], 1e-6)))


def _details(
    best: Similarity, structures: StructurePair, matched: MatchedGraphs, view: View, config: Config
) -> Details:
    """Everything that people are shown of an attempt beside its result."""
    kept, probe = [(best, 1.0)], view.surfaces[0].probe
    for other, ratio in view.rivals:
        if min(other.displacement(one, probe) for one, _ in kept) > config.verification.different:
            kept.append((other, ratio))
    hypotheses = []
    for transform, ratio in kept[:MOST_SHOWN]:
        found = view.measure(transform)
        own = view.pair.in_own_units(transform)
        hypotheses.append(Hypothesis(own, found.score, found.fitness_source, found.fitness_target, ratio))
    unit = view.pair.normalizations[1].scale
    distances = config.verification.inlier_distance / unit, config.ransac.inlier_distance / unit
    return Details((structures.source, structures.target), matched, tuple(hypotheses), *distances)


def _result(
    best: Similarity, verdict: Verdict, matched: MatchedGraphs, pair: NormalizedPair, config: Config
) -> RegistrationResult:
    graphs = matched.source, matched.target
    gaps = np.linalg.norm(best.apply(graphs[0].nodes)[:, None] - graphs[1].nodes, axis=2)
    agree = gaps < config.ransac.inlier_distance
    guided = match_guided(matched, gaps, GUIDED_WIDTH * config.supervoxels.seed_size)
    unguided = matched.matching.pairs
    own = pair.in_own_units(best)
    if not config.scale.estimate_scale:
        own = dataclasses.replace(own, scale=1.0)  # which it is but for rounding
    first, second = (
        dataclasses.replace(graph, nodes=unit.inverse().apply(graph.nodes))
        for graph, unit in zip(graphs, pair.normalizations, strict=True)
    )
    matches = guided, agree[tuple(guided.T)], unguided, agree[tuple(unguided.T)]
    return RegistrationResult(own, verdict, {}, 0, config, first, second, *matches)


def _updated(earlier: Ranked | None, result: RegistrationResult) -> RegistrationResult:
    """Keep the graphs and matches of the attempt that found the transform."""
    if earlier is None or not np.array_equal(earlier.result.T_target_source, result.T_target_source):
        return result
    return dataclasses.replace(earlier.result, verdict=result.verdict)


def warm_up() -> None:
    """Compile every kernel, or load it from the disk, by registering a wall with itself at the least effort."""
    wall = np.random.default_rng(0).uniform(0.0, 1.0, (1200, 3)) * np.array((0.0, 2.0, 1.0))  # one plane: few pairs
    register(wall, wall, replaced(profile(), LEAST_EFFORT))
