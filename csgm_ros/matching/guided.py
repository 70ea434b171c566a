"""Matching once the transform is known: which supervoxels of two clouds are one place.

Not in the paper. What graph matching finds without the transform is a start for hypotheses, mostly wrong and meant to
be; shown to a person it reads as failure. With its affinities weighted by the transform, J of Eq. (4) says what belongs
together. Its maximum is then close to that of the nodes alone, so full steps from there climb it, without relaxations:
integer projected fixed points (Leordeanu, Hebert and Sukthankar, NIPS 2009).
"""

from __future__ import annotations

import numpy as np

from csgm_ros.types import MatchedGraphs

WIDTHS = 2.0  # of the Gaussian, beyond which two nodes are no match
STEPS = 5


def match_guided(graphs: MatchedGraphs, gaps: np.ndarray, width: float) -> np.ndarray:
    """Match nodes with affinities weighted by a transform.

    Parameters
    ----------
    graphs : MatchedGraphs
    gaps : (n1, n2) ndarray
        Distance of every moved node of the source to every node of the target.
    width : float
        Of the Gaussian of the gaps that weights the affinities.

    Returns
    -------
    (k, 2) int ndarray
        Pairs at most two widths apart.
    """
    edges = graphs.source.edges, graphs.target.edges
    near = np.exp(-0.5 * (gaps / width) ** 2)
    starts, ends = (near[np.ix_(edges[0][:, k], edges[1][:, k])] for k in (0, 1))
    node, edge = near * graphs.node_affinity, starts * ends * graphs.edge_affinity  # an edge is as near as both ends
    best, value = _assigned(node), -np.inf
    for _ in range(STEPS):
        gradient = _edge_gradient(best, edge, *edges)
        reached = float((best * (node + 0.5 * gradient)).sum())  # J: its part of the edges is quadratic
        if reached <= value:
            break
        kept, value = best, reached
        best = _assigned(node + gradient)
    return np.argwhere((kept > 0) & (gaps <= WIDTHS * width))


def _edge_gradient(assignment: np.ndarray, edge: np.ndarray, edges_1: np.ndarray, edges_2: np.ndarray) -> np.ndarray:
    """Return the gradient of the edges' part of J, (n1, n2)."""
    from scipy.sparse import csr_array

    gradient = np.zeros(assignment.shape)
    for here, there in ((0, 1), (1, 0)):
        sides = zip((edges_1, edges_2), assignment.shape, strict=True)
        first, second = (csr_array((np.ones(len(e)), (e[:, here], np.arange(len(e)))), (n, len(e))) for e, n in sides)
        held = edge * assignment[np.ix_(edges_1[:, there], edges_2[:, there])]
        gradient += (second @ (first @ held).T).T
    return gradient


def _assigned(gain: np.ndarray) -> np.ndarray:
    from scipy.optimize import linear_sum_assignment

    assignment = np.zeros(gain.shape, np.uint8)
    assignment[linear_sum_assignment(gain, maximize=True)] = 1
    return assignment
