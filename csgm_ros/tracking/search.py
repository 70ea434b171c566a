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
from csgm_ros.types import Prior, Similarity

TURNS = 700  # tried about a pose that is roughly known: with 90 degrees of freedom, 15 to 20 degrees apart
STANDING_OUT = 1.35  # score over that of the next different place, for a place near the prior
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
        near = localizer.best(localizer.promising(around(query, rng)), fixed_scale=True)
        if near and _stands_out(near) and _enough(localizer.seen(near[0].matrix), query):
            return Found(near[0].matrix, 'near where it was expected')
    if not query.wide:
        return Found(None, 'not near where it was expected')
    points = query.submap.levels[0].points * (query.scale if known else 1.0)
    threads = config.threads or max((os.cpu_count() or 1) - 1, 1)  # frames keep coming meanwhile
    config = replaced(config, {'scale.estimate_scale': not known, 'threads': threads})
    for prior in (None,) if known or query.prior is None else (of_submap(query), None):
        result = register(points, prepared.points, config, seed=seed, on_progress=progress, prior=prior)
        if result.accepted:
            break
    matrix = result.T_target_source @ scaling(1.0 if query.scale is None else query.scale, np.zeros(3))
    best = localizer.best(matrix[None], fixed_scale=known)
    if best and (result.accepted or _enough(localizer.seen(best[0].matrix), query)):
        return Found(best[0].matrix, result.reason if result.accepted else 'as close as where it was tracked')
    return Found(None, result.reason)


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


def _stands_out(places: list[Place]) -> bool:
    """Tell whether the best of the different places is much better than the next."""
    return len(places) < 2 or places[0].evidence.score >= STANDING_OUT * places[1].evidence.score


def _enough(evidence: Evidence, query: Query) -> bool:
    return evidence.on_map >= query.enough[0] and evidence.agreement >= query.enough[1]
