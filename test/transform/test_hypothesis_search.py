"""The search among hypotheses: how far it looks on both sides."""

from types import SimpleNamespace

import numpy as np
import pytest
from scenes import room

from csgm_ros.cloud.prepare import prepare
from csgm_ros.config import VerificationConfig
from csgm_ros.scale import radius
from csgm_ros.transform.hypothesis_search import search_grids
from csgm_ros.transform.scoring import scores
from csgm_ros.types import Similarity


@pytest.mark.parametrize('factor', [1.0, 0.7, 0.55])
def test_a_source_that_must_shrink_is_scored_as_far_as_any(factor):
    points = room(1, 300)
    unit = Similarity(1.0 / radius(points), np.eye(3), -points.mean(0) / radius(points))
    target = prepare(unit.apply(points), 0.05, 20)
    source = prepare(unit.apply(points) / factor, 0.05 / factor, 20)
    structures = (SimpleNamespace(surface=cloud) for cloud in (source, target))
    pair = SimpleNamespace(**dict(zip(('source', 'target'), structures, strict=True)), scales=(0.5, 2.0))
    grids = search_grids(pair, VerificationConfig())
    samples = tuple(np.arange(len(grid.points)) for grid in grids)
    # a shift of the target by 0.07 is within the coarse truncation of 0.08, and must be seen from both sides
    shifted = Similarity(factor, np.eye(3), np.array([0.0, 0.0, 0.07])).matrix[None]
    assert scores(shifted, *grids, samples, 0.08, 0.7)[0] > 0.3
