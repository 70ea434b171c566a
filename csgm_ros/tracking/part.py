"""What a sensor saw as a part of the map: where it may lie, and how far the two agree there.

Dominant planes are laid on each other, then correlation says where; surfaces that agree are counted, each plane once,
which is other evidence than what the sensor saw from where.
"""

from __future__ import annotations

import numpy as np

from csgm_ros.cloud.outliers import without_extremes
from csgm_ros.cloud.witnesses import robust_radius
from csgm_ros.config import Config
from csgm_ros.progress import Look, unhurried
from csgm_ros.scale import search_range
from csgm_ros.transform import planes
from csgm_ros.transform.ladder import Ladder
from csgm_ros.types import Similarity

LARGER = 2.0  # times as large as the map may what was seen be: it is a part, but for what was not mapped


class Part:
    """Points that a sensor saw, and the map that they are a part of.

    Parameters
    ----------
    points : (N, 3) ndarray
        Metres.
    map_points : (M, 3) ndarray
    look : callable, optional
        Asked between the steps of a search.
    """

    def __init__(self, points: np.ndarray, map_points: np.ndarray, seed: int, look: Look = unhurried):
        map_points = without_extremes(map_points)
        self._radii = robust_radius(points), robust_radius(map_points)
        self._unit = self._radii[1] / self._radii[0]  # whatever the map's is, the ladder has the sensor's
        self._ladder = Ladder(points, map_points / self._unit, seed, look, part=True)

    def anywhere(self, config: Config, scale: float | None = None) -> np.ndarray:
        """Return different transforms (P, 4, 4) to the map, likely ones first.

        ``scale`` is map units a metre; otherwise all that the configuration allows and the extents make plausible
        are tried.
        """
        low, high = (scale, scale) if scale else self._plausible(config)
        scales = planes.scales_between(low / self._unit, high / self._unit)
        return np.diag((self._unit,) * 3 + (1.0,)) @ planes.candidates(self._ladder, scales)

    def agreement(self, transforms: np.ndarray) -> np.ndarray:
        """Return how far (H,) the two agree under (H, 4, 4) transforms, see :meth:`Ladder.scores`."""
        return self._ladder.scores(np.diag((1.0 / self._unit,) * 3 + (1.0,)) @ transforms)

    def _plausible(self, config: Config) -> tuple[float, float]:
        units = [Similarity(1.0 / radius, np.eye(3), np.zeros(3)) for radius in self._radii]
        low, high = search_range(units[0], units[1], config.scale, config.hypotheses.plane_scale_factor)
        return low * self._unit, max(low, min(high, LARGER)) * self._unit
