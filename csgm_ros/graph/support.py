"""Step 3, K_p once more: which pairs of nodes support each other, by lengths and directions between them.

What surrounds two nodes says little of whether they are one place: the counterpart is among the ten most alike, and
seldom the first (Eq. 2). Yet between two pairs that are both right the lengths are the same, up to the one scale, and
so are the angles to the normals; between others they are by chance. So pairs that many others support stand out, and a
node without a counterpart has none. The strongest set is found as spectral matching does (Leordeanu and Hebert, ICCV
2005), at the scales for which most pairs vote, while the pairs of a node compete.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from csgm_ros.cloud.kernels import kernel
from csgm_ros.types import Matching, StructureGraph

CANDIDATES, MOST_PAIRS = 10, 4000  # most similar nodes that each node may be; pairs in all, about
SHORT, NOISE = 1.2, 0.2  # node spacings: lengths below say nothing; how far a node may be from its place
ANGLE_NOISE = 0.3  # rad
STEP, SCALE_NOISE = 0.1, 0.05  # between the logarithms of two scales, and how exactly one is met
SCALES = 3  # that are looked at closely
FAR = 3.0, 9.0  # sum of three squared angles, and square of a scale, in their noise, from which pairs do not agree
ROUNDS = 5
WEIGHT = 3.0  # of the support beside the similarity of surroundings
LEAST = 0.25  # of the strongest support among matched pairs, below which a node has no counterpart


@dataclass(frozen=True, eq=False)
class Support:
    """Pairs of nodes that may be one place, and how far they support each other.

    Attributes
    ----------
    pairs : (C, 2) int ndarray
        Nodes of the source and of the target.
    strength : (C,) ndarray
        In [0, 1], from the others, at the scale at which they agree best.
    first, second : (L,) ndarray
        Which two pairs agree, and ...
    weights : (L,) ndarray
        ... how well, at that scale.
    """

    pairs: np.ndarray
    strength: np.ndarray
    first: np.ndarray
    second: np.ndarray
    weights: np.ndarray

    def added(self, node_affinity: np.ndarray) -> np.ndarray:
        """Return K_p (n1, n2) with the support added."""
        total = node_affinity.copy()
        total[tuple(self.pairs.T)] += WEIGHT * np.sqrt(self.strength)
        return total

    def held(self, matching: Matching) -> Matching:
        """Return a matching without the pairs that its other ones hardly support."""
        matched = matching.assignment[tuple(self.pairs.T)] > 0
        strength = _pulled(self.first, self.second, self.weights, matched.astype(float))
        kept = self.pairs[matched & (strength > 0.0) & (strength >= LEAST * strength[matched].max(initial=0.0))]
        assignment = np.zeros_like(matching.assignment)
        assignment[tuple(kept.T)] = 1
        return replace(matching, assignment=assignment)


def support(
    first: StructureGraph, second: StructureGraph, node_affinity: np.ndarray, scales: tuple[float, float]
) -> Support:
    """Return how far the pairs of nodes that are most alike support each other (not in the paper).

    Parameters
    ----------
    first, second : StructureGraph
    node_affinity : (n1, n2) ndarray
        K_p, Eq. (2).
    scales : tuple of float
        Smallest and largest scale between the graphs; equal ones fix it.
    """
    pairs = _candidates(node_affinity)
    likely = node_affinity[tuple(pairs.T)]
    low, high = np.log(scales)
    links = _links(pairs, *_between(first), *_between(second), low - STEP, high + STEP)
    best, most = Support(pairs, np.zeros(len(pairs)), links[0], links[1], np.zeros(len(links[0]))), 0.0
    for scale in _voted(likely[links[0]] * likely[links[1]], links[3], low, high):
        i, j, weights = _at(scale, *links)
        strength = _strength(pairs, likely, i, j, weights, node_affinity.shape)
        agreed = float(strength @ _pulled(i, j, weights, strength))
        if agreed > most:
            best, most = Support(pairs, strength / strength.max(), i, j, weights), agreed
    return best


def _candidates(node_affinity: np.ndarray) -> np.ndarray:
    """Return the pairs (C, 2) of nodes of which one is among the most similar ones to the other."""
    count = int(np.clip(MOST_PAIRS // sum(node_affinity.shape), 2, CANDIDATES))
    among = np.zeros(node_affinity.shape, bool)
    for side in (among, node_affinity), (among.T, node_affinity.T):
        alike = np.argsort(-side[1], axis=1, kind='stable')[:, :count]
        np.put_along_axis(side[0], alike, True, axis=1)
    return np.argwhere(among)


def _between(graph: StructureGraph) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return lengths between all nodes, angles to the first one's normal, angles between normals, and the spacing."""
    offsets = graph.nodes - graph.nodes[:, None]
    lengths = np.linalg.norm(offsets, axis=2)
    along = np.abs(np.einsum('ijd,id->ij', offsets, graph.normals)) / np.maximum(lengths, 1e-12)
    normals = np.abs(graph.normals @ graph.normals.T)
    spacing = max(float(np.median(np.partition(lengths, 1, axis=1)[:, 1])), 1e-12)
    return lengths, np.arccos(np.minimum(along, 1.0)), np.arccos(np.minimum(normals, 1.0)), spacing


def _voted(votes: np.ndarray, ratios: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return the logarithms of the scales at which most pairs have the same lengths."""
    tried = np.linspace(low, high, 1 + int(np.ceil((high - low) / STEP)))
    edges = (tried[:, None] + (-STEP, STEP)).ravel()
    order = np.argsort(ratios)
    sums = np.append(0.0, np.cumsum(votes[order]))[np.searchsorted(ratios[order], edges)]
    return tried[np.argsort(sums[::2] - sums[1::2], kind='stable')[:SCALES]]


def _strength(
    pairs: np.ndarray, likely: np.ndarray, i: np.ndarray, j: np.ndarray, weights: np.ndarray, shape: tuple[int, int]
) -> np.ndarray:
    """Return how strongly each pair is supported by strong ones (C,), of norm 1."""
    strength = likely / np.linalg.norm(likely)
    for _ in range(ROUNDS):
        pulled = likely * _pulled(i, j, weights, strength)
        rivals = [np.bincount(pairs[:, side], pulled, shape[side])[pairs[:, side]] for side in (0, 1)]
        strength = pulled**2 / np.sqrt(np.maximum(rivals[0] * rivals[1], 1e-24))
        strength /= max(float(np.linalg.norm(strength)), 1e-12)
    return strength


@kernel
def _links(pairs, length_1, along_1, normals_1, spacing_1, length_2, along_2, normals_2, spacing_2, low, high):
    """Return which two pairs agree in their angles, how far not, the logarithm of their ratio of lengths, its noise."""
    size, count = 1 << 16, 0
    first, second, values = np.empty(size, np.int32), np.empty(size, np.int32), np.empty((3, size), np.float32)
    per = 1.0 / (ANGLE_NOISE * ANGLE_NOISE)
    for c in range(len(pairs)):
        i, a = pairs[c]
        for d in range(c):
            j, b = pairs[d]
            here, there = length_1[i, j], length_2[a, b]
            if here < SHORT * spacing_1 or there < SHORT * spacing_2:  # and where a node is in both pairs
                continue
            x, y = along_1[i, j] - along_2[a, b], along_1[j, i] - along_2[b, a]
            z = normals_1[i, j] - normals_2[a, b]
            square = (x * x + y * y + z * z) * per
            if square > FAR[0]:
                continue
            ratio = np.log(there / here)
            if not low <= ratio <= high:
                continue
            if count == size:
                first, second = np.concatenate((first, first)), np.concatenate((second, second))
                values = np.concatenate((values, values), 1)
                size *= 2
            first[count], second[count], values[0, count], values[1, count] = c, d, square, ratio
            values[2, count] = (NOISE * spacing_1 / here) ** 2 + (NOISE * spacing_2 / there) ** 2
            count += 1
    return first[:count], second[:count], values[0, :count], values[1, :count], values[2, :count]


@kernel
def _at(scale, first, second, squares, ratios, noises):
    """Return which two pairs agree at a scale, and how well."""
    weights = np.empty(len(first))
    kept = np.zeros(len(first), np.bool_)
    for k in range(len(first)):
        square = (ratios[k] - scale) ** 2 / (noises[k] + SCALE_NOISE * SCALE_NOISE)
        kept[k] = square <= FAR[1]
        weights[k] = np.exp(-0.5 * (squares[k] + square)) if kept[k] else 0.0
    return first[kept], second[kept], weights[kept]


@kernel
def _pulled(first, second, weights, strength):
    """Return what the strengths (C,) of pairs give to those with which they agree, (C,)."""
    out = np.zeros(len(strength))
    for k in range(len(first)):
        out[first[k]] += weights[k] * strength[second[k]]
        out[second[k]] += weights[k] * strength[first[k]]
    return out
