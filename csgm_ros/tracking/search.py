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
AGREEING = 0.8  # share of the map in view that is seen
MARGIN = 'verification.min_margin'
ONE_ATTEMPT = {'hypotheses.relative_scales': (1.0,), 'preprocess.max_surface_variation': 1.0}  # new frames tell more
SIGMA = 1.0, 45.0, 0.05  # of a sensor that was lost where it was last seen: metres, degrees, relative scale


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
    """

    submap: Submap
    scale: float | None
    prior: Prior | None
    sensor: np.ndarray
    enough: tuple[float, float] = (np.inf, np.inf)
    wide: bool = True


class Found(NamedTuple):
    """The pose of the submap in the map, None where none is certain, and why."""

    matrix: np.ndarray | None
    reason: str


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
            if near and _lead(near) >= STANDING_OUT and _enough(localizer.seen(near[0].matrix), query):
                return Found(near[0].matrix, 'near where it was expected')
    if not query.wide:
        return Found(None, 'not near where it was expected')
    points = query.submap.levels[0].points * (query.scale if known else 1.0)
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
    if _enough(localizer.seen(best.matrix), query):
        return Found(best.matrix, 'as close as where it was tracked')
    if certain(lead, best.evidence, result.verdict):
        return Found(best.matrix, f'what the sensor saw fits {lead:.1f} times as well as elsewhere; {result.reason}')
    return Found(None, f'what the sensor saw fits elsewhere {1 / lead:.2f} times as well; {result.reason}')


def certain(lead: float, evidence: Evidence, verdict: Verdict) -> bool:
    """Tell whether a place is right, of which views and verdict say how much better it is than a different one."""
    doubted = any(not term.passed for term in verdict.terms if term.parameter != MARGIN)
    both = min(lead, MOST_LEAD) * verdict.margin
    return (
        not doubted
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
    return places[0].evidence.score / max(places[1].evidence.score, 1e-9)


def _enough(evidence: Evidence, query: Query) -> bool:
    return evidence.on_map >= query.enough[0] and evidence.agreement >= query.enough[1]
