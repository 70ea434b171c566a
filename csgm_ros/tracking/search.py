"""Where in the map a submap lies, without any idea or with one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from csgm_ros.config import Config, replaced
from csgm_ros.registration import register
from csgm_ros.tracking.localization import Localizer, Submap
from csgm_ros.tracking.maps import PreparedMap


class Found(NamedTuple):
    """The pose of the submap in the map, None where none is certain, and why."""

    matrix: np.ndarray | None
    reason: str


def search(submap: Submap, prepared: PreparedMap, scale: float | None, config: Config, seed: int) -> Found:
    """Search the whole map; ``scale`` in map units a metre where it is known."""
    points = submap.levels[0].points
    if scale is not None:
        config = replaced(config, {'scale.estimate_scale': False})
        points = scale * points
    result = register(points, prepared.points, config, seed=seed)
    if not result.accepted:
        return Found(None, result.reason)
    matrix = result.T_target_source
    if scale is not None:
        matrix = matrix @ np.diag((scale, scale, scale, 1.0))
    localizer = Localizer(submap, prepared, np.random.default_rng(seed))
    best = localizer.best(matrix[None], fixed_scale=scale is not None)[0]
    return Found(best.matrix, result.reason)
