"""Two clouds, whichever is the smaller: at every scale one is looked at as a part of the other.

Which of two clouds without a common unit is the larger is known with the scale only. So transforms of small scales see
the source as a part of the target, those of large ones the target as a part of the source.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from csgm_ros.cloud.kernels import kernel
from csgm_ros.progress import Look, unhurried
from csgm_ros.transform.flight import NORMALS, Flight, comparable, scale_of, scales_of

SAME = 2.0  # cells of mean displacement up to which two transforms are one
APART = 6.0  # nearer to a better one, a finalist is the same but for bent clouds and noise
FINALISTS = 6
FIRST: tuple[tuple[float, ...], int, int, int] = (4.0, 2.0), 100, 300, 160
"""Gates in cells and points of the part of a first, short ICP; points that are then asked how far the clouds agree, and
how many transforms are left."""
ROUNDS = (((4.0, 3.0), 300, False, 40), ((2.0, 1.5), 500, False, 16), ((2.0, 1.2, 0.8), 2000, True, 16))
"""Of the refinement: gates, points, on the finer tables, and how many are left."""


class Ladder:
    """Source and target as part and whole, and as whole and part.

    Parameters
    ----------
    source, target : (N, 3), (M, 3) ndarray
        Finite points.
    seed : int
    look : callable, optional
        Asked between the steps of a search.
    part : bool, optional
        The source is known to be the part, at every scale.

    Attributes
    ----------
    part : bool
    flights : pair of Flight
        The source, and the target, as the part.
    finalists : dict of str to (F, 4, 4) ndarray
        What each search in these cells has found, by the name of the source, best first.
    promising : (P, 4, 4) ndarray
        What was left after a first, short ICP in all these searches.
    """

    def __init__(
        self, source: np.ndarray, target: np.ndarray, seed: int, look: Look = unhurried, *, part: bool = False
    ):
        self.flights = Flight(source, target, seed), Flight(target, source, seed)
        self.look, self.part = look, part
        self.finalists: dict[str, np.ndarray] = {}
        self.promising = np.empty((0, 4, 4))

    @cached_property
    def turning(self) -> float:
        """The scale at which the structure of both clouds is equally large; beyond it the target is the part."""
        return np.inf if self.part else self.flights[1].part.size / self.flights[0].part.size

    def flight(self, scale: float) -> tuple[Flight, bool]:
        """Return the flight for a scale, and whether it goes back, from the target to the source."""
        back = bool(scale > self.turning)
        return self.flights[back], back

    def sees(self, scale: float) -> bool:
        """Return whether both clouds show anything at a scale, in cells of the smaller one's structure."""
        flight, back = self.flight(scale)
        return comparable(scale) and flight.comparison(1.0 / scale if back else scale) is not None

    def backs(self, transforms: np.ndarray) -> np.ndarray:
        """Return which (H,) of (H, 4, 4) transforms see the target as the part."""
        return scales_of(transforms) > self.turning

    def best(self, starts: np.ndarray, *, estimate_scale: bool, every_kind: bool = False) -> np.ndarray:
        """Return the best different ones (F, 4, 4) of (H, 4, 4) transforms, best first, refined round by round.

        Those are best that agree well by wide normals, and of the better ones, by every kind of
        :data:`csgm_ros.transform.flight.NORMALS`.
        """
        gates, samples, most, count = FIRST
        starts = self._refined(starts, gates, samples, estimate_scale=estimate_scale)
        starts = starts[self.distinct(starts, np.argsort(-self.scores(starts, most), kind='stable'), count)]
        self.promising = np.concatenate([self.promising, starts])
        scores, kinds = np.zeros(len(starts)), 1
        for gates, samples, fine, count in ROUNDS:
            refined = self._refined(starts, gates, samples, fine=fine, estimate_scale=estimate_scale)
            again = self._agreement(refined, kinds)
            better = again >= scores
            starts, scores = np.where(better[:, None, None], refined, starts), np.maximum(scores, again)
            kept = self.distinct(starts, np.argsort(-scores, kind='stable'), count)
            starts, scores = starts[kept], scores[kept]
            if every_kind and kinds == 1:  # by then few lengths are left that the clouds must be looked at
                kinds = len(NORMALS)
                scores = self._agreement(starts, kinds)
        return starts

    def _agreement(self, transforms: np.ndarray, kinds: int) -> np.ndarray:
        return np.prod([self.scores(transforms, kind=kind) for kind in range(kinds)], axis=0)

    def _refined(
        self, starts: np.ndarray, gates: tuple[float, ...], samples: int, *, fine: bool = False, estimate_scale: bool
    ) -> np.ndarray:
        ends = np.empty_like(starts)
        for h, start in enumerate(starts):
            self.look()
            flight, back = self.flight(scale_of(start))
            end = flight.refined(turned(start, back), gates, samples, fine=fine, estimate_scale=estimate_scale)
            ends[h] = turned(end, back)
        return ends

    def scores(self, transforms: np.ndarray, most: int | None = None, kind: int = 0) -> np.ndarray:
        """Return how far the clouds agree (H,) under (H, 4, 4) transforms, see :meth:`Flight.scores`."""
        transforms = np.asarray(transforms).reshape(-1, 4, 4)
        backs, scores = self.backs(transforms), np.zeros(len(transforms))
        known = comparable(scales_of(transforms))
        for back, flight in enumerate(self.flights):
            here = known & (backs == back)
            scores[here] = flight.scores(turned(transforms[here], bool(back)), most, kind)
        return scores

    def distinct(
        self, transforms: np.ndarray, order: Sequence[int] | np.ndarray, count: int, distance: float = SAME
    ) -> list[int]:
        """Return the first ``count`` indices of an order whose (H, 4, 4) transforms differ by ``distance`` cells.

        So much they move the part, in cells at the scale of the later one.
        """
        backs = self.backs(transforms).astype(int)
        scales = scales_of(transforms)
        images, near = [np.empty((len(transforms), 0, 3))] * 2, np.empty(len(transforms))
        for f in np.unique(backs):
            images[f] = self.flights[f].images(turned(transforms, bool(f)))
            here = backs == f
            near[here] = distance * self.flights[f].part.size * (1.0 / scales[here] if f else scales[here])
        return list(_distinct(np.asarray(order, np.int64), backs, near, images[0], images[1], count))

    def places(self, transforms: np.ndarray) -> list[np.ndarray]:
        """Return (H, 4, 4) transforms by place, at most ``FINALISTS`` of those, in the order given."""
        found: list[np.ndarray] = []
        while len(transforms) and len(found) < FINALISTS:
            here = np.array([self.alike(transforms[0], transform, APART) for transform in transforms])
            found.append(transforms[here])
            transforms = transforms[~here]
        return found

    def news(self, transforms: np.ndarray, known: np.ndarray) -> np.ndarray:
        """Return those of (H, 4, 4) transforms that are not the same as one of (K, 4, 4) that fits as well."""
        others = self.scores(known)
        new = [
            not any(self.alike(other, transform, APART) for other in known[others >= score])
            for transform, score in zip(transforms, self.scores(transforms), strict=True)
        ]
        return transforms[np.array(new, bool)]

    def alike(self, first: np.ndarray, second: np.ndarray, distance: float = SAME) -> bool:
        """Return whether two (4, 4) transforms move the part to the same place, within ``distance`` cells."""
        return len(self.distinct(np.stack([first, second]), (0, 1), 2, distance)) == 1


@kernel
def _distinct(order, backs, near, first, second, count):
    """Return of an order the first ``count`` of images (H, P, 3) in two flights that are ``near`` (H,) none before."""
    kept = np.empty(min(count, len(order)), np.int64)
    found = 0
    for h in order:
        images = second if backs[h] else first
        most = near[h] * images.shape[1]
        new = True
        for k in range(found):
            apart = 0.0
            for p in range(images.shape[1]):
                square = 0.0
                for axis in range(3):
                    square += (images[h, p, axis] - images[kept[k], p, axis]) ** 2
                apart += np.sqrt(square)
                if apart >= most:
                    break
            if apart < most:
                new = False
                break
        if new:
            kept[found] = h
            found += 1
            if found == len(kept):
                break
    return kept[:found]


def turned(transforms: np.ndarray, back: bool) -> np.ndarray:
    """Return (..., 4, 4) transforms from source to target as those of a flight, or those of a flight that goes back."""
    return np.linalg.inv(transforms) if back else transforms
