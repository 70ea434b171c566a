"""Everything that is found out about a winner before it is judged."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from csgm_ros.cloud.agreement import Agreement, Comparison
from csgm_ros.cloud.distinct import distinct
from csgm_ros.cloud.witnesses import NEAR
from csgm_ros.types import NearestGrid
from csgm_ros.verification.probes import SCALES, mirrors, scales, symmetries

Refine = Callable[..., np.ndarray]
"""``refine(transforms, grids, samples, distances, estimate_scale, iterations)``, see
:func:`csgm_ros.transform.refinement.refine_between`; verification proposes, but does not know how to refine."""

Polish = Callable[..., np.ndarray]
"""``polish(transform, scaled=True)`` of one (4, 4) transform, see :func:`polished`; not ``scaled``, at its scale."""

WIDE_DISTANCES, FINE_DISTANCES = (4.0, 2.5, 1.5), (0.75, 0.4)  # cells, of the correspondences of probes
SAME_DISTANCES = (1.0, 0.5)
POLISH, POLISHED = (1.5,), 60  # cells, and steps at most, until what all witnesses say no longer changes
STEPS = np.array((-0.05, -0.03, -0.015, 0.015, 0.03, 0.05))  # logarithms of the scales that, like a winner's own, ...
AS_WELL = 0.8  # ... count so far as they fit better than so many times as well as the best
MOVED = 0.001  # of the scale, below which the mean of these is where it was: what is exact stays exact
FEW, SOME, PROBES = 400, 700, 60  # points
MOST_RIVALS, RIVALS_APART = 16, 2.5  # that are measured on all points, of what is probed; cells
WORTH = 0.3  # of the winner's score, from which a rival is polished: the others leave no doubt
ROUNDS = ((WIDE_DISTANCES[:1], 350, 48), (WIDE_DISTANCES[1:], SOME, 16), (FINE_DISTANCES, SOME, 16))
"""Of probes: correspondence distances, points that tell the best, and how many are kept."""
MOST_MIRRORED = 4
MIN_OVERLAP = 20  # points, below which there is nothing to probe
BOARDS = ((5.0, 0.0), (5.0, 0.37), (8.0, 0.0), (8.0, 0.37))  # edge in cells and phase of the checkerboards
SAME_SCALE, SAME_ANGLE = 0.05, 10.0  # |log factor| and degrees up to which a rival only slides
OTHER_SCALE = 0.1  # |log factor| from which another scale is another answer
DOUBT = 0.5  # of the winner's score, from which it is found out whether a rival is the winner but for its scale ...
RESIZED = 0.005, OTHER_SCALE  # ... which it may be between these |log factor|
SAME = 2.5  # cells of RMS displacement up to which two transforms are one


@dataclass(frozen=True, eq=False)
class Motion:
    """How a rival differs from the winner: mostly a slide, or mostly a turn.

    Attributes
    ----------
    kind : str
        slide or turn.
    axis : (3,) ndarray
        Direction of the slide or axis of the turn, in the target's frame.
    amount : float
        Length of the slide, degrees of the turn.
    """

    kind: str
    axis: np.ndarray
    amount: float


@dataclass(frozen=True, eq=False)
class Rival:
    """A different transform and how well it fits.

    Attributes
    ----------
    ratio : float
        Its score over the winner's.
    displacement : float
        RMS displacement from the winner, cells.
    motion : Motion or None
        How to get there from the winner; None where the scale changes too.
    transform : (4, 4) ndarray or None
        Between the clouds of the comparison.
    """

    ratio: float
    displacement: float
    motion: Motion | None = None
    transform: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Findings:
    """What is known about a winner.

    Attributes
    ----------
    agreement : Agreement
    rivals : tuple of Rival
        Other finalists of the search; once probed, symmetry probes too.
    scale_curve : tuple of (float, float)
        Factor on the scale, and the score there over the winner's; empty until probed.
    mirrored : float
        Best score of the mirrored source over the winner's: well above 1 when the source is a mirror image.
    half_shift : float
        RMS displacement of the overlap between refinements on disjoint halves of the structure, cells; infinite where
        there is too little; 0 until probed.
    seen_through : float
        Share of points that a sensor with known viewpoint has looked through; 0 where none is known.
    """

    agreement: Agreement
    rivals: tuple[Rival, ...]
    scale_curve: tuple[tuple[float, float], ...] = ()
    mirrored: float = 0.0
    half_shift: float = 0.0
    seen_through: float = 0.0


@dataclass(frozen=True, eq=False)
class Probes:
    """What was probed of a winner, whatever competes with it; see :class:`Findings`.

    Attributes
    ----------
    moved : (S, 4, 4) ndarray
        Where its slides and turns ended.
    scale_curve : tuple of (float, float)
    mirrored, half_shift : float
    """

    moved: np.ndarray
    scale_curve: tuple[tuple[float, float], ...]
    mirrored: float
    half_shift: float


def compared(comparison: Comparison, winner: np.ndarray, others: Iterable[np.ndarray], polish: Polish) -> Findings:
    """Return what the other finalists of the search, (4, 4) transforms, say about the winner."""
    agreement = comparison.agreement(winner)
    return Findings(agreement, tuple(_rivals(comparison, winner, agreement, others, polish)))


def exchanged(findings: Findings, winner: np.ndarray) -> Findings:
    """Return the findings on the inverse of a winner: its motions in the source's frame, its scales upside down."""
    back = -winner[:3, :3].T / np.sqrt((winner[:3, 0] ** 2).sum())
    rivals = (
        replace(rival, motion=rival.motion and replace(rival.motion, axis=back @ rival.motion.axis))
        for rival in findings.rivals
    )
    curve = tuple((1.0 / factor, ratio) for factor, ratio in findings.scale_curve)
    return replace(findings, rivals=tuple(rivals), scale_curve=curve)


def probe(
    comparison: Comparison, winner: np.ndarray, agreement: Agreement, refine: Refine, *, estimate_scale: bool
) -> Probes | None:
    """Return what symmetry probes, other scales and halves say about a winner; None where there is too little."""
    overlap = comparison.overlap(winner)
    if len(overlap[0]) < MIN_OVERLAP:
        return None
    starts = symmetries(winner, *overlap)
    # as they are too: at wide distances, what fits by little of what it shows shrinks onto that
    moved = np.concatenate(
        [_competing(comparison, starts, refine, estimate_scale=free) for free in sorted({estimate_scale, False})]
    )
    source, target = comparison.sides
    clouds = source.points @ winner[:3, :3].T + winner[:3, 3], target.points
    flipped = mirrors(winner, *overlap, clouds, comparison.cell)
    flipped = _competing(comparison, flipped, refine, estimate_scale=estimate_scale)[:MOST_MIRRORED]
    distances = *WIDE_DISTANCES[2:], *FINE_DISTANCES
    resized = refined(comparison, scales(winner, overlap[0]), distances, refine, estimate_scale=False)
    return Probes(
        moved,
        tuple(zip(SCALES, map(float, _ratios(comparison, resized, agreement)), strict=True)),
        float(_ratios(comparison, flipped, agreement).max()),
        half_shift(comparison, winner, overlap[0], refine, estimate_scale=estimate_scale),
    )


def probed(
    comparison: Comparison, winner: np.ndarray, findings: Findings, probes: Probes | None, polish: Polish
) -> Findings:
    """Return the findings with those of probes added."""
    if probes is None:
        return replace(findings, half_shift=float('inf'))
    moved = np.array([other for other in probes.moved if apart(comparison, winner, other) > SAME]).reshape(-1, 4, 4)
    moved = _different(comparison, moved, SOME, MOST_RIVALS, RIVALS_APART)
    return replace(
        findings,
        rivals=(*findings.rivals, *_rivals(comparison, winner, findings.agreement, moved, polish)),
        scale_curve=probes.scale_curve,
        mirrored=probes.mirrored,
        half_shift=probes.half_shift,
    )


def _competing(comparison: Comparison, moved: np.ndarray, refine: Refine, *, estimate_scale: bool) -> np.ndarray:
    """Return the best of (H, 4, 4) transforms that may fit as well as a winner, refined round by round."""
    for distances, points, most in ROUNDS:
        moved = refined(comparison, moved, distances, refine, estimate_scale=estimate_scale)
        moved = _different(comparison, moved, points, most)
    return moved


def _different(
    comparison: Comparison, transforms: np.ndarray, points: int, count: int, distance: float = 1.0
) -> np.ndarray:
    """Return the ``count`` best of (H, 4, 4) transforms that are so many cells apart, as so many points tell."""
    source = comparison.sides[0]
    probe = source.points[source.sample[:PROBES]]
    order = np.argsort(comparison.scores(transforms, points))[::-1].copy()
    return transforms[distinct(transforms, order, probe, distance * comparison.cell, count)]


def refined(
    comparison: Comparison, moved: np.ndarray, distances: tuple[float, ...], refine: Refine, *, estimate_scale: bool
) -> np.ndarray:
    """Refine (H, 4, 4) transforms with correspondence distances in cells, the wide ones on fewer points."""
    wide = _lengths([distance for distance in distances if distance > NEAR], comparison.cell)
    fine = _lengths([distance for distance in distances if distance <= NEAR], comparison.cell)
    if wide:
        grids = _grids(comparison, 'wide')
        few = tuple(np.arange(0, len(grid.points), max(1, len(grid.points) // FEW)) for grid in grids)
        moved = refine(moved, grids, few, wide, estimate_scale=estimate_scale)
    if fine:
        some = tuple(side.sample[:SOME] for side in comparison.sides)
        moved = refine(moved, _grids(comparison, 'grid'), some, fine, estimate_scale=estimate_scale)
    return moved


def polished(comparison: Comparison, transforms: np.ndarray, refine: Refine, *, estimate_scale: bool) -> np.ndarray:
    """Refine (H, 4, 4) transforms until what all witnesses say no longer changes.

    Of one place the end is the same but for some hundredths of a cell, wherever in it the search has stopped.
    """
    samples = tuple(side.sample for side in comparison.sides)
    lengths, grids = _lengths(POLISH, comparison.cell), _grids(comparison, 'grid')
    return refine(transforms, grids, samples, lengths, estimate_scale=estimate_scale, iterations=POLISHED)


def centred(comparison: Comparison, transform: np.ndarray, refine: Refine) -> np.ndarray:
    """Return a polished (4, 4) transform at the mean of the scales at which the clouds agree about as well.

    Bent clouds do over some percent, and at which of these an ICP ends is chance. Where one scale alone fits, it stays.
    """
    overlap = comparison.overlap(transform)[0]
    if len(overlap) < MIN_OVERLAP:
        return transform
    resized = polished(comparison, scales(transform, overlap, np.exp(STEPS)), refine, estimate_scale=False)
    scores = np.array([comparison.agreement(end).evidence for end in (transform, *resized)])
    weights = np.maximum(scores - AS_WELL * scores.max(), 0.0)
    step = weights[1:] @ STEPS / max(weights.sum(), 1e-12)
    if abs(step) < MOVED:
        return transform
    return polished(comparison, scales(transform, overlap, [np.exp(step)]), refine, estimate_scale=False)[0]


def half_shift(
    comparison: Comparison, winner: np.ndarray, overlap: np.ndarray, refine: Refine, *, estimate_scale: bool
) -> float:
    """Return how far refinements on disjoint halves of the structure are apart: RMS over the overlap, in cells.

    The halves are the fields of a checkerboard; the median of several boards counts. The overlap is (I, 3) points in
    the target's frame.
    """
    source, target = comparison.sides
    cell = comparison.cell
    places = source.points[source.sample] @ winner[:3, :3].T + winner[:3, 3], target.points[target.sample]
    inverse = np.linalg.inv(winner)
    shared = overlap @ inverse[:3, :3].T + inverse[:3, 3]
    shifts = []
    for edge, phase in BOARDS:
        black = [np.floor(place / (edge * cell) + phase).astype(int).sum(1) % 2 == 0 for place in places]
        ends = []
        for half in (black, [~side for side in black]):
            samples = tuple(side.sample[chosen] for side, chosen in zip(comparison.sides, half, strict=True))
            if min(map(len, samples)) < MIN_OVERLAP:
                return float('inf')
            lengths = _lengths(SAME_DISTANCES, cell)
            grids = _grids(comparison, 'grid')
            ends.append(refine(winner[None], grids, samples, lengths, estimate_scale=estimate_scale)[0])
        shifts.append(_displacement(ends[0], ends[1], shared) / cell)
    return float(np.median(shifts))


def _rivals(
    comparison: Comparison, winner: np.ndarray, agreement: Agreement, others: Iterable[np.ndarray], polish: Polish
) -> Iterator[Rival]:
    """Yield what competes with a winner, polished as that is: what leads back to it does not."""
    resized: list[np.ndarray] = []  # where the winner is met again at another scale: most of the probes end there
    others = np.array([*others]).reshape(-1, 4, 4)
    for ratio, other in zip(_ratios(comparison, others, agreement), others, strict=True):
        if ratio > WORTH:
            other = polish(other)
            ratio = _ratios(comparison, other, agreement)[0]
        where = apart(comparison, winner, other)
        if where <= SAME or any(apart(comparison, end, other) <= SAME for end in resized):
            continue
        if ratio > DOUBT and _only_resized(comparison, winner, other, polish):
            resized.append(other)
        else:
            yield Rival(float(ratio), where, motion(winner, other, _few(comparison)), other)


def _only_resized(comparison: Comparison, winner: np.ndarray, other: np.ndarray, polish: Polish) -> bool:
    """Return whether a transform leads to the winner at the winner's scale: its own is for the scale curve to judge."""
    growth = np.sqrt(np.divide((winner[:3, 0] ** 2).sum(), (other[:3, 0] ** 2).sum()))
    if not RESIZED[0] < abs(np.log(growth)) <= RESIZED[1]:
        return False
    overlap = comparison.overlap(other)[0]
    if len(overlap) < MIN_OVERLAP:
        return False
    return apart(comparison, winner, polish(scales(other, overlap, [growth])[0], scaled=False)) <= SAME


def apart(comparison: Comparison, winner: np.ndarray, other: np.ndarray) -> float:
    """Return the RMS displacement in cells between two (4, 4) transforms."""
    return _displacement(winner, other, _few(comparison)) / comparison.cell


def _few(comparison: Comparison) -> np.ndarray:
    source = comparison.sides[0]
    return source.points[source.sample[:FEW]]


def motion(winner: np.ndarray, other: np.ndarray, points: np.ndarray) -> Motion | None:
    """Return how to get from one (4, 4) transform of (P, 3) points to another; None where the scale changes too."""
    factor = np.sqrt(np.divide((other[:3, 0] ** 2).sum(), (winner[:3, 0] ** 2).sum()))
    if abs(np.log(factor)) > SAME_SCALE:
        return None
    turn = other[:3, :3] @ np.linalg.inv(winner[:3, :3]) / factor
    sine = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2.0
    degrees = float(np.degrees(np.arctan2(np.linalg.norm(sine), (np.trace(turn) - 1.0) / 2.0)))
    if degrees > SAME_ANGLE:
        # the axis is the eigenvector of eigenvalue 1, which half turns have too
        _, vectors = np.linalg.eigh(turn + turn.T)
        axis = vectors[:, -1] * (1.0 if vectors[:, -1] @ sine >= 0.0 else -1.0)
        return Motion('turn', axis, degrees)
    middle = points.mean(0)
    slide = (other - winner)[:3, :3] @ middle + (other - winner)[:3, 3]
    length = float(np.linalg.norm(slide))
    return Motion('slide', slide / max(length, 1e-12), length)


def _ratios(comparison: Comparison, transforms: np.ndarray, agreement: Agreement) -> np.ndarray:
    return comparison.scores(transforms) / max(agreement.score, 1e-12)


def _displacement(first: np.ndarray, second: np.ndarray, points: np.ndarray) -> float:
    offsets = points @ (first - second)[:3, :3].T + (first - second)[:3, 3]
    return float(np.sqrt((offsets**2).sum(1).mean()))


def _grids(comparison: Comparison, name: str) -> tuple[NearestGrid, NearestGrid]:
    return tuple(getattr(side, name) for side in comparison.sides)


def _lengths(cells: Iterable[float], cell: float) -> tuple[float, ...]:
    return tuple(length * cell for length in cells)
