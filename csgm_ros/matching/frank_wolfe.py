"""Frank-Wolfe on doubly stochastic matrices: the compiled inner loops of graph matching (Sec. III-D).

Both graphs are padded to N nodes, so that every vertex of the feasible set is a permutation, here the array
``columns`` with ``columns[i]`` the column of the one in row ``i``. Dummy nodes have no edges. The gradient of every
term is affine in X, therefore a step along X -> Y needs only the gradient at the *permutation* Y, whose cost is the
number of pairs of edges that Y brings together, and no n1 n2 x n1 n2 matrix exists anywhere.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from csgm_ros.cloud.kernels import kernel


class Objective(NamedTuple):
    """J(X) of Eq. (4) and the convexifier of its relaxations, padded to N nodes.

    Attributes
    ----------
    node : (N, N) ndarray
        K_p; zero for dummies.
    edge : (m1, m2) ndarray
        K_q.
    start_1, end_1, start_2, end_2 : (m1,), (m1,), (m2,), (m2,) ndarray
        The edges; those of graph 2 are ordered by start.
    out_2, in_2 : (N + 1,) ndarray
        Edges ``out_2[a]:out_2[a + 1]`` leave node a of graph 2; ``into_2[in_2[a]:in_2[a + 1]]`` enter it.
    into_2 : (m2,) ndarray
        The edges of graph 2, ordered by end.
    left, right : (N, N) ndarray
        S1 and T2 of J_con(X) = tr(X' S1 X) + tr(X T2 X').
    """

    node: np.ndarray
    edge: np.ndarray
    start_1: np.ndarray
    end_1: np.ndarray
    start_2: np.ndarray
    end_2: np.ndarray
    out_2: np.ndarray
    in_2: np.ndarray
    into_2: np.ndarray
    left: np.ndarray
    right: np.ndarray


class Smooth(NamedTuple):
    """What the smooth term of Eq. (8) needs.

    Attributes
    ----------
    weight : float
        Factor of the term; 0 turns it off.
    first : (N + 1,) ndarray
        Neighbours ``other[first[i]:first[i + 1]]`` of node i of graph 1, and their distances likewise.
    other, lengths : (k,) ndarray
        Neighbour and distance to it.
    distances : (n2, n2) ndarray
        Distances between all nodes of graph 2.
    """

    weight: float
    first: np.ndarray
    other: np.ndarray
    lengths: np.ndarray
    distances: np.ndarray


class State(NamedTuple):
    """Where Frank-Wolfe stands; changed in place.

    Attributes
    ----------
    x : (N, N) ndarray
        Doubly stochastic.
    gradient : (N, N) ndarray
        Gradient of J at x.
    spread : (N, N) ndarray
        Half the gradient of J_con at x.
    price : (N,) ndarray
        Column prices of the last assignment, the warm start of the next.
    """

    x: np.ndarray
    gradient: np.ndarray
    spread: np.ndarray
    price: np.ndarray


@kernel
def assign(gain, price, columns, rows):
    """Find the permutation of the largest total gain, by Jonker and Volgenant's shortest augmenting paths.

    ``price`` is read and written: any start is right, that of a similar problem is fast. Ties go to the lower index.
    """
    n = len(gain)
    rows[:] = -1
    columns[:] = -1
    free = np.arange(n)
    count = n
    for _ in range(3):
        todo, count = count, 0
        for k in range(todo):
            i = free[k]
            j, runner_up, margin = best_two(gain[i], price)
            if margin > 0:
                price[j] += margin
            elif rows[j] >= 0:
                j = runner_up
            if rows[j] >= 0:
                free[count] = rows[j]
                columns[rows[j]] = -1
                count += 1
            rows[j] = i
            columns[i] = j
    for k in range(count):
        augment(free[k], gain, price, columns, rows)


@kernel
def best_two(gain, price):
    """Return the column of the largest profit, the runner-up, and by how much it is behind (0 if there is none)."""
    best, second, j1, j2 = -np.inf, -np.inf, 0, 0
    for j in range(len(gain)):
        profit = gain[j] - price[j]
        if profit > second:
            if profit > best:
                second, j2 = best, j1
                best, j1 = profit, j
            else:
                second, j2 = profit, j
    return j1, j2, best - second if second > -np.inf else 0.0


@kernel
def augment(start, gain, price, columns, rows):
    """Assign the free row ``start`` along the shortest augmenting path and update the prices."""
    n = len(gain)
    loss = price - gain[start]
    parent = np.full(n, start)
    done = np.zeros(n, np.bool_)
    while True:
        low, last = np.inf, -1
        for j in range(n):
            if loss[j] < low and not done[j]:
                low, last = loss[j], j
        done[last] = True
        i = rows[last]
        if i < 0:
            break
        offset = low + gain[i, last] - price[last]
        row = gain[i]
        for j in range(n):
            through = offset + price[j] - row[j]
            if through < loss[j] and not done[j]:
                loss[j] = through
                parent[j] = i
    for j in range(n):
        if done[j]:
            price[j] += low - loss[j]
    i = -1
    while i != start:
        i = parent[last]
        rows[last] = i
        columns[i], last = last, columns[i]


@kernel
def relaxed_gradient(objective, x):
    """Gradient of J at any x; O(m1 m2)."""
    gradient = objective.node.copy()
    for c in range(len(objective.start_1)):
        i, j = objective.start_1[c], objective.end_1[c]
        for d in range(len(objective.start_2)):
            a, b = objective.start_2[d], objective.end_2[d]
            gradient[j, b] += objective.edge[c, d] * x[i, a]
            gradient[i, a] += objective.edge[c, d] * x[j, b]
    return gradient


@kernel
def vertex_gradient(objective, columns, gradient):
    """Write the gradient of J at a permutation; costs m1 times the mean degree of graph 2."""
    for i in range(len(columns)):
        for a in range(len(columns)):
            gradient[i, a] = objective.node[i, a]
    for c in range(len(objective.start_1)):
        i, j = objective.start_1[c], objective.end_1[c]
        a, b = columns[i], columns[j]
        for d in range(objective.out_2[a], objective.out_2[a + 1]):
            gradient[j, objective.end_2[d]] += objective.edge[c, d]
        for k in range(objective.in_2[b], objective.in_2[b + 1]):
            d = objective.into_2[k]
            gradient[i, objective.start_2[d]] += objective.edge[c, d]


@kernel
def smooth_gain(smooth, columns, gain):
    """Add Eq. (8), linearised at a permutation, to ``gain``.

    Entry (i, a) is minus the mean over the matched neighbours j of i of ``| |p_i - p_j| - |p_a - p_m(j)| |``.
    """
    n2 = len(smooth.distances)
    for i in range(len(smooth.first) - 1):
        matched = 0
        for k in range(smooth.first[i], smooth.first[i + 1]):
            matched += columns[smooth.other[k]] < n2
        for k in range(smooth.first[i], smooth.first[i + 1]):
            b = columns[smooth.other[k]]
            if b < n2:
                for a in range(n2):
                    gain[i, a] -= smooth.weight / matched * abs(smooth.lengths[k] - smooth.distances[b, a])


@kernel
def maximise(objective, smooth, alpha, state, iterations, tolerance):
    """Climb J_alpha of Eq. (7) from ``state`` until the duality gap is small.

    Returns
    -------
    steps : int
        Steps taken.
    gap : float
        Last duality gap; for alpha = 0 the optimum is at most this much higher.
    """
    x, gradient, spread, price = state
    n = len(x)
    convexity = 2 * alpha - 1
    columns, rows = np.empty(n, np.int64), np.empty(n, np.int64)
    vertex = np.empty((n, n))
    for step in range(iterations):
        slope = gradient + convexity * spread
        if smooth.weight > 0:
            assign(slope, price, columns, rows)
            smooth_gain(smooth, columns, slope)
        assign(slope, price, columns, rows)
        gap = 0.0
        for i in range(n):
            gap += slope[i, columns[i]]
            for a in range(n):
                gap -= slope[i, a] * x[i, a]
        if gap <= tolerance:
            return step, gap
        vertex_gradient(objective, columns, vertex)
        size = line_search(objective, convexity, state, columns, rows, vertex, gap)
        advance(objective, state, columns, rows, vertex, size)
    return iterations, gap


@kernel
def line_search(objective, convexity, state, columns, rows, vertex, gap):
    """Return the best step in [0, 1] along x -> permutation: the objective is a parabola of slope ``gap`` there."""
    curvature = 0.0
    for i in range(len(columns)):
        for a in range(len(columns)):
            bend = objective.left[i, rows[a]] + objective.right[columns[i], a] - state.spread[i, a]
            bend = vertex[i, a] - state.gradient[i, a] + convexity * bend
            curvature += 0.5 * bend * ((columns[i] == a) - state.x[i, a])
    if curvature < 0:
        return min(1.0, -0.5 * gap / curvature)
    return 1.0


@kernel
def advance(objective, state, columns, rows, vertex, size):
    """Move the state by ``size`` towards the permutation."""
    keep = 1.0 - size
    for i in range(len(columns)):
        for a in range(len(columns)):
            spread = objective.left[i, rows[a]] + objective.right[columns[i], a]
            state.x[i, a] = keep * state.x[i, a] + size * (columns[i] == a)
            state.gradient[i, a] = keep * state.gradient[i, a] + size * vertex[i, a]
            state.spread[i, a] = keep * state.spread[i, a] + size * spread
