"""Where in the map a submap lies: near where it was, or anywhere."""

from __future__ import annotations

import os
import threading
from typing import NamedTuple

import numpy as np

from csgm_ros.config import Config, replaced
from csgm_ros.errors import Cancelled
from csgm_ros.registration import register
from csgm_ros.tracking.evidence import Evidence
from csgm_ros.tracking.localization import Localizer, Place, Submap, scale_of, scaling
from csgm_ros.tracking.maps import PreparedMap
from csgm_ros.types import Prior, RegistrationResult, Similarity, Verdict

TURNS = 700  # tried about a pose that is roughly known: with 90 degrees of freedom, 15 to 20 degrees apart
LIKELY = 150  # of them that are tried first
STANDING_OUT = 1.35  # score over that of the next different place, for a place near the prior
CERTAIN = 3.0  # that times the margin of the verdict: what the views say is other evidence than what two clouds say ...
LEAST_LEAD, MOST_LEAD = 1.2, 2.7  # ... but neither speaks alone, and it may be that little was found to compare with
CERTAIN_AGAIN = 4.0  # product of the leads of two looks or more, of which only the first was a search
PROMISING, LOOKS = 1.5, 4  # such a product with which it is worth to look again before searching, and how often
AGREEING = 0.8  # share of the map in view that is seen
ON_MAP = 0.35  # share of what is seen that is on the map, where no verdict has looked at the clouds
MARGIN = 'verification.min_margin'
ONE_ATTEMPT = {'hypotheses.relative_scales': (1.0,), 'preprocess.max_surface_variation': 1.0}  # new frames tell more
SIGMA = 1.0, 45.0, 0.05  # of a sensor that was lost where it was last seen: metres, degrees, relative scale


class Candidates(NamedTuple):
    """Places between which could not be decided yet, for the frames that come next to judge.

    Attributes
    ----------
    matrices : (P, 4, 4) ndarray
        From the frame of the odometry to the map.
    odds : (P,) ndarray
        Product over all looks so far of the lead of each place over the best different one.
    looks : int
    """

    matrices: np.ndarray
    odds: np.ndarray
    looks: int


class Query(NamedTuple):
    """What is looked for.

    Attributes
    ----------
    submap : Submap
    scale : float or None
        Map units a metre, where it is known.
    prior : Prior or None
        Of the transform from the sensor to the map.
    sensor : (4, 4) ndarray
        Rigid pose of the sensor in the submap.
    enough : tuple of float
        Closeness on the map and agreement of a place that is as good as those that were tracked; the search ends
        with the first. Infinite while none was tracked.
    wide : bool
        Search everywhere, too.
    reach : float
        Range up to which the submap is laid on the map by its shape, median ranges: see :meth:`Submap.within`.
    candidates : Candidates or None
        What an earlier search in this stretch of odometry could not decide between.
    fresh : Submap or None
        Of frames that none of those looks has seen, with ``candidates``.
    """

    submap: Submap
    scale: float | None
    prior: Prior | None
    sensor: np.ndarray
    enough: tuple[float, float] = (np.inf, np.inf)
    wide: bool = True
    reach: float = np.inf
    candidates: Candidates | None = None
    fresh: Submap | None = None


class Found(NamedTuple):
    """The pose of the submap in the map, None where none is certain, and why.

    Attributes
    ----------
    matrix : (4, 4) ndarray or None
    reason : str
    evidence : Evidence or None
        Of the pose.
    candidates : Candidates or None
        Where none is certain, what may be.
    """

    matrix: np.ndarray | None
    reason: str
    evidence: Evidence | None = None
    candidates: Candidates | None = None


def search(
    query: Query, prepared: PreparedMap, config: Config, seed: int, closed: threading.Event | None = None
) -> Found:
    """Search near the prior first, then everywhere; give up once ``closed`` is set."""

    def progress(*_) -> None:
        if closed is not None and closed.is_set():
            raise Cancelled('the session was closed')

    rng = np.random.default_rng(seed)
    localizer = Localizer(query.submap, prepared, rng)
    known = query.scale is not None
    if query.prior is not None and known:
        hypotheses = around(query, rng)
        for some in (hypotheses[:LIKELY], hypotheses[LIKELY:]):
            near = localizer.best(localizer.promising(some, 6), 3, fixed_scale=True)
            if near and _lead(near) >= STANDING_OUT and _enough(near[0].evidence, query):
                return Found(near[0].matrix, 'near where it was expected', near[0].evidence)
    if query.candidates is not None and query.fresh is not None:
        found = look_again(query.candidates, Localizer(query.fresh, prepared, rng), fixed_scale=known)
        if found.matrix is not None or found.candidates is not None:
            return found
    if not query.wide:
        return Found(None, 'not near where it was expected')
    points = query.submap.within(query.reach) * (query.scale if known else 1.0)
    threads = config.threads or max((os.cpu_count() or 1) - 1, 1)  # frames keep coming meanwhile
    config = replaced(config, {'scale.estimate_scale': not known, 'threads': threads, **ONE_ATTEMPT})
    unit = scaling(1.0 if query.scale is None else query.scale, np.zeros(3))
    for prior in (None,) if known or query.prior is None else (of_submap(query), None):
        result = register(points, prepared.points, config, seed=seed, on_progress=progress, details=True, prior=prior)
        found = _judged(result, unit, localizer, query)
        if found.matrix is not None:
            break
    return found


def _judged(result: RegistrationResult, unit: np.ndarray, localizer: Localizer, query: Query) -> Found:
    """Let the views judge what was found and what competed with it.

    They know more than a verdict on two clouds does: what a sensor looked through is empty.
    """
    hypotheses = result.details.hypotheses if result.details else (result,)  # the first is the answer
    matrices = np.stack([each.transform.matrix for each in hypotheses]) @ unit
    places = localizer.best(matrices, fixed_scale=query.scale is not None)
    if not places:
        return Found(None, result.reason)
    best, lead = places[0], _lead(places)
    if lead >= STANDING_OUT and _enough(best.evidence, query):
        return Found(best.matrix, 'as close as where it was tracked', best.evidence)
    if certain(lead, best.evidence, result.verdict):
        reason = f'what the sensor saw fits {lead:.1f} times as well as elsewhere; {result.reason}'
        return Found(best.matrix, reason, best.evidence)
    odds = leads(places, localizer)
    odds[0] *= min(result.verdict.margin, 1.0 if _doubted(result.verdict) else MOST_LEAD)
    candidates = Candidates(np.stack([place.matrix for place in places]), odds, 1)
    reason = f'what the sensor saw fits elsewhere {1 / lead:.2f} times as well; {result.reason}'
    return Found(None, reason, candidates=candidates)


def look_again(candidates: Candidates, localizer: Localizer, *, fixed_scale: bool) -> Found:
    """Judge places by frames that they were not found with: what fitted by chance does so no more."""
    places = [localizer.best(matrix[None], fixed_scale=fixed_scale)[0] for matrix in candidates.matrices]
    now = leads(places, localizer)
    odds, looks, k = candidates.odds * now, candidates.looks + 1, int(np.argmax(now))
    best = places[k]
    fits = best.evidence.agreement >= AGREEING and best.evidence.share >= ON_MAP
    if fits and odds[k] >= CERTAIN_AGAIN and now[k] >= LEAST_LEAD:
        return Found(
            best.matrix, f'of {looks} looks, the last fits {now[k]:.1f} times as well as elsewhere', best.evidence
        )
    reason = f'after {looks} looks still {odds[k]:.1f} times as good as elsewhere'
    if odds.max() < PROMISING or looks >= LOOKS:
        return Found(None, reason)
    return Found(None, reason, candidates=Candidates(np.stack([place.matrix for place in places]), odds, looks))


def leads(places: list[Place], localizer: Localizer) -> np.ndarray:
    """Return the score of each place over that of the best different one, as far as a lead counts."""
    scores = np.array([place.score for place in places])
    out = np.empty(len(places))
    for k, place in enumerate(places):
        others = [scores[j] for j, other in enumerate(places) if not localizer.alike(place.matrix, other.matrix)]
        out[k] = scores[k] / max(max(others, default=0.0), 1e-9)
    return np.minimum(out, MOST_LEAD)


def _doubted(verdict: Verdict) -> bool:
    return any(not term.passed for term in verdict.terms if term.parameter != MARGIN)


def certain(lead: float, evidence: Evidence, verdict: Verdict) -> bool:
    """Tell whether a place is right, of which views and verdict say how much better it is than a different one."""
    both = min(lead, MOST_LEAD) * verdict.margin
    return (
        not _doubted(verdict)
        and both >= CERTAIN
        and lead >= LEAST_LEAD
        and verdict.margin >= 1.0
        and evidence.agreement >= AGREEING
    )


def of_submap(query: Query) -> Prior:
    """Return what the prior of the sensor says of the submap: of its centre, which turns about the sensor."""
    assert query.prior is not None
    sensor, (shift, angle, growth) = Similarity.from_matrix(query.sensor), query.prior.sigma
    transform = query.prior.transform @ sensor.inverse()
    arm = np.linalg.norm(query.submap.levels[-1].points.mean(0) - sensor.translation)
    return Prior(transform, (shift + np.radians(angle) * arm * transform.scale, angle, growth))


def around(query: Query, rng: np.random.Generator) -> np.ndarray:
    """Return (H, 4, 4) poses of the submap that a prior allows, from likely to unlikely."""
    from scipy.spatial.transform import Rotation

    assert query.prior is not None
    sigma, scale = query.prior.sigma, query.scale
    vectors = rng.normal(size=(TURNS, 3)) * np.radians(sigma[1])
    shifts = rng.normal(size=(TURNS, 3)) * sigma[0] * (np.arange(TURNS) % 2)[:, None]
    order = np.argsort(np.linalg.norm(vectors, axis=1))
    vectors, shifts = np.concatenate((np.zeros((1, 3)), vectors[order])), np.concatenate((np.zeros((1, 3)), shifts))
    poses = np.tile(np.eye(4), (len(vectors), 1, 1))
    poses[:, :3, :3] = scale * query.prior.transform.rotation @ Rotation.from_rotvec(vectors).as_matrix()
    poses[:, :3, 3] = query.prior.transform.translation + shifts
    return poses @ np.linalg.inv(query.sensor)


def expected(matrix: np.ndarray) -> Prior:
    """Return the prior of a sensor that was last seen at a pose (4, 4) in the map."""
    return Prior(Similarity.from_matrix(matrix), (SIGMA[0] * scale_of(matrix), *SIGMA[1:]))


def _lead(places: list[Place]) -> float:
    """Return the score of the best of the different places over that of the next."""
    if len(places) < 2:
        return np.inf
    return places[0].score / max(places[1].score, 1e-9)


def _enough(evidence: Evidence, query: Query) -> bool:
    return evidence.on_map >= query.enough[0] and evidence.agreement >= query.enough[1]
