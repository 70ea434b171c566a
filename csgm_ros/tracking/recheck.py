"""A second look at a place while it is tracked: whether a better one is near, and at which scale it lies best.

A frame may fit beside its place as well as in it, above all a single one that a place was found by. What was seen since
does so no more.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from csgm_ros.tracking.evidence import Evidence
from csgm_ros.tracking.localization import Localizer, joined
from csgm_ros.tracking.maps import PreparedMap
from csgm_ros.tracking.search import Query, around
from csgm_ros.tracking.settling import LEAST_FRAMES, best_scale, on_map

BETTER = 1.2  # times as good must another place be
PARTLY = 0.5  # of the share on the map of the frame that lies most on it: frames beside it fit anywhere a little
PROMISING, PLACES = 6, 3  # hypotheses that are refined at most, and different places that they lead to


class Second(NamedTuple):
    """What a second look found.

    Attributes
    ----------
    matrix : (4, 4) ndarray or None
        A better place, from the frame of the odometry to the map.
    evidence : Evidence or None
        Of the better place.
    scale : float or None
        Map units a metre, where the place stands and the frames tell it.
    told : bool
        Whether enough frames lie on the map to tell of the place.
    """

    matrix: np.ndarray | None = None
    evidence: Evidence | None = None
    scale: float | None = None
    told: bool = True


def recheck(query: Query, prepared: PreparedMap, place: np.ndarray, seed: int) -> Second:
    """Look near the prior of a query for a better place than a (4, 4) one, and where there is none for its scale.

    The fresh frames alone tell of the place, where the query has any; all of them tell of the scale of one that stands.
    """
    rng = np.random.default_rng(seed)
    second = elsewhere(query, prepared, place, rng)
    if second.matrix is not None or not second.told:
        return second
    return Second(scale=best_scale(query.seen, query.voxel, prepared, place, rng))


def elsewhere(query: Query, prepared: PreparedMap, place: np.ndarray, rng: np.random.Generator) -> Second:
    """Return a pose (4, 4) near the prior of a query where what was seen fits much better than at ``place``, if any.

    Nothing is told where too few frames lie on the map: one or two fit elsewhere by chance.
    """
    told = on_map(query.fresh or query.seen, query.voxel, prepared, place, PARTLY)
    if query.prior is None or len(told) < LEAST_FRAMES:
        return Second(told=False)
    localizer = Localizer(joined(told, query.voxel), prepared, rng)
    here = localizer.weighed(place)
    hypotheses = localizer.promising(around(query.prior, query, rng), PROMISING)
    best, *_ = localizer.best(np.concatenate((place[None], hypotheses)), 1 + PLACES, fixed_scale=True)
    better = best.score >= BETTER * here.score and best.evidence.reaches(query.enough)
    return Second(best.matrix, best.evidence) if better and not localizer.alike(best.matrix, place) else Second()
