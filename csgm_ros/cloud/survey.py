"""A cloud of any size seen part by part: all of it coarsely, and some places as they are."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from csgm_ros.cloud.kernels import kernel
from csgm_ros.cloud.thin import thinned
from csgm_ros.errors import DegenerateCloudError

IN_A_BLOCK = 1000  # points of a block, about: some thirty spacings across
INNER = 0.1  # of a block's edge, from its faces on: the neighbours of what is inside are in the block too
PHASE = 0.37  # of a block's edge: floors and walls at the origin of the coordinates are not on its faces
ALL = 2.0**32  # hashes of blocks are below


@dataclass(frozen=True, eq=False)
class Survey:
    """What was seen.

    Attributes
    ----------
    total, finite : int
        Points.
    low, high : (3,) ndarray
        Corners of the bounding box of the finite ones.
    points : (N, 3) ndarray
        The finite points, or voxel means of a cloud of too many.
    drawn : (D, 3) ndarray
        The finite points, or so many of them, evenly drawn.
    places : (P, 3) ndarray
        The finite points, or all those in some blocks drawn at random.
    inner : (P,) bool ndarray
        Which of these have their neighbours in the block too.
    """

    total: int
    finite: int
    low: np.ndarray
    high: np.ndarray
    points: np.ndarray
    drawn: np.ndarray
    places: np.ndarray
    inner: np.ndarray


def survey(parts: Iterable[np.ndarray], rows: int, most: int, threads: int = 1) -> Survey:
    """Look at a cloud.

    Parameters
    ----------
    parts : iterable of (N, 3) ndarray
        Held in memory one at a time when there are more than ``most`` points.
    rows : int
        Of all parts.
    most : int
        Points of which no more than some times as many are held.
    threads : int, optional
        Parts worked on at a time.

    Raises
    ------
    DegenerateCloudError
        When no row is finite.
    """
    if rows <= most:
        whole = np.concatenate([np.asarray(part) for part in parts])
        points = whole[np.isfinite(whole).all(axis=1)].astype(float)
        if not len(points):
            raise DegenerateCloudError('no finite point; record the cloud again')
        inner = np.ones(len(points), bool)
        return Survey(rows, len(points), points.min(axis=0), points.max(axis=0), points, points, points, inner)
    parts = iter(parts)
    first = next((part for part in parts if np.isfinite(part).all(axis=1).any()), None)
    if first is None:
        raise DegenerateCloudError('no finite point; record the cloud again')
    watcher = _Watcher(np.asarray(first), rows, most)
    points = thinned(watcher.watched(itertools.chain([first], parts)), most, threads)
    return watcher.found(rows, points)


class _Watcher:
    """Takes down of the parts that pass what thinning would lose."""

    def __init__(self, first: np.ndarray, rows: int, most: int):
        self._most, self._every, self._finite = most, -(-rows // most), 0
        bulk = np.quantile(first[np.isfinite(first).all(axis=1)][:: 1 + len(first) // 10_000], (0.05, 0.95), axis=0)
        extent = max(float((bulk[1] - bulk[0]).max()), 1e-290)
        self._edge = extent / np.sqrt(rows / (6.0 * IN_A_BLOCK))  # as for the sides of a box
        self._below = ALL / self._every
        self._low, self._high = np.full(3, np.inf), np.full(3, -np.inf)
        self._drawn: list[np.ndarray] = []
        self._places: list[np.ndarray] = []
        self._held = 0

    def watched(self, parts: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
        for part in parts:
            self._watch(np.ascontiguousarray(part, float))
            yield part

    def found(self, rows: int, points: np.ndarray) -> Survey:
        drawn, places = np.concatenate(self._drawn), np.concatenate(self._places)
        if not len(places):  # one block holds too much
            places = points
        within = np.mod(places / self._edge + PHASE, 1.0)
        inner = (np.abs(within - 0.5) < 0.5 - INNER).all(axis=1)
        inner = inner if inner.any() else np.ones(len(places), bool)
        return Survey(rows, self._finite, self._low, self._high, points, drawn, places, inner)

    def _watch(self, part: np.ndarray) -> None:
        kept = np.zeros(len(part), bool)
        self._finite += _look(part, 1.0 / self._edge, self._below, self._low, self._high, kept)
        drawn = part[:: self._every]
        self._drawn.append(drawn[np.isfinite(drawn).all(axis=1)].copy())
        self._places.append(part[kept])
        self._held += int(kept.sum())
        while self._held > 2 * self._most:
            self._below /= 2.0
            for number, places in enumerate(self._places):
                kept = np.zeros(len(places), bool)
                _look(places, 1.0 / self._edge, self._below, self._low, self._high, kept)
                self._places[number] = places[kept]
            self._held = sum(map(len, self._places))


@kernel
def _look(points, scale, below, low, high, kept):
    """Widen the bounding box, mark the points of the blocks whose hash is below a number; return the finite points."""
    finite = 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)):
            continue
        finite += 1
        for k in range(3):
            low[k] = min(low[k], points[i, k])
            high[k] = max(high[k], points[i, k])
        a, b, c = np.floor(x * scale + PHASE), np.floor(y * scale + PHASE), np.floor(z * scale + PHASE)
        if max(abs(a), abs(b), abs(c)) < 2.0**60:
            mixed = (np.int64(a) * 73856093) ^ (np.int64(b) * 19349669) ^ (np.int64(c) * 83492791)
            mixed = (mixed * np.int64(-7046029254386353131)) >> 32 & 0xFFFFFFFF
            kept[i] = mixed < below
    return finite
