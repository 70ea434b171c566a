"""The two relaxations of factorised graph matching, as arrays that the compiled loops read (Sec. III-D).

With K_q = U diag(s) V', Q1 = U diag(s) U' and Q2 = V diag(s) V',

    J_con(X) = tr(X' S1 X) + tr(X T2 X'),  S1 = G1 ((H1' H1) o Q1) G1',  T2 = H2 ((G2' G2) o Q2) H2',
    J_vex = J - J_con / 2 (concave),  J_cav = J + J_con / 2 (convex).

J_con is the same for every permutation, so each J_alpha = (1 - alpha) J_vex + alpha J_cav = J + (alpha - 1/2) J_con
ranks permutations as J does. Graphs of different size are padded with nodes that have no edges.
"""

from __future__ import annotations

import numpy as np

from csgm_ros.matching.frank_wolfe import Objective, Smooth
from csgm_ros.matching.tabu_search import Lookup

FLOOR = 1e-5  # singular values below this share of the largest are replaced by it


def padded_objective(node: np.ndarray, edge: np.ndarray, edges_1: np.ndarray, edges_2: np.ndarray) -> Objective:
    """Return J of Eq. (4) and J_con, padded to as many nodes as the larger graph has.

    Parameters
    ----------
    node, edge : (n1, n2), (m1, m2) float64 ndarray
        K_p and K_q.
    edges_1, edges_2 : (m, 2) int64 ndarray
        Directed edges without duplicates, ordered by (start, end).
    """
    nodes = max(node.shape)
    padded = np.zeros((nodes, nodes))
    padded[: node.shape[0], : node.shape[1]] = node
    into_2 = np.argsort(edges_2[:, 1], kind='stable')
    everyone = np.arange(nodes + 1)
    left, right = convexifier(edge, edges_1, edges_2, nodes)
    return Objective(
        node=padded,
        edge=np.ascontiguousarray(edge),
        start_1=edges_1[:, 0].copy(),
        end_1=edges_1[:, 1].copy(),
        start_2=edges_2[:, 0].copy(),
        end_2=edges_2[:, 1].copy(),
        out_2=np.searchsorted(edges_2[:, 0], everyone),
        in_2=np.searchsorted(edges_2[into_2, 1], everyone),
        into_2=into_2,
        left=left,
        right=right,
    )


def convexifier(
    edge: np.ndarray, edges_1: np.ndarray, edges_2: np.ndarray, nodes: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return S1 and T2, (nodes, nodes) each.

    Deviation: the singular vectors come from the smaller of K_q K_q' and K_q' K_q, which takes half the time of the
    singular value decomposition. What that loses, the smallest singular values, is replaced by an upper bound, so
    J_vex stays concave and J_cav convex.
    """
    left, right = np.zeros((nodes, nodes)), np.zeros((nodes, nodes))
    if not np.any(edge):
        return left, right
    wide = edge if edge.shape[0] <= edge.shape[1] else edge.T
    squares, vectors = np.linalg.eigh(wide @ wide.T)
    singular = np.sqrt(np.maximum(squares, 0.0))
    floor = FLOOR * singular[-1]
    root = np.sqrt(singular[singular > floor])
    vectors = vectors[:, singular > floor]
    short, long = vectors * root, wide.T @ (vectors / root)
    factor_1, factor_2 = (short, long) if wide is edge else (long, short)
    add_shared(left, factor_1, shared=edges_1[:, 1], at=edges_1[:, 0])
    add_shared(right, factor_2, shared=edges_2[:, 0], at=edges_2[:, 1])
    for matrix, at in ((left, edges_1[:, 0]), (right, edges_2[:, 1])):
        np.fill_diagonal(matrix, matrix.diagonal() + floor * np.bincount(at, minlength=nodes))
    return left, right


def add_shared(matrix: np.ndarray, factor: np.ndarray, shared: np.ndarray, at: np.ndarray) -> None:
    """Add Q = factor factor' of every two edges that share the node ``shared`` to their entry ``at`` of a matrix."""
    order = np.argsort(shared, kind='stable')
    for group in np.split(order, np.flatnonzero(np.diff(shared[order])) + 1):
        matrix[np.ix_(at[group], at[group])] += factor[group] @ factor[group].T


def neighborhoods(edges: np.ndarray, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return every node's neighbours over edges of either direction: node i has ``other[first[i]:first[i + 1]]``."""
    both = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0)
    return np.searchsorted(both[:, 0], np.arange(nodes + 1)), both[:, 1].copy()


def lookup_tables(edges_1: np.ndarray, edges_2: np.ndarray, nodes: int) -> Lookup:
    """Return the edges by their two nodes."""
    tables = []
    for edges in (edges_1, edges_2):
        table = np.full((nodes, nodes), -1)
        table[edges[:, 0], edges[:, 1]] = np.arange(len(edges))
        tables.append(table)
    return Lookup(tables[0], tables[1], *neighborhoods(edges_1, nodes))


def smooth_term(weight: float, edges_1: np.ndarray, positions_1: np.ndarray, positions_2: np.ndarray) -> Smooth:
    """Return what Eq. (8) needs: lengths of the edges of graph 1, all distances in graph 2."""
    first, other = neighborhoods(edges_1, len(positions_1))
    at = np.repeat(np.arange(len(positions_1)), np.diff(first))
    lengths = np.linalg.norm(positions_1[at] - positions_1[other], axis=1)
    distances = np.linalg.norm(positions_2[:, None] - positions_2, axis=2)
    return Smooth(weight, first, other, lengths, distances)
