"""Hypotheses for a small view in a large map: its dominant planes on any face of the map, tables and shelves too."""

from __future__ import annotations

import numpy as np

from csgm_ros.cloud.cells import Cells
from csgm_ros.cloud.planes import Plane
from csgm_ros.config import HypothesesConfig
from csgm_ros.transform.planes import STARTS, candidates, dominant, scales_between
from csgm_ros.transform.sources import StructurePair


def faces(cells: Cells) -> list[Plane]:
    """Return every plane of a cloud, either way up, but those that the source ``planes`` lays others on.

    On which side of a plane most of a cloud is says nothing of a part: a room is below its tables.
    """
    first = len(dominant(cells))
    turned = [Plane(-plane.normal, plane.point) for plane in cells.faces]
    return [*turned, *cells.faces[first:]]


def propose(pair: StructurePair, config: HypothesesConfig, rng: np.random.Generator) -> np.ndarray:
    """Return the (F, 4, 4) finalists of the search, best first, refined: the same ones whenever asked again."""
    ladder = pair.ladder
    if 'parts' not in ladder.finalists:
        scales = scales_between(*pair.wide_scales)
        starts = np.concatenate([pair.found(), ladder.promising, candidates(ladder, scales, STARTS, faces)])
        ladder.finalists['parts'] = ladder.best(starts, estimate_scale=len(scales) > 1, every_kind=True)
    return ladder.finalists['parts']
