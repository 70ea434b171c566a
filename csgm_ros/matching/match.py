"""Step 4: enhanced factorised graph matching (Sec. III-D, Eq. (4) to Eq. (8), Algorithm 1).

The relaxations are the exact ones, see :mod:`csgm_ros.matching.relaxations`. Deviations from the paper, all of them
off or without effect on the result in its profile:

- Frank-Wolfe stops by its duality gap, and the path where no larger alpha can move a permutation: most steps of the
  literal loop do nothing.
- The grid of alpha is coarser, with few steps at each: on the reference instances nine times faster for 0.2 % of J.
- A search among permutations follows the path, which is a local method and gets trapped on hard graphs: it regains
  more than that, and on hard graphs several per cent.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from csgm_ros.cloud.threads import blas_threads
from csgm_ros.config import MatchingConfig
from csgm_ros.errors import Cancelled, InputError
from csgm_ros.matching.frank_wolfe import Objective, Smooth, State, assign, maximise, relaxed_gradient, smooth_gain
from csgm_ros.matching.relaxations import lookup_tables, padded_objective, smooth_term
from csgm_ros.matching.tabu_search import Lookup, evolve
from csgm_ros.types import Matching

DEFAULT = MatchingConfig()
NOT_SMOOTH = Smooth(0.0, np.zeros(1, int), np.zeros(0, int), np.zeros(0), np.zeros((0, 0)))
POPULATION = 30  # permutations that the search recombines
START_ALPHA = 0.4  # slightly concave: from there Frank-Wolfe finds the better local maxima of J
STEP_COST = 8  # of a Frank-Wolfe step, in exchanges of the search per square of the nodes
TINY = 1e-9  # relative; smaller differences of objectives are rounding


def match_graphs(
    node_affinity: np.ndarray,
    edge_affinity: np.ndarray,
    edges_1: np.ndarray,
    edges_2: np.ndarray,
    *,
    config: MatchingConfig = DEFAULT,
    positions_1: np.ndarray | None = None,
    positions_2: np.ndarray | None = None,
    is_cancelled: Callable[[], bool | None] | None = None,
) -> Matching:
    """Match the nodes of two graphs so that J(X) of Eq. (4) is large.

    Every node of the smaller graph is matched. The result is deterministic.

    Parameters
    ----------
    node_affinity : (n1, n2) array_like
        K_p: how well node i of graph 1 fits node a of graph 2; any finite numbers.
    edge_affinity : (m1, m2) array_like
        K_q: how well edge c of graph 1 fits edge d of graph 2; any finite numbers.
    edges_1, edges_2 : (m, 2) array_like of int
        Directed edges, 0-based (start, end). The affinities of an edge that occurs twice add up.
    config : MatchingConfig
        Path, smooth term and search.
    positions_1, positions_2 : (n1, 3), (n2, 3) array_like, optional
        Node positions in one common scale, in which the clouds' radius is about 1. Without them, or with
        ``config.smooth_weight`` 0, there is no smooth term.
    is_cancelled : callable, optional
        Asked between the values of alpha; returns True to stop.

    Returns
    -------
    Matching
        X, J(X) without the smooth term, and the Frank-Wolfe steps taken.

    Raises
    ------
    InputError
        For wrong shapes, numbers that are not finite, or edges between nodes that do not exist.
    Cancelled
        When ``is_cancelled`` returned True.
    """
    node = _finite('node_affinity', node_affinity, (None, None))
    pairs_1, pairs_2 = _edges('edges_1', edges_1, node.shape[0]), _edges('edges_2', edges_2, node.shape[1])
    edge = _finite('edge_affinity', edge_affinity, (len(pairs_1), len(pairs_2)))
    smooth = _smooth(config.smooth_weight, pairs_1, positions_1, positions_2, node.shape)
    if node.size == 0:
        return Matching(np.zeros(node.shape, np.uint8), 0.0, 0)
    unit = max(np.abs(node).max(), np.abs(edge).max(initial=0.0)) or 1.0
    smooth = smooth._replace(weight=smooth.weight / unit)
    with blas_threads(1):
        columns, steps, path = _solve(
            node / unit, *_merged(pairs_1, pairs_2, edge / unit), smooth, config, is_cancelled or (lambda: False)
        )
    assignment = np.zeros((len(columns), len(columns)), np.uint8)
    assignment[np.arange(len(columns)), columns] = 1
    assignment = np.ascontiguousarray(assignment[: node.shape[0], : node.shape[1]])
    path = np.array(path) * (1.0, unit)
    return Matching(assignment, score(assignment, node, edge, pairs_1, pairs_2), steps, path)


def _solve(
    node: np.ndarray,
    edges_1: np.ndarray,
    edges_2: np.ndarray,
    edge: np.ndarray,
    smooth: Smooth,
    config: MatchingConfig,
    is_cancelled: Callable[[], bool | None],
) -> tuple[np.ndarray, int, list[tuple[float, float]]]:
    """Return the permutation of the padded problem, the Frank-Wolfe steps taken, and J along the path."""
    objective = padded_objective(node, edge, edges_1, edges_2)
    path, steps, values = _follow_path(objective, smooth, config, is_cancelled)
    if config.search_effort == 0 or min(node.shape) == 1:
        return path[-1], steps, values
    lookup = lookup_tables(edges_1, edges_2, max(node.shape))
    columns, more = _search(objective, smooth, lookup, path, node.shape[0], config)
    return columns, steps + more, values


def score(
    assignment: np.ndarray,
    node_affinity: np.ndarray,
    edge_affinity: np.ndarray,
    edges_1: np.ndarray,
    edges_2: np.ndarray,
) -> float:
    """Return J(X) of Eq. (4); the arguments are those of :func:`match_graphs`."""
    starts = assignment[np.ix_(edges_1[:, 0], edges_2[:, 0])]
    ends = assignment[np.ix_(edges_1[:, 1], edges_2[:, 1])]
    return float(np.sum(node_affinity[assignment > 0]) + np.sum(edge_affinity[(starts > 0) & (ends > 0)]))


def _follow_path(
    objective: Objective, smooth: Smooth, config: MatchingConfig, is_cancelled: Callable[[], bool | None]
) -> tuple[list[np.ndarray], int, list[tuple[float, float]]]:
    """Follow J_alpha from the concave to the convex relaxation (Algorithm 1).

    Returns
    -------
    path : list of (N,) ndarray
        The permutation nearest to X for each alpha; the last is the result.
    steps : int
        Frank-Wolfe steps.
    values : list of (float, float)
        alpha and J(X) there.
    """
    nodes = len(objective.node)
    state, path, steps = _state(objective, np.full((nodes, nodes), 1 / nodes)), [], 0
    values = []
    for alpha in np.linspace(0, 1, config.alpha_steps):
        if is_cancelled():
            raise Cancelled('graph matching was cancelled')
        state, taken = _climb(objective, smooth, alpha, state, config)
        steps += taken
        path.append(_nearest_permutation(state.x))
        values.append((float(alpha), _value(objective, state)))
        if _is_final(objective, smooth, alpha, state):
            break
    return path, steps, values


def _climb(
    objective: Objective, smooth: Smooth, alpha: float, state: State, config: MatchingConfig
) -> tuple[State, int]:
    """Run Frank-Wolfe at one alpha; where J fell, take one step on J itself instead (Sec. III-D, last paragraph)."""
    scale = _scale(objective)
    before, value = _copy(state), _value(objective, state)
    limits = config.frank_wolfe_iterations, config.gap_tolerance * scale
    steps, _ = maximise(objective, smooth, alpha, state, *limits)
    if _value(objective, state) >= value - TINY * scale:
        return state, steps
    return before, steps + maximise(objective, NOT_SMOOTH, 0.5, before, 1, 0.0)[0]


def _is_final(objective: Objective, smooth: Smooth, alpha: float, state: State) -> bool:
    """Whether no larger alpha can move the state: a permutation that is best for the linearisation at both ends.

    The linearised objective is affine in alpha, so what is best at both ends is best between.
    """
    if state.x.max(axis=1).min() < 1:
        return False
    tolerance = TINY * _scale(objective)
    return all(maximise(objective, smooth, a, _copy(state), 1, tolerance)[0] == 0 for a in (alpha, 1.0))


def _search(
    objective: Objective, smooth: Smooth, lookup: Lookup, path: list[np.ndarray], real: int, config: MatchingConfig
) -> tuple[np.ndarray, int]:
    """Recombine the permutations along the path and Frank-Wolfe solutions of J from random starts.

    The smooth term acts linearised at the path's end, as in the step from Y0 to Y of Algorithm 1.
    """
    nodes, rng, steps = len(objective.node), np.random.default_rng(0), 0
    node = objective.node.copy()
    smooth_gain(smooth, path[-1], node)
    objective = objective._replace(node=node)
    starts = list({columns.tobytes(): columns for columns in reversed(path)}.values())[: POPULATION // 2]
    effort = 1e6 * config.search_effort
    for _ in range(len(starts), POPULATION):
        x = np.zeros((nodes, nodes))
        for _ in range(2):
            x[np.arange(nodes), rng.permutation(nodes)] += 0.5
        state = _state(objective, x)
        steps += maximise(objective, NOT_SMOOTH, START_ALPHA, state, 30, 1e-3 * _scale(objective))[0]
        starts.append(_nearest_permutation(state.x))
        if steps * STEP_COST * nodes**2 > effort / 4:
            break
    effort -= steps * STEP_COST * nodes**2
    return evolve(objective, lookup, np.array(starts), real, effort, rng), steps


def _state(objective: Objective, x: np.ndarray) -> State:
    """Return Frank-Wolfe's state at x."""
    spread = objective.left @ x + x @ objective.right
    return State(x, relaxed_gradient(objective, x), spread, np.zeros(len(x)))


def _copy(state: State) -> State:
    return State(*(part.copy() for part in state))


def _value(objective: Objective, state: State) -> float:
    """J of Eq. (4) at a state."""
    return 0.5 * float(np.sum(state.x * (state.gradient + objective.node)))


def _scale(objective: Objective) -> float:
    """Upper bound of abs(J) over permutations: half of J_con bounds the part of the edges."""
    edges = 0.5 * (np.trace(objective.left) + np.trace(objective.right))
    return float(edges + np.abs(objective.node).max(axis=1).sum())


def _nearest_permutation(x: np.ndarray) -> np.ndarray:
    columns, rows = np.empty((2, len(x)), int)
    assign(x, np.zeros(len(x)), columns, rows)
    return columns.copy()


def _finite(name: str, values: np.ndarray, shape: tuple) -> np.ndarray:
    """Return ``values`` as float64 of the shape wanted (None is any length), or raise InputError."""
    try:
        array = np.asarray(values, float)
    except (TypeError, ValueError) as error:
        raise InputError(f'{name} must be an array of numbers: {error}') from None
    if array.ndim != len(shape) or any(want not in (None, have) for want, have in zip(shape, array.shape, strict=True)):
        wanted = ', '.join('any' if length is None else str(length) for length in shape)
        raise InputError(f'{name} must have shape ({wanted}), not {array.shape}')
    if not np.isfinite(array).all():
        raise InputError(f'{name} has values that are not finite; replace them, for example by 0')
    return array


def _edges(name: str, edges: np.ndarray, nodes: int) -> np.ndarray:
    """Return the edges as (m, 2) int64, or raise InputError."""
    array = np.asarray(edges)
    if array.size == 0:
        return np.empty((0, 2), np.int64)
    if array.ndim != 2 or array.shape[1] != 2 or array.dtype.kind not in 'iu':
        raise InputError(f'{name} must be an (m, 2) array of whole numbers, not {array.dtype} {array.shape}')
    if array.min() < 0 or array.max() >= nodes:
        raise InputError(f'{name} must join nodes 0 to {nodes - 1}; it has {array.min()} to {array.max()}')
    if np.any(array[:, 0] == array[:, 1]):
        raise InputError(f'{name} must join two different nodes; edge {np.argmax(array[:, 0] == array[:, 1])} does not')
    return array.astype(np.int64)


def _merged(edges_1: np.ndarray, edges_2: np.ndarray, edge: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Order both graphs' edges by (start, end) and add up the affinities of duplicates."""
    unique_1, group_1 = np.unique(edges_1, axis=0, return_inverse=True)
    unique_2, group_2 = np.unique(edges_2, axis=0, return_inverse=True)
    merged = np.zeros((len(unique_1), len(unique_2)))
    if merged.shape == edge.shape:
        merged[np.ix_(group_1.ravel(), group_2.ravel())] = edge
    else:
        np.add.at(merged, np.ix_(group_1.ravel(), group_2.ravel()), edge)
    return unique_1, unique_2, merged


def _smooth(weight: float, edges_1: np.ndarray, positions_1, positions_2, sizes: tuple[int, int]) -> Smooth:
    """Return the smooth term, or none without positions or weight."""
    if (positions_1 is None) != (positions_2 is None):
        raise InputError('positions_1 and positions_2 must be given together')
    if positions_1 is None:
        return NOT_SMOOTH
    positions_1 = _finite('positions_1', positions_1, (sizes[0], 3))
    positions_2 = _finite('positions_2', positions_2, (sizes[1], 3))
    return smooth_term(weight, edges_1, positions_1, positions_2) if weight > 0 else NOT_SMOOTH
