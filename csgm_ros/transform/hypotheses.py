"""Hypotheses from minimal samples of putative correspondences (Sec. III-E, extended).

The paper lets RANSAC draw triples of matched nodes and trusts the one best transform. Matches are right in one
case of ten at worst, so here triples are drawn by the hundred thousand, and those that keep the macro structure
(side lengths up to one common scale, angles between the normals) become hypotheses for the verification.
"""

from __future__ import annotations

import numba
import numpy as np

from csgm_ros.cloud.normals import cosine
from csgm_ros.config import HypothesesConfig
from csgm_ros.transform.correspondences import Correspondences


def from_triples(
    correspondences: Correspondences,
    rng: np.random.Generator,
    config: HypothesesConfig,
    scales: tuple[float, float],
) -> np.ndarray:
    """Draw triples of correspondences, the minimal samples, and return the transforms of those that keep the structure.

    Parameters
    ----------
    correspondences : Correspondences
        Putative, most of them wrong.
    rng : numpy.random.Generator
        Draws the triples.
    config : HypothesesConfig
        How many, and how exactly sides and normals have to agree.
    scales : tuple of float
        Smallest and largest scale; equal ones fix it.

    Returns
    -------
    (H, 4, 4) ndarray
        At most ``config.limit`` similarity matrices, in the order drawn.
    """
    if len(correspondences.source) < 3:
        return np.empty((0, 4, 4))
    low, high = np.log(scales)
    fixed = low == high
    slack = np.log1p(config.side_tolerance) if fixed else 0.0
    out = np.empty((config.limit, 4, 4))
    count = _draw(
        *(np.ascontiguousarray(part, float) for part in correspondences),
        np.uint64(rng.integers(1, 2**63 - 1)),
        config.trials,
        low - slack,
        high + slack,
        fixed,
        config.min_side,
        np.log1p(config.side_tolerance),
        cosine(config.max_normal_angle),
        out,
    )
    return out[:count]


@numba.njit(cache=True, nogil=True, inline='always')
def _below(state, n):
    # splitmix64: a generator of four lines whose stream is the same on every machine
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return int((z >> np.uint64(11)) % np.uint64(n))


@numba.njit(cache=True, nogil=True)
def _draw(p, q, np_, nq, seed, trials, low, high, fixed, min_length, tolerance, min_cosine, out):
    state = np.array([seed], np.uint64)
    triple = np.empty(3, np.int64)
    count = 0
    for _ in range(trials):
        for i in range(3):
            triple[i] = _below(state, len(p))
        scale = _common_scale(p, q, triple, min_length, tolerance)
        if not (low <= scale <= high):
            continue
        if not _angles_agree(p, q, np_, nq, triple):
            continue
        matrix = _triad(p, q, triple, np.exp(0.5 * (low + high) if fixed else scale))
        if _normals_agree(matrix, np_, nq, triple, min_cosine):
            out[count] = matrix
            count += 1
            if count == len(out):
                break
    return count


@numba.njit(cache=True, nogil=True, inline='always')
def _distance(a, b):
    return np.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@numba.njit(cache=True, nogil=True)
def _common_scale(p, q, triple, min_length, tolerance):
    # mean log ratio of the three sides, NaN where a side is short or the ratios differ
    total, smallest, largest = 0.0, np.inf, -np.inf
    for i in range(3):
        a, b = triple[i], triple[(i + 1) % 3]
        length = _distance(p[a], p[b])
        other = _distance(q[a], q[b])
        if length < min_length or other < min_length:
            return np.nan
        ratio = np.log(other / length)
        total += ratio
        smallest, largest = min(smallest, ratio), max(largest, ratio)
        if largest - smallest > tolerance:
            return np.nan
    return total / 3.0


@numba.njit(cache=True, nogil=True)
def _angles_agree(p, q, np_, nq, triple):
    for i in range(3):
        a, b = triple[i], triple[(i + 1) % 3]
        first = abs((np_[a] * np_[b]).sum())
        second = abs((nq[a] * nq[b]).sum())
        if abs(first - second) > 0.5:
            return False
    return True


@numba.njit(cache=True, nogil=True)
def _triad(p, q, triple, scale):
    a, b, c = triple
    frame_p = _frame(p[a], p[b], p[c])
    frame_q = _frame(q[a], q[b], q[c])
    rotation = frame_q @ frame_p.T
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation
    matrix[:3, 3] = (q[a] + q[b] + q[c]) / 3.0 - scale * (rotation @ ((p[a] + p[b] + p[c]) / 3.0))
    return matrix


@numba.njit(cache=True, nogil=True)
def _frame(a, b, c):
    frame = np.empty((3, 3))
    x = b - a
    x = x / np.sqrt((x**2).sum())
    y = c - (a + b) / 2.0
    z = np.cross(x, y)
    length = np.sqrt((z**2).sum())
    if length < 1e-9:
        z = np.array([x[1], -x[0], 0.0]) + 1e-6
        length = np.sqrt((z**2).sum())
    z = z / length
    frame[:, 0] = x
    frame[:, 1] = np.cross(z, x)
    frame[:, 2] = z
    return frame


@numba.njit(cache=True, nogil=True)
def _normals_agree(matrix, np_, nq, triple, min_cosine):
    scale = np.sqrt(matrix[0, 0] ** 2 + matrix[1, 0] ** 2 + matrix[2, 0] ** 2)
    for k in range(3):
        product = 0.0
        for r in range(3):
            for c in range(3):
                product += matrix[r, c] * np_[triple[k], c] * nq[triple[k], r]
        if abs(product) < min_cosine * scale:
            return False
    return True
