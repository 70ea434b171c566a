"""Where in the map a submap lies: near where it was, or anywhere."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from csgm_ros.config import Config
from csgm_ros.errors import Cancelled
from csgm_ros.tracking.evidence import Evidence
from csgm_ros.tracking.frames import Frame
from csgm_ros.tracking.localization import Localizer, Place, joined, scale_of
from csgm_ros.tracking.maps import PreparedMap
from csgm_ros.tracking.part import Part
from csgm_ros.tracking.settling import best_scale
from csgm_ros.types import Prior, Similarity

TURNS = 700  # tried about a pose that is roughly known: with 90 degrees of freedom, 15 to 20 degrees apart
LIKELY = 150  # of them that are tried first
MOST, KEPT = 24, 6  # hypotheses that are refined at most, and different places that they lead to
STANDING_OUT = 1.35  # score over that of the best different place, for a place as good as those that were tracked
CERTAIN = 3.0  # product of the leads: of what the views say in each look, and of the surfaces that agree
LEAST_LEAD, MOST_LEAD = 1.2, 2.7  # of the last look; the most that counts, as there may be little to compare with
PROMISING, LOOKS = 1.2, 4  # product with which it is worth to look again before searching; looks at most
AGREEING = 0.85  # share of the map in view that is seen
ON_MAP = 0.35  # share of what is seen that is on the map
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
    seen : sequence of (Frame, (4, 4) ndarray)
        Frames, and their rigid poses in the frame of the odometry.
    voxel : float
        Of the frames, metres.
    scale : float or None
        Map units a metre, where it is known.
    prior : Prior or None
        Of the transform from the sensor to the map.
    sensor : (4, 4) ndarray
        Rigid pose of the sensor in the frame of the odometry.
    enough : tuple of float
        Closeness on the map and agreement of a place that is as good as those that were tracked; the search ends
        with the first. Infinite while none was tracked.
    wide : bool
        Search everywhere, too.
    reach : float
        Range up to which what was seen is laid on the map by its shape, median ranges: see :meth:`Submap.within`.
    candidates : Candidates or None
        What an earlier search in this stretch of odometry could not decide between.
    fresh : sequence of (Frame, (4, 4) ndarray)
        Those that none of those looks has seen; in a check those since the place was found.
    """

    seen: Sequence[tuple[Frame, np.ndarray]]
    voxel: float
    scale: float | None
    prior: Prior | None
    sensor: np.ndarray
    enough: tuple[float, float] = (np.inf, np.inf)
    wide: bool = True
    reach: float = np.inf
    candidates: Candidates | None = None
    fresh: Sequence[tuple[Frame, np.ndarray]] = ()


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

    def look() -> None:
        if closed is not None and closed.is_set():
            raise Cancelled('the session was closed')

    rng = np.random.default_rng(seed)
    submap = joined(query.seen, query.voxel)
    localizer = Localizer(submap, prepared, rng)
    known = query.scale is not None
    places: list[Place] = []
    if query.prior is not None:
        hypotheses = around(query.prior, query, rng)
        for some in (hypotheses[:LIKELY], hypotheses[LIKELY:]):
            places = localizer.best(localizer.promising(some, 6), 3, fixed_scale=known)
            if places and _views_say(places, localizer)[0] >= STANDING_OUT and places[0].evidence.reaches(query.enough):
                return Found(places[0].matrix, 'near where it was expected', places[0].evidence)
    if query.candidates is not None and query.fresh:
        found = look_again(query.candidates, Localizer(joined(query.fresh, query.voxel), prepared, rng))
        if found.matrix is not None or found.candidates is not None:
            return found if known else settled(found, query, prepared, localizer, rng)
    if not query.wide:
        return Found(None, 'not near where it was expected')
    look()
    part = Part(submap.within(query.reach), prepared.points, seed, look)
    places = localizer.distinct(places + _anywhere(part, localizer, config, query.scale, look))
    if not known and places and fits(places[0].evidence):
        # among all scales a twin of a place is easily missed, among those of the place's own it is not
        twins = _anywhere(part, localizer, config, scale_of(places[0].matrix), look)
        here = [place.matrix for place in places]  # with scales that were refined, as those of twins are not
        twins = [twin for twin in twins if not any(localizer.alike(twin.matrix, matrix) for matrix in here)]
        places = localizer.distinct(places + twins)
    found = judged(places, part, localizer, query)
    return found if known else settled(found, query, prepared, localizer, rng)


def settled(found: Found, query: Query, prepared: PreparedMap, localizer: Localizer, rng: np.random.Generator) -> Found:
    """Return what was found among all scales at the scale that all that was seen agrees on; else it is not certain."""
    if found.matrix is None:
        return found
    scale = best_scale(query.seen, query.voxel, prepared, found.matrix, rng)
    if scale is None:
        candidates = Candidates(found.matrix[None], np.array([CERTAIN]), 1)
        return Found(None, f'{found.reason}; what was seen does not tell the scale', candidates=candidates)
    return found._replace(matrix=localizer.rescaled(found.matrix, scale))


def _anywhere(
    part: Part, localizer: Localizer, config: Config, scale: float | None, look: Callable[[], None]
) -> list[Place]:
    """Return the best different places in the whole map, at one scale where it is given."""
    hypotheses = part.anywhere(config, scale)
    look()
    return localizer.best(localizer.promising(hypotheses, MOST), KEPT, fixed_scale=scale is not None)


def judged(places: list[Place], part: Part, localizer: Localizer, query: Query) -> Found:
    """Let what the sensor saw and looked through, and the surfaces that agree, decide between places, best first."""
    if not places:
        return Found(None, 'no plane of what was seen is like one of the map')
    best, rivals = places[0], localizer.rivals(places)
    lead = leads(np.array([place.score for place in places]), rivals)
    if lead[0] >= STANDING_OUT and best.evidence.reaches(query.enough):
        return Found(best.matrix, 'as close as where it was tracked', best.evidence)
    matrices = np.stack([place.matrix for place in places])
    margin = leads(part.agreement(matrices), rivals)
    reason = (
        f'{best.evidence.share:.0%} of what the sensor saw is on the map, {lead[0]:.1f} times as well as elsewhere; '
        f'{margin[0]:.1f} times as many surfaces agree'
    )
    odds = lead * margin
    if not fits(best.evidence):
        return Found(None, reason)
    if odds[0] >= CERTAIN and lead[0] >= LEAST_LEAD and margin[0] >= 1.0:
        return Found(best.matrix, reason, best.evidence)
    return Found(None, reason, candidates=Candidates(matrices, odds, 1))


def fits(evidence: Evidence) -> bool:
    """Return whether what was seen is mapped where a place has it, and what is mapped there was seen."""
    return evidence.agreement >= AGREEING and evidence.share >= ON_MAP


def look_again(candidates: Candidates, localizer: Localizer) -> Found:
    """Judge places by frames that they were not found with: what fitted by chance does so no more."""
    places = [localizer.best(matrix[None], fixed_scale=True)[0] for matrix in candidates.matrices]
    now = _views_say(places, localizer)
    odds, looks, k = candidates.odds * now, candidates.looks + 1, int(np.argmax(now))
    best, reason = places[k], f'after {looks} looks {odds[k]:.1f} times as good as elsewhere'
    if not fits(best.evidence) or odds[k] < PROMISING:
        return Found(None, reason)
    if odds[k] >= CERTAIN and now[k] >= LEAST_LEAD:
        return Found(best.matrix, reason, best.evidence)
    if looks >= LOOKS:
        return Found(None, reason)
    return Found(None, reason, candidates=Candidates(np.stack([place.matrix for place in places]), odds, looks))


def leads(scores: np.ndarray, rivals: np.ndarray) -> np.ndarray:
    """Return the score (P,) of each place over that of the best of its ``rivals`` (P, P), as far as a lead counts."""
    best = np.where(rivals, scores, 0.0).max(axis=1)
    return np.minimum(scores / np.maximum(best, 1e-9), MOST_LEAD)


def _views_say(places: list[Place], localizer: Localizer) -> np.ndarray:
    return leads(np.array([place.score for place in places]), localizer.rivals(places))


def around(prior: Prior, query: Query, rng: np.random.Generator) -> np.ndarray:
    """Return (H, 4, 4) poses of the submap that a prior allows, from likely to unlikely."""
    from scipy.spatial.transform import Rotation

    sigma, scale = prior.sigma, query.scale or prior.transform.scale
    vectors = rng.normal(size=(TURNS, 3)) * np.radians(sigma[1])
    shifts = rng.normal(size=(TURNS, 3)) * sigma[0] * (np.arange(TURNS) % 2)[:, None]
    order = np.argsort(np.linalg.norm(vectors, axis=1))
    vectors, shifts = np.concatenate((np.zeros((1, 3)), vectors[order])), np.concatenate((np.zeros((1, 3)), shifts))
    poses = np.tile(np.eye(4), (len(vectors), 1, 1))
    poses[:, :3, :3] = scale * prior.transform.rotation @ Rotation.from_rotvec(vectors).as_matrix()
    poses[:, :3, 3] = prior.transform.translation + shifts
    return poses @ np.linalg.inv(query.sensor)


def expected(matrix: np.ndarray, sigma: tuple[float, float, float] = SIGMA) -> Prior:
    """Return the prior of a sensor that is expected at a pose (4, 4) in the map: metres, degrees, relative scale."""
    return Prior(Similarity.from_matrix(matrix), (sigma[0] * scale_of(matrix), *sigma[1:]))
