"""Turn and place at once by correlation of volumes, where clouds share the direction of a plane but no plane itself."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from csgm_ros.cloud.agreement import Comparison
from csgm_ros.cloud.kernels import kernel
from csgm_ros.cloud.planes import Plane, frame
from csgm_ros.cloud.witnesses import Witnesses
from csgm_ros.config import HypothesesConfig
from csgm_ros.progress import Look, unhurried
from csgm_ros.transform.ladder import Ladder, turned
from csgm_ros.transform.sources import StructurePair

CELL = 2.0  # cells of the comparison
TURNS = 24
MIN_CELLS = 300  # of the part
MOST_SORTED, CANDIDATES, DISTINCT = 3000, 100, 3.0  # peaks that are looked at; that get a short ICP; cells between them
HALF_TURNS = np.array([[1.0, 1.0, 1.0], [-1.0, -1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0]])
NONE = np.empty(0), np.empty((0, 4, 4))
AXES = 3  # of a cloud
SAME_AXIS = 0.9  # cosine from which two planes have one direction
LARGEST = 96  # cells along an edge; in larger clouds a part is not found by its volume
PEAKS = 2  # of a correlation
SIDE, EDGE, CORNER = 0.65, 0.5, 0.4  # how much of a cell is in its neighbours
BESIDE = -0.25  # what is beside a surface contradicts
BAND = 2  # cells
ALONG, ACROSS = 0.8, 0.6  # cosine of a normal and the axis: from which a surface faces it, and up to which it does not


class Volume(NamedTuple):
    """One of the clouds, along one direction.

    Attributes
    ----------
    witnesses : Witnesses
    axes : (3, 3) ndarray
        Rows: the frame whose last axis is the direction.
    middle : (3,) ndarray
        Of its extent, in the cloud's frame.
    reach : (3,) ndarray
        How far it extends from there in its frame.
    """

    witnesses: Witnesses
    axes: np.ndarray
    middle: np.ndarray
    reach: np.ndarray


def volume(witnesses: Witnesses, direction: np.ndarray) -> Volume:
    """Look at a cloud along a direction."""
    axes = frame(direction)
    low, high = np.percentile(witnesses.points @ axes.T, (1, 99), axis=0)
    return Volume(witnesses, axes, (low + high) / 2 @ axes, (high - low) / 2)


def directions(planes: list[Plane]) -> list[np.ndarray]:
    """Return the different directions of planes, up to their sign."""
    kept: list[np.ndarray] = []
    for plane in planes:
        if all(abs(plane.normal @ other) < SAME_AXIS for other in kept):
            kept.append(plane.normal)
    return kept[:AXES]


def correlate(
    comparison: Comparison, source: list[Plane], target: list[Plane], look: Look = unhurried
) -> tuple[np.ndarray, np.ndarray]:
    """Return values (P,) and transforms (P, 4, 4) of the peaks of all turns about all pairs of directions.

    Parameters
    ----------
    comparison : Comparison
        The clouds in one unit.
    source, target : list of Plane
        Of the two clouds.
    look : callable, optional
        Asked before every turn.
    """
    import scipy.fft

    first, second = comparison.sides
    size = CELL * comparison.cell
    parts, wholes = ([volume(w, d) for d in directions(planes)] for w, planes in ((first, source), (second, target)))
    values, transforms = [], []
    spectra: dict = {}
    for whole in wholes:
        for number, part in enumerate(parts):
            across = np.hypot(*part.reach[:2])
            edges = 2 * (whole.reach + np.array([across, across, part.reach[2]])) / size + 2 * BAND + 1
            if edges.max() > LARGEST:
                continue
            shape = tuple(scipy.fft.next_fast_len(16 * int(np.ceil(edge / 16)), real=True) for edge in edges)
            answer = _spectrum(whole, 0.0, size, shape)
            product = np.empty(answer.shape[1:], answer.dtype)
            for turn in np.arange(TURNS // 2) * 2 * np.pi / TURNS:
                look()
                if (number, shape, turn) not in spectra:
                    spectra[number, shape, turn] = _spectrum(part, turn, size, shape)
                for half, flip in enumerate(HALF_TURNS):
                    _multiply(spectra[number, shape, turn], answer, half, product)
                    found, shifts = _peaks(scipy.fft.irfftn(product, s=shape), PEAKS)
                    values.append(found)
                    transforms.append(_transforms(part, whole, flip[:, None] * _turned(part.axes, turn), size * shifts))
    return (np.concatenate(values), np.concatenate(transforms)) if values else NONE


def _turned(axes: np.ndarray, turn: float) -> np.ndarray:
    cosine, sine = np.cos(turn), np.sin(turn)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ axes


def _spectrum(seen: Volume, turn: float, size: float, shape: tuple[int, ...]) -> np.ndarray:
    """Return the spectra (4, ...) of a turned cloud: what is asked facing and across, then what answers so."""
    import scipy.fft

    rotation = _turned(seen.axes, turn) / size
    into = np.column_stack([rotation, -rotation @ seen.middle + np.array(shape) // 2 + 0.5])  # which reflects to itself
    grids = np.zeros((4, *shape), np.float32)
    witnesses = seen.witnesses
    asked = witnesses.sample
    facing = np.abs(witnesses.normals @ seen.axes[2])
    _fill(witnesses.points, facing, into, grids[2:])
    _ask(witnesses.points[asked], facing[asked], 1.0 / witnesses.coplanar, into, grids[:2])
    grids[:2] /= (1.0 / witnesses.coplanar).sum()
    return scipy.fft.rfftn(grids, axes=(1, 2, 3), overwrite_x=True)


@kernel
def _cell(points, k, into):
    """Return the indices of the cell in which a point is."""
    x, y, z = points[k, 0], points[k, 1], points[k, 2]
    i = int(np.floor(into[0, 0] * x + into[0, 1] * y + into[0, 2] * z + into[0, 3]))
    j = int(np.floor(into[1, 0] * x + into[1, 1] * y + into[1, 2] * z + into[1, 3]))
    n = int(np.floor(into[2, 0] * x + into[2, 1] * y + into[2, 2] * z + into[2, 3]))
    return i, j, n


@kernel
def _ask(points, facing, weights, into, grids):
    """Add the weights of points to the two grids of surfaces that face the axis, and that do not."""
    _, a, b, c = grids.shape
    for k in range(len(points)):
        i, j, n = _cell(points, k, into)
        if 0 <= i < a and 0 <= j < b and 0 <= n < c:
            if facing[k] > ALONG:
                grids[0, i, j, n] += weights[k]
            elif facing[k] < ACROSS:
                grids[1, i, j, n] += weights[k]


@kernel
def _fill(points, facing, into, grids):
    """Write the two grids of what answers: 1 where a surface is, less beside it, negative around it, else 0."""
    _, a, b, c = grids.shape
    for k in range(len(points)):
        i, j, n = _cell(points, k, into)
        if not (BAND <= i < a - BAND and BAND <= j < b - BAND and BAND <= n < c - BAND):
            continue
        own = 0 if facing[k] > ALONG else 1
        both = ACROSS <= facing[k] <= ALONG
        if grids[own, i, j, n] == 1.0 and not both:
            continue
        for p in range(-BAND, BAND + 1):
            for q in range(-BAND, BAND + 1):
                for r in range(-BAND, BAND + 1):
                    far = max(abs(p), abs(q), abs(r))
                    aside = (p != 0) + (q != 0) + (r != 0)
                    value = BESIDE
                    if far == 0:
                        value = 1.0
                    elif far == 1:
                        value = SIDE if aside == 1 else EDGE if aside == 2 else CORNER
                    for g in range(2):
                        here = value if (g == own or both) else BESIDE
                        before = grids[g, i + p, j + q, n + r]
                        if before == 0.0 or before < here:
                            grids[g, i + p, j + q, n + r] = here


@kernel(fastmath=True)
def _multiply(part, whole, half, out):
    """Write the sum of what either cloud is asked times what the other answers, the part after a half turn.

    A half turn mirrors the spectrum in two axes; where one of them is the last, whose negative frequencies are left
    out, the conjugate is mirrored in the others.
    """
    _, a, b, c = part.shape
    for i in range(a):
        p = (a - i) % a if half == 1 or half == 2 else i
        for j in range(b):
            q = (b - j) % b if half == 1 or half == 3 else j
            for k in range(c):
                total = 0.0j
                for n in range(4):
                    own = part[n, p, q, k] if half >= 2 else np.conj(part[n, p, q, k])
                    total += own * whole[n ^ 2, i, j, k]  # what the one is asked, the other answers
                out[i, j, k] = total


@kernel
def _peaks(values, count):
    """Return the ``count`` highest of (a, b, c) values, not beside each other, and their shifts (count, 3)."""
    a, b, c = values.shape
    best, shifts = np.empty(count), np.empty((count, 3))
    for n in range(count):
        top, x, y, z = np.float32(-np.inf), 0, 0, 0
        for i in range(a):
            for j in range(b):
                for k in range(c):
                    if values[i, j, k] > top:
                        top, x, y, z = values[i, j, k], i, j, k
        best[n] = top
        shifts[n, 0] = x if x < a // 2 else x - a
        shifts[n, 1] = y if y < b // 2 else y - b
        shifts[n, 2] = z if z < c // 2 else z - c
        for p in range(-1, 2):
            for q in range(-1, 2):
                for r in range(-1, 2):
                    values[(x + p) % a, (y + q) % b, (z + r) % c] = -np.inf
    return best, shifts


def _transforms(part: Volume, whole: Volume, turned: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    out = np.tile(np.eye(4), (len(shifts), 1, 1))
    rotation = whole.axes.T @ turned
    out[:, :3, :3] = rotation
    out[:, :3, 3] = whole.middle + shifts @ whole.axes - rotation @ part.middle
    return out


def found(ladder: Ladder) -> np.ndarray:
    """Return the best different (F, 4, 4) transforms at the given scale, best first, refined."""
    if 'volumes' not in ladder.finalists:
        flight, back = ladder.flight(1.0)
        comparison = flight.comparison(1.0)
        values, transforms = NONE
        if comparison and len(flight.part.points) >= MIN_CELLS:
            values, transforms = correlate(comparison, flight.part.planes, flight.rung(1.0).planes, ladder.look)
        transforms = turned(transforms, back)
        kept = ladder.distinct(transforms, np.argsort(-values, kind='stable')[:MOST_SORTED], CANDIDATES, DISTINCT)
        ladder.finalists['volumes'] = ladder.best(transforms[kept], estimate_scale=False)
    return ladder.finalists['volumes']


def propose(pair: StructurePair, config: HypothesesConfig, rng: np.random.Generator) -> np.ndarray:
    """Return the (F, 4, 4) finalists of the search, none where the scale is unknown: the same ones whenever asked."""
    low, high = pair.wide_scales
    return found(pair.ladder) if low == high else np.empty((0, 4, 4))
