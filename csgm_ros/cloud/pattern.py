"""How the points of a cloud are spread: in the rows of a sensor, evenly, or as it came."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

RAY, RING = 1e-4, 0.02  # bins of tangents and of elevations (degrees)
EMPTY = 0.25  # of the mean of a bin, below which it is empty
GAPS = 0.4  # of the bins, that are empty between columns, rows or rings
FEWEST, MOST_RINGS = 4, 256
MOST_BINS = 100_000
EVEN = 0.25  # variation of the spacing below which a cloud is even


class Pattern(NamedTuple):
    """How points are spread.

    Attributes
    ----------
    kind : str
        depth grid, lidar rings, even or uneven.
    size : tuple of int
        Columns and rows of a depth grid, number of rings; else empty.
    """

    kind: str
    size: tuple[int, ...] = ()


def pattern(points: np.ndarray, spacings: np.ndarray) -> Pattern:
    """Return how points are spread; a grid or rings are only seen by a sensor at the origin with its usual axes.

    Parameters
    ----------
    points : (N, 3) ndarray
        Finite points.
    spacings : (S,) ndarray
        Distances of some of them to their nearest neighbours.
    """
    if (points[:, 2] > 0).all():  # an optical frame, REP-103: z ahead
        columns, rows = (_bands(points[:, k] / points[:, 2], RAY) for k in (0, 1))
        if min(columns, rows) >= FEWEST:
            return Pattern('depth grid', (columns, rows))
    rings = _bands(np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))), RING)
    if FEWEST <= rings <= MOST_RINGS:
        return Pattern('lidar rings', (rings,))
    variation = spacings.std() / max(spacings.mean(), 1e-300)
    return Pattern('even' if variation < EVEN else 'uneven')


def _bands(values: np.ndarray, step: float) -> int:
    """Return in how many bands values lie, 0 where these are not apart; ``step`` is much less than is between them."""
    low, high = np.quantile(values, (0.005, 0.995))
    bins = min(int((high - low) / step), MOST_BINS)
    if bins < FEWEST:
        return 0
    counts = np.histogram(values, bins, (low, high))[0]
    full = counts > EMPTY * counts.mean()
    return int((np.diff(full.astype(int)) == 1).sum() + full[0]) if (~full).mean() > GAPS else 0
