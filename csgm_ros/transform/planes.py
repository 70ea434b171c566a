"""Hypotheses from macro planes: planes aligned, then yaw, place and scale by correlation of layered occupancy."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from csgm_ros.cloud.cells import Cells
from csgm_ros.cloud.kernels import kernel
from csgm_ros.cloud.planes import Plane, frame
from csgm_ros.cloud.voxels import voxel_means
from csgm_ros.config import HypothesesConfig
from csgm_ros.transform import occupancy
from csgm_ros.transform.flight import Flight, comparable
from csgm_ros.transform.ladder import Ladder, turned
from csgm_ros.transform.sources import StructurePair

PLANES = 3  # of a cloud
PEAKS = 2  # of a correlation
STEP = 0.1  # between the logarithms of two scales
PROMISING = 240  # places of a flight's coarse look around which is looked finely
MIN_CELLS = 500  # of the part; fewer have no layers
MOST_SORTED = 3000
CANDIDATES, STARTS = 160, 500  # different places that are proposed, and that get a short ICP
PASS = 2 / 3  # of the frequencies are kept: the softened occupancy has no more


class Level(NamedTuple):
    """How finely is looked.

    Attributes
    ----------
    cell : float
        Edge in working cells.
    yaws : int
    edges : tuple of float
        Of the layers, in cells above the plane.
    sides : tuple of int
        Of the square maps, cells.
    """

    cell: float
    yaws: int
    edges: tuple[float, ...]
    sides: tuple[int, ...]


COARSE = Level(4.0, 24, (-3, -0.55, 0.55, 1.2, 2.4, 5, 10.0), (48, 72, 96))
FINE = Level(2.0, 48, (-6, -0.8, 0.8, 2, 4, 8, 18.0), (96, 144, 192))


Faces = Callable[[Cells], list[Plane]]
"""Returns the planes of the whole on which those of the part are laid, towards the side where its cells shall be."""


def dominant(cells: Cells) -> list[Plane]:
    """Return the planes on which most of a cloud is."""
    return cells.planes[:PLANES]


class View(NamedTuple):
    """A cloud from above one of its planes.

    Attributes
    ----------
    points : (n, 3) ndarray
    axes : (3, 3) ndarray
        The plane's frame.
    middle : (3,) ndarray
        The middle of the cloud on the plane.
    reach : float
        How far it extends from there, about.
    """

    points: np.ndarray
    axes: np.ndarray
    middle: np.ndarray
    reach: float

    def into(self, size: float, turn: float = 0.0) -> np.ndarray:
        """Return the matrix (3, 4) that brings the points into cells, turned."""
        cosine, sine = np.cos(turn), np.sin(turn)
        rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ self.axes
        return np.column_stack([rotation, -rotation @ self.middle]) / size


def view(cells: Cells, plane: Plane, size: float) -> View:
    """Look at a cloud, thinned to cells with edge ``size``, from above a plane."""
    points = voxel_means(cells.points, size)
    axes = frame(plane.normal)
    flat = (points - plane.point) @ axes.T
    middle = np.append(np.median(flat[:, :2], axis=0), 0.0)
    reach = np.percentile(np.abs(flat[:, :2] - middle[:2]), 97)
    return View(points, axes, plane.point + middle @ axes, float(reach))


class Look(NamedTuple):
    """One of two clouds as a part of the other one.

    Attributes
    ----------
    flight : Flight
    back : bool
        It goes from the target to the source.
    scales : (S,) ndarray
        That are looked at, from the part to the whole.
    """

    flight: Flight
    back: bool
    scales: np.ndarray


def looks_at(ladder: Ladder, scales: np.ndarray) -> list[Look]:
    """Return from which sides two clouds are looked at, for scales from the source to the target.

    Where the whole is sampled more coarsely than the part's structure is small, chance makes a few points agree: such
    scales are left out.
    """
    scales = scales[comparable(scales)]
    looks = []
    for back, flight in enumerate(ladder.flights):
        sought = scales[(scales > ladder.turning) == back]
        sought = 1.0 / sought if back else sought
        if not ladder.part:  # a map is made to be looked at in parts
            sought = sought[np.array([flight.resolved(scale) for scale in sought], bool)]
        if len(sought) and len(flight.part.points) >= MIN_CELLS:
            looks.append(Look(flight, bool(back), sought))
    return looks


class Correlator:
    """Correlates the clouds of a flight at one level; what scales share is done once."""

    def __init__(self, flight: Flight, level: Level, faces: Faces):
        self.flight, self.level, self.faces = flight, level, faces
        self.size = level.cell * flight.part.size
        self.turns = np.arange(level.yaws) * 2 * np.pi / level.yaws
        self.parts = [view(flight.part, plane, self.size) for plane in dominant(flight.part)]
        self._views: dict = {}
        self._part_spectra: dict = {}
        self._whole_spectra: dict = {}

    def wholes(self, scale: float) -> list[View]:
        """Return the whole from above each of its faces at a scale."""
        rung = self.flight.rung(scale)
        if id(rung) not in self._views:
            size = 0.75 * self.level.cell * rung.size  # not coarser than the cells of the smallest scale on the rung
            self._views[id(rung)] = [view(rung, plane, size) for plane in self.faces(rung)]
        return self._views[id(rung)]

    def peaks(self, a: int, b: int, scale: float, yaws: np.ndarray):
        """Return values (Y, PEAKS) and shifts (Y, PEAKS, 2) in cells of a part's plane on one of the whole's."""
        import scipy.fft

        part, whole = self.parts[a], self.wholes(scale)[b]
        wanted = (1.7 * whole.reach / scale + 1.4 * part.reach) / self.size
        side = next((s for s in self.level.sides if s >= wanted), self.level.sides[-1])
        kept = 2 * round(side * PASS / 2)
        missing = [y for y in yaws if (a, side, y) not in self._part_spectra]
        for y in missing:
            self._part_spectra[a, side, y] = np.conj(self._spectrum(part, self.size, self.turns[y], side, kept))
        if (scale, b, side) not in self._whole_spectra:
            spectrum = self._spectrum(whole, self.size * scale, 0.0, side, kept)
            half = len(spectrum) // 2
            self._whole_spectra[scale, b, side] = np.concatenate([spectrum[half:], spectrum[:half]])
        products = np.empty((len(yaws), kept, kept // 2 + 1), np.complex64)
        for y, product in zip(yaws, products, strict=True):
            _multiply(self._part_spectra[a, side, y], self._whole_spectra[scale, b, side], product)
        maps = scipy.fft.irfft2(products, s=(kept, kept), norm='forward', overwrite_x=True)
        values, places = _peaks(maps, PEAKS)
        return values / side**2, places * (side / kept)

    def _spectrum(self, seen: View, size: float, turn: float, side: int, kept: int) -> np.ndarray:
        import scipy.fft

        edges = np.array(self.level.edges)
        grids = np.empty((2, len(edges) - 1, side, side), np.float32)
        occupancy.fields(seen.points, seen.into(size, turn), edges, grids)
        spectrum = scipy.fft.rfft2(grids.reshape(-1, side, side), overwrite_x=True)
        half = kept // 2
        return np.concatenate([spectrum[:, :half, : half + 1], spectrum[:, side - half :, : half + 1]], axis=1)

    def transforms(self, a: int, b: int, scale: float, yaws: np.ndarray, shifts: np.ndarray) -> np.ndarray:
        """Return the matrices (Y, PEAKS, 4, 4) of shifts (Y, PEAKS, 2)."""
        part, whole = self.parts[a], self.wholes(scale)[b]
        out = np.zeros((*shifts.shape[:2], 4, 4))
        for n, y in enumerate(yaws):
            rotation = whole.axes.T @ part.into(1.0, self.turns[y])[:, :3]
            out[n, :, :3, :3] = scale * rotation
            out[n, :, :3, 3] = whole.middle + scale * self.size * shifts[n] @ whole.axes[:2]
            out[n, :, :3, 3] -= scale * rotation @ part.middle
            out[n, :, 3, 3] = 1.0
        return out


@kernel(fastmath=True)
def _multiply(source, target, out):
    """Write the sum over the layers of (L, n, m) source times target spectra."""
    layers, rows, columns = source.shape
    for i in range(rows):
        for j in range(columns):
            out[i, j] = 0
        for layer in range(layers):
            for j in range(columns):
                out[i, j] += source[layer, i, j] * target[layer, i, j]


@kernel
def _peaks(maps, count):
    """Return the ``count`` highest values (Y, count) of every (n, n) map, not beside each other, and their places."""
    yaws, side, _ = maps.shape
    values = np.empty((yaws, count))
    places = np.empty((yaws, count, 2))
    for y in range(yaws):
        for c in range(count):
            best, row, column = np.float32(-np.inf), 0, 0
            for i in range(side):
                for j in range(side):
                    if maps[y, i, j] > best:
                        best, row, column = maps[y, i, j], i, j
            values[y, c] = best
            places[y, c, 0] = row if row < side // 2 else row - side
            places[y, c, 1] = column if column < side // 2 else column - side
            for a in range(-2, 3):
                for b in range(-2, 3):
                    maps[y, (row + a) % side, (column + b) % side] = -np.inf
    return values, places


def _median(values: np.ndarray) -> tuple[float, float]:
    """Return the median and the robust standard deviation."""
    median = np.median(values)
    return float(median), float(1.4826 * np.median(np.abs(values - median)) + 1e-6)


def _interleaved(*keys):
    """Return indices in the order of several keys by turns, each index once."""
    mixed = np.stack([np.argsort(-key, kind='stable') for key in keys], axis=1).ravel()
    return mixed[np.sort(np.unique(mixed, return_index=True)[1])]


def correlate(ladder: Ladder, scales: np.ndarray, faces: Faces = dominant):
    """Return values (P,), robust values (P,), and transforms (P, 4, 4) of correlation peaks.

    With many scales, every second one is looked at coarsely with every second yaw, and finely only around the best.
    """
    looks = looks_at(ladder, scales)
    fine = [Correlator(look.flight, FINE, faces) for look in looks]
    work, norms = _promising(ladder, looks, faces) if len(scales) > 1 else (_everything(looks, fine), None)
    found = []
    for (f, a, b, n), yaws in work.items():
        scale = looks[f].scales[n]
        if b >= len(fine[f].wholes(scale)):
            continue
        ladder.look()
        values, shifts = fine[f].peaks(a, b, scale, yaws)
        matrices = turned(fine[f].transforms(a, b, scale, yaws, shifts).reshape(-1, 4, 4), looks[f].back)
        median, spread = norms[f, a, b, n // 2] if norms else _median(values)
        found.append((values.ravel(), (values.ravel() - median) / spread, matrices))
    if not found:
        return np.empty(0), np.empty(0), np.empty((0, 4, 4))
    return tuple(map(np.concatenate, zip(*found, strict=True)))


def _everything(looks: list[Look], fine: list[Correlator]):
    """Return all yaws by (look, plane, plane, scale), for one scale."""
    return {
        (f, a, b, 0): np.arange(FINE.yaws)
        for f, (look, one) in enumerate(zip(looks, fine, strict=True))
        for b in range(len(one.wholes(look.scales[0])))
        for a in range(len(one.parts))
    }


def _promising(ladder: Ladder, looks: list[Look], faces: Faces):
    """Return the yaws worth a fine look by (look, plane, plane, scale), and median and spread of the values there."""
    ratio = (COARSE.cell / FINE.cell) ** 2  # of the numbers of cells that surfaces have
    every = np.arange(COARSE.yaws)
    rows, norms = [], {}
    for f, (flight, _, scales) in enumerate(looks):
        coarse = Correlator(flight, COARSE, faces)
        for n in range((len(scales) + 1) // 2):
            scale = np.sqrt(scales[2 * n] * scales[min(2 * n + 1, len(scales) - 1)])
            for b in range(len(coarse.wholes(scale))):
                for a in range(len(coarse.parts)):
                    ladder.look()
                    values = coarse.peaks(a, b, scale, every)[0].max(1)
                    median, spread = _median(values)
                    chance = np.sqrt(min(len(coarse.parts[a].points), len(coarse.wholes(scale)[b].points)))
                    norms[f, a, b, n] = median, spread = median, np.hypot(spread, chance)  # by chance some are alike
                    rows += [(f, a, b, n, y, v, (v - median) / spread) for y, v in zip(every, values, strict=True)]
    norms = {key: (ratio * median, ratio * spread) for key, (median, spread) in norms.items()}
    table = np.array(rows).reshape(-1, 7)
    work: dict = {}
    for f in range(len(looks)):
        of_look = table[table[:, 0] == f]
        best = _interleaved(of_look[:, 5], of_look[:, 6])[:PROMISING]
        for _, a, b, n, y in of_look[best, :5].astype(int):
            for m in range(2 * n, min(2 * n + 2, len(looks[f].scales))):
                work.setdefault((f, a, b, m), set()).update(((2 * y - 1) % FINE.yaws, 2 * y, (2 * y + 1) % FINE.yaws))
    return {key: np.array(sorted(yaws)) for key, yaws in work.items()}, norms


def finalists(ladder: Ladder, scales: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the best different transforms (F, 4, 4), best first; those ``known`` (K, 4, 4) take part."""
    starts = np.concatenate([known, candidates(ladder, scales, STARTS)])
    return ladder.best(starts, estimate_scale=len(scales) > 1)


def candidates(ladder: Ladder, scales: np.ndarray, count: int = CANDIDATES, faces: Faces = dominant) -> np.ndarray:
    """Return different transforms (P, 4, 4), as they are, likely ones first.

    Of either flight those come first that correlate best and those that stand out most at their scale.
    """
    values, robust, transforms = correlate(ladder, scales, faces)
    backs = ladder.backs(transforms)
    keys = [np.where(backs == back, key, -np.inf) for back in np.unique(backs) for key in (values, robust)]
    order = _interleaved(*keys or [values])[:MOST_SORTED]
    return transforms[ladder.distinct(transforms, order, count, distance=3.0)]


def scales_between(low: float, high: float) -> np.ndarray:
    """Return the scales that are tried from a lowest to a highest one."""
    low, high = np.log((low, high))
    return np.exp(np.arange(low, high + STEP, STEP)) if high > low else np.exp([low])


def propose(pair: StructurePair, config: HypothesesConfig, rng: np.random.Generator) -> np.ndarray:
    """Return the (F, 4, 4) finalists of the search, best first, refined: the same ones whenever asked again."""
    ladder = pair.ladder
    if 'planes' not in ladder.finalists:
        ladder.finalists['planes'] = finalists(ladder, scales_between(*pair.wide_scales), pair.found())
    return ladder.finalists['planes']
