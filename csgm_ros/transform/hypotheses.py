"""Hypotheses from minimal samples of putative correspondences (Sec. III-E, extended).

The paper lets RANSAC draw triples of matched nodes and trusts the one best transform. Matches are right in one
case of ten at worst, so here triples are drawn by the hundred thousand, and those that keep the macro structure
(side lengths up to one common scale, angles between the normals) become hypotheses for the verification.
"""

from __future__ import annotations

import numpy as np

from csgm_ros.cloud.kernels import kernel, random_bits
from csgm_ros.cloud.normals import cosine
from csgm_ros.config import HypothesesConfig
from csgm_ros.progress import Look, unhurried
from csgm_ros.transform.correspondences import Correspondences

TRIALS = 500_000  # between two looks at the clock
MIN_SINE = 1e-3  # of the angle at a corner of a minimal sample: below, its points are on a line


def from_triples(
    correspondences: Correspondences,
    rng: np.random.Generator,
    config: HypothesesConfig,
    scales: tuple[float, float],
    look: Look = unhurried,
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
    look : callable, optional
        Asked now and then.

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
    out, count = np.empty((config.limit, 4, 4)), 0
    parts = [np.ascontiguousarray(part, float) for part in correspondences]
    state = np.array([rng.integers(1, 2**63 - 1)], np.uint64)
    for first in range(0, config.trials, TRIALS):
        look()
        count = _draw(
            *parts,
            state,
            min(TRIALS, config.trials - first),
            low - slack,
            high + slack,
            fixed,
            config.min_side,
            np.log1p(config.side_tolerance),
            cosine(config.max_normal_angle),
            out,
            count,
        )
        if count == len(out):
            break
    return out[:count]


@kernel
def _draw(p, q, np_, nq, last, trials, low, high, fixed, min_length, tolerance, min_cosine, out, count):
    state = last[0]
    triple = np.empty(3, np.int64)
    for _ in range(trials):
        for i in range(3):
            state, bits = random_bits(state)
            triple[i] = int((bits >> np.uint64(11)) % np.uint64(len(p)))
        scale = _common_scale(p, q, triple, min_length, tolerance)
        if not (low <= scale <= high):
            continue
        if not _angles_agree(p, q, np_, nq, triple):
            continue
        if _collinear(p, triple) or _collinear(q, triple):
            continue
        matrix = _triad(p, q, triple, np.exp(0.5 * (low + high) if fixed else scale))
        if _normals_agree(matrix, np_, nq, triple, min_cosine):
            out[count] = matrix
            count += 1
            if count == len(out):
                break
    last[0] = state
    return count


@kernel(inline=True)
def _distance(a, b):
    return np.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@kernel
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


@kernel
def _angles_agree(p, q, np_, nq, triple):
    for i in range(3):
        a, b = triple[i], triple[(i + 1) % 3]
        first = abs((np_[a] * np_[b]).sum())
        second = abs((nq[a] * nq[b]).sum())
        if abs(first - second) > 0.5:
            return False
    return True


@kernel
def _triad(p, q, triple, scale):
    a, b, c = triple
    frame_p = _frame(p[a], p[b], p[c])
    frame_q = _frame(q[a], q[b], q[c])
    rotation = frame_q @ frame_p.T
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation
    matrix[:3, 3] = (q[a] + q[b] + q[c]) / 3.0 - scale * (rotation @ ((p[a] + p[b] + p[c]) / 3.0))
    return matrix


@kernel
def _collinear(points, triple):
    # three points on a line fix no rotation about it
    side, other = points[triple[1]] - points[triple[0]], points[triple[2]] - points[triple[0]]
    area = np.cross(side, other)
    return (area**2).sum() <= MIN_SINE**2 * (side**2).sum() * (other**2).sum()


@kernel
def _frame(a, b, c):
    frame = np.empty((3, 3))
    x = b - a
    x = x / np.sqrt((x**2).sum())
    z = np.cross(x, c - (a + b) / 2.0)
    z = z / np.sqrt((z**2).sum())
    frame[:, 0] = x
    frame[:, 1] = np.cross(z, x)
    frame[:, 2] = z
    return frame


@kernel
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
