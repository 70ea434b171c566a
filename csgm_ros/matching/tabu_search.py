"""Search among permutations by exchanges of two rows: the compiled second half of robust graph matching.

A population of local maxima is recombined: a child keeps what both parents agree on, takes the rest from either,
and climbs by the best exchange, with a short memory (tabu) that carries it over small dips.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from csgm_ros.cloud.kernels import kernel
from csgm_ros.matching.frank_wolfe import vertex_gradient

PATIENCE = 25  # exchanges without a new best after which a climb ends
CONFIRMED = 20  # climbs that end at the best permutation known, after which it is taken for the optimum
OVERHEAD = 500  # what making an exchange costs, in exchanges looked at
TINY = 1e-9  # smaller differences of J are rounding; affinities are scaled to at most 1


class Lookup(NamedTuple):
    """Edges by their two nodes, and the neighbours of each node of graph 1.

    Attributes
    ----------
    edge_1, edge_2 : (N, N) ndarray
        Edge from row to column, -1 where there is none.
    first : (N + 1,) ndarray
        Neighbours ``other[first[i]:first[i + 1]]`` of node i of graph 1, in any direction.
    other : (k,) ndarray
        Neighbours.
    """

    edge_1: np.ndarray
    edge_2: np.ndarray
    first: np.ndarray
    other: np.ndarray


class Climber(NamedTuple):
    """One permutation and what each exchange would bring; changed in place.

    Attributes
    ----------
    columns, rows : (N,) ndarray
        The permutation and its inverse.
    gain : (N, N) ndarray
        Gradient of J at the permutation; column j belongs to the graph-2 node that row j holds.
    bond : (N, N) ndarray
        Second-order part of exchanging two rows: edges join both the rows and their columns, which no gradient sees.
    tabu : (N, N) ndarray
        Step until which a row must not return to a column.
    """

    columns: np.ndarray
    rows: np.ndarray
    gain: np.ndarray
    bond: np.ndarray
    tabu: np.ndarray


@kernel
def place(objective, lookup, climber):
    """Work out everything that follows from ``climber.columns``."""
    columns, gain, bond = climber.columns, climber.gain, climber.bond
    for i in range(len(columns)):
        climber.rows[columns[i]] = i
    vertex_gradient(objective, columns, bond)
    for i in range(len(columns)):
        for j in range(len(columns)):
            gain[i, j] = bond[i, columns[j]]
    bond[:] = 0.0
    for i in range(len(columns)):
        tie(objective, lookup, climber, i)
    climber.tabu[:] = 0


@kernel
def tie(objective, lookup, climber, i):
    """Recompute row and column i of ``bond``."""
    edge, edge_1, edge_2, bond = objective.edge, lookup.edge_1, lookup.edge_2, climber.bond
    a = climber.columns[i]
    for k in range(lookup.first[i], lookup.first[i + 1]):
        j = lookup.other[k]
        b = climber.columns[j]
        total = 0.0
        for c in (edge_1[i, j], edge_1[j, i]):
            for d in (edge_2[a, b], edge_2[b, a]):
                if c >= 0 and d >= 0:
                    total += edge[c, d]
        bond[i, j] = total
        bond[j, i] = total


@kernel
def add_row(objective, lookup, climber, i, sign):
    """Add what the assignment of row i brings its neighbours, or take it away."""
    gain, rows, edge = climber.gain, climber.rows, objective.edge
    start_2, end_2, into_2 = objective.start_2, objective.end_2, objective.into_2
    a = climber.columns[i]
    for k in range(lookup.first[i], lookup.first[i + 1]):
        j = lookup.other[k]
        c = lookup.edge_1[i, j]
        if c >= 0:
            for d in range(objective.out_2[a], objective.out_2[a + 1]):
                gain[j, rows[end_2[d]]] += sign * edge[c, d]
        c = lookup.edge_1[j, i]
        if c >= 0:
            for m in range(objective.in_2[a], objective.in_2[a + 1]):
                d = into_2[m]
                gain[j, rows[start_2[d]]] += sign * edge[c, d]


@kernel
def exchange_rows(objective, lookup, climber, i, j):
    """Exchange the columns of rows i and j."""
    columns, rows, gain = climber.columns, climber.rows, climber.gain
    add_row(objective, lookup, climber, i, -1.0)
    add_row(objective, lookup, climber, j, -1.0)
    columns[i], columns[j] = columns[j], columns[i]
    rows[columns[i]] = i
    rows[columns[j]] = j
    for k in range(len(columns)):
        gain[k, i], gain[k, j] = gain[k, j], gain[k, i]
    add_row(objective, lookup, climber, i, 1.0)
    add_row(objective, lookup, climber, j, 1.0)
    tie(objective, lookup, climber, i)
    tie(objective, lookup, climber, j)


@kernel
def best_exchange(climber, real, step, wanted):
    """Return the best exchange that is not tabu, or brings more than ``wanted``: rows i < j and what it brings."""
    best, best_i, best_j = -np.inf, -1, -1
    columns, gain, bond, tabu = climber.columns, climber.gain, climber.bond, climber.tabu
    loss = np.empty(len(columns))
    for i in range(len(columns)):
        loss[i] = gain[i, i]
    for i in range(real):
        for j in range(i + 1, len(columns)):
            total = gain[i, j] + gain[j, i] + bond[i, j] - loss[i] - loss[j]
            if total > best and (total > wanted or tabu[i, columns[j]] < step or tabu[j, columns[i]] < step):
                best, best_i, best_j = total, i, j
    return best_i, best_j, best


@kernel
def climb(objective, lookup, climber, real, rng):
    """Tabu search from ``climber.columns`` until ``PATIENCE`` exchanges bring nothing new.

    Returns
    -------
    value : float
        J of the best permutation, which is left in ``climber.columns``.
    steps : int
        Exchanges made.
    """
    columns, n = climber.columns, len(climber.columns)
    place(objective, lookup, climber)
    value = 0.0
    for i in range(n):
        value += 0.5 * (climber.gain[i, i] + objective.node[i, columns[i]])
    top, top_columns, top_step, step = value, columns.copy(), 0, 0
    while step - top_step < PATIENCE:
        step += 1
        i, j, gain = best_exchange(climber, real, step, top - value + TINY)
        if i < 0:
            break
        climber.tabu[i, columns[i]] = step + n // 2 + int(rng.random() * n / 2)
        climber.tabu[j, columns[j]] = step + n // 2 + int(rng.random() * n / 2)
        exchange_rows(objective, lookup, climber, i, j)
        value += gain
        if value > top + TINY:
            top, top_step = value, step
            store(columns, top_columns)
    store(top_columns, columns)
    return top, step


@kernel
def store(source, target):
    """Copy; a slice assignment would compile for seconds."""
    for i in range(len(source)):
        target[i] = source[i]


@kernel
def shuffle(items, rng):
    """Put the items in random order; ``rng.permutation`` would compile for seconds."""
    for i in range(len(items) - 1, 0, -1):
        j = int(rng.random() * (i + 1))
        items[i], items[j] = items[j], items[i]


@kernel
def cross(mother, father, child, rng):
    """Keep what the parents agree on, take the rest from either where it is free, fill up at random."""
    n = len(child)
    free = np.ones(n, np.bool_)
    for i in range(n):
        child[i] = mother[i] if mother[i] == father[i] else -1
        if child[i] >= 0:
            free[child[i]] = False
    order = np.arange(n)
    shuffle(order, rng)
    for i in order:
        a, b = mother[i], father[i]
        if rng.random() < 0.5:
            a, b = b, a
        if child[i] < 0 and (free[a] or free[b]):
            child[i] = a if free[a] else b
            free[child[i]] = False
    shuffle(order, rng)
    k = 0
    for i in range(n):
        if child[i] < 0:
            while not free[order[k]]:
                k += 1
            child[i] = order[k]
            free[order[k]] = False


@kernel
def evolve(objective, lookup, starts, real, effort, rng):
    """Search from several permutations and return the best one found.

    Parameters
    ----------
    objective : Objective
        What is maximised.
    lookup : Lookup
        The edges by their nodes.
    starts : (k, N) int64 ndarray
        Permutations to start from; the population is as large.
    real : int
        Rows that are no dummies.
    effort : float
        Work after which no child is born: exchanges looked at, and ``OVERHEAD`` for each one made. The search ends
        before that when the best permutation was found again and again.
    rng : numpy.random.Generator
        Where the choices come from.
    """
    n = starts.shape[1]
    squares = np.empty((n, n)), np.empty((n, n)), np.empty((n, n), np.int64)
    climber = Climber(np.empty(n, np.int64), np.empty(n, np.int64), *squares)
    population, values, kept = np.empty_like(starts), np.full(len(starts), -np.inf), 0
    spent, born, best, met = 0.0, 0, -np.inf, 0
    while born < len(starts) or (spent < effort and met < CONFIRMED):
        if born < len(starts):
            store(starts[born], climber.columns)
        elif kept < 2:
            shuffle(climber.columns, rng)
        else:
            mother, father = int(rng.random() * kept), int(rng.random() * (kept - 1))
            father += father >= mother
            cross(population[mother], population[father], climber.columns, rng)
        born += 1
        value, steps = climb(objective, lookup, climber, real, rng)
        spent += (steps + 1) * (n * n / 2 + OVERHEAD)
        if value > best + TINY:
            best, met = value, 0
        elif value > best - TINY:
            met += 1
        if np.any(np.abs(values - value) < TINY):
            continue
        place_in = kept if kept < len(starts) else np.argmin(values)
        if value > values[place_in]:
            store(climber.columns, population[place_in])
            values[place_in] = value
            kept = max(kept, place_in + 1)
    return population[np.argmax(values)]
