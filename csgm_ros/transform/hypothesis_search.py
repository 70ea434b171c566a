"""The search for the right transform: coarse score of all hypotheses, then a short ICP of the best."""

from __future__ import annotations

import numpy as np

from csgm_ros.cloud import nearest_grid
from csgm_ros.cloud.normals import cosine
from csgm_ros.config import Config, VerificationConfig
from csgm_ros.progress import Clock
from csgm_ros.transform import batch_icp, scoring
from csgm_ros.transform.sources import StructurePair
from csgm_ros.types import NearestGrid, PreparedCloud

BATCH = 10  # hypotheses between two looks at the clock
CELL, REACH = 0.025, 0.12  # of the look-up table, in radii: REACH is the widest distance


def search_grid(surface: PreparedCloud, reach: float = REACH) -> NearestGrid:
    """Tabulate the nearest points of a surface of radius about 1, as far as the search looks."""
    return nearest_grid.build(surface.points, surface.normals, CELL, max(reach, REACH))


def search_grids(pair: StructurePair, config: VerificationConfig) -> tuple[NearestGrid, NearestGrid]:
    """Tabulate both surfaces; scores are in target units, so the source's reach is longer where it will be shrunk."""
    return search_grid(pair.source.surface, config.coarse_truncation / pair.scales[0]), search_grid(pair.target.surface)


def search(
    hypotheses: np.ndarray,
    source: NearestGrid,
    target: NearestGrid,
    config: Config,
    rng: np.random.Generator,
    clock: Clock,
) -> np.ndarray:
    """Return the best different transforms after a short ICP, best first.

    Parameters
    ----------
    hypotheses : (H, 4, 4) ndarray
        Candidate transforms between the two surfaces.
    source, target : NearestGrid
        See :func:`search_grid`.
    clock : Clock
        Asked after every step.

    Returns
    -------
    (F, 4, 4) ndarray
        At most ``config.verification.finalists``.
    """
    part = config.verification
    min_cosine = cosine(part.max_normal_angle)
    grids = source, target
    orders = [rng.permutation(len(grid.points)) for grid in grids]
    few = orders[0][: part.coarse_samples], orders[1][: part.coarse_samples]
    many = orders[0][: part.samples], orders[1][: part.samples]
    probe = source.points[few[0]]
    ranking = scoring.scores(hypotheses, *grids, few, part.coarse_truncation, min_cosine)
    clock.check()
    kept = hypotheses[scoring.best_distinct(hypotheses, ranking, probe, part.distinct, part.refined)]
    refined = []
    for first in range(0, len(kept), BATCH):
        batch, scaled = kept[first : first + BATCH], config.scale.estimate_scale
        refined.append(
            batch_icp.refine_all(
                batch, *grids, many, part.max_correspondence_distances, min_cosine, estimate_scale=scaled
            )
        )
        clock.check()
    found = np.concatenate(refined)
    ranking = scoring.scores(found, *grids, many, part.fine_truncation, min_cosine)
    return found[scoring.best_distinct(found, ranking, probe, part.distinct, part.finalists)]
