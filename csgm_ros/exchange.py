"""One order for both: whichever cloud is called the source, the same is searched, so that the answer is the inverse.

Much of the search draws its samples and lengths from its source first. What shows more of a place is the target
therefore, whatever it was called, and everything is told again in the order that was asked for.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from csgm_ros.cloud.cells import cells, working_size
from csgm_ros.cloud.normals import cosine
from csgm_ros.cloud.witnesses import coplanar
from csgm_ros.types import Details, MatchedGraphs, NormalizedPair, RegistrationResult

MOST_POINTS, CELLS, ASKED = 60000, 4000, 2000
COPLANAR_ANGLE, COPLANAR_OFFSET = 15.0, 1.5  # degrees, cells
PLANES_COUNT = 2.5  # times as much as points, logarithmically: these say as much about the sensor as about the place


def ordered(pair: NormalizedPair) -> NormalizedPair:
    """Return the pair with the cloud as its target that shows more of a place."""
    source, target = map(_shown, pair.normalized)
    if source <= target:
        return pair
    return NormalizedPair(pair.clouds[::-1], pair.normalizations[::-1], not pair.exchanged)


def _shown(points: np.ndarray) -> tuple[float, ...]:
    """Return how much a cloud shows: points, and planes among as many cells; and, for ties, anything else.

    Noise makes planes of single cells; of how many a random cell's plane is one tells only the large ones. Both count.
    """
    some = points[:: max(1, len(points) // MOST_POINTS)]
    seen = cells(some, working_size(some, CELLS), 2 * CELLS, np.random.default_rng(0))
    known = np.flatnonzero((seen.normals**2).sum(1) > 0.5)
    known = np.random.default_rng(0).permutation(known)[: 2 * ASKED]
    reach = cosine(COPLANAR_ANGLE), COPLANAR_OFFSET * seen.size, np.inf
    shared = coplanar(seen.points[known], seen.normals[known], ASKED, *reach)
    planes = np.sqrt((1.0 / shared).sum() * len(shared) / shared.mean()) if len(shared) else 0.0
    return float(len(points) * max(planes, 1.0) ** PLANES_COUNT), *points.sum(0).tolist()


def exchanged(result: RegistrationResult) -> RegistrationResult:
    """Return the result, whose verdict says it so already, as one from target to source."""
    matches = [
        _exchanged_matches(*side)
        for side in ((result.matches, result.match_inliers), (result.unguided_matches, result.unguided_inliers))
    ]
    return replace(
        result,
        transform=result.transform.inverse(),
        source_graph=result.target_graph,
        target_graph=result.source_graph,
        matches=matches[0][0],
        match_inliers=matches[0][1],
        unguided_matches=matches[1][0],
        unguided_inliers=matches[1][1],
        details=result.details and _exchanged_details(result.details, result.scale),
    )


def _exchanged_matches(pairs: np.ndarray, inliers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    order = np.lexsort(pairs.T)  # by their node in the target
    return pairs[order][:, ::-1], inliers[order]


def _exchanged_details(details: Details, scale: float) -> Details:
    graphs, matching = details.graphs, details.graphs.matching
    hypotheses = (
        replace(
            one,
            transform=one.transform.inverse(),
            fitness_source=one.fitness_target,
            fitness_target=one.fitness_source,
        )
        for one in details.hypotheses
    )
    return Details(
        details.structures[::-1],
        MatchedGraphs(
            graphs.target,
            graphs.source,
            graphs.node_affinity.T,
            graphs.edge_affinity.T,
            replace(matching, assignment=matching.assignment.T),
        ),
        tuple(hypotheses),
        details.inlier_distance / scale,
        details.match_distance / scale,
    )
