"""What a sensor has looked through is empty: where its place is known, a point there contradicts."""

from __future__ import annotations

import numpy as np

BIN = 1.0  # degrees
TOLERANCE = 0.06  # of the range
MIN_TESTED = 50  # points in directions that the sensor has seen


def seen_through(points: np.ndarray, cloud: np.ndarray, viewpoint: np.ndarray) -> float | None:
    """Return the share of (P, 3) points that a sensor has looked through, of those in directions that it has seen.

    Parameters
    ----------
    points : (P, 3) ndarray
        The other cloud, moved into the sensor's frame.
    cloud : (N, 3) ndarray
        What the sensor has seen.
    viewpoint : (3,) ndarray
        Where it stood.

    Returns
    -------
    float or None
        None where too few points lie in directions that it has seen. Points behind what it has seen do not count.
    """
    seen, ranges = _directions(cloud - viewpoint)
    order = np.lexsort((ranges, seen))
    bins, first, count = np.unique(seen[order], return_index=True, return_counts=True)
    nearest, farthest = ranges[order][first], ranges[order][first + count - 1]
    asked, distance = _directions(points - viewpoint)
    place = np.minimum(np.searchsorted(bins, asked), len(bins) - 1)
    known = (bins[place] == asked) & (count[place] >= 2)
    through = known & (distance < (1.0 - TOLERANCE) * nearest[place])
    agree = known & ~through & (distance <= (1.0 + TOLERANCE) * farthest[place])
    tested = int(through.sum() + agree.sum())
    return float(through.sum() / tested) if tested >= MIN_TESTED else None


def _directions(offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a number for the direction of (N, 3) offsets, and their lengths."""
    ranges = np.linalg.norm(offsets, axis=1)
    azimuth = np.floor((np.degrees(np.arctan2(offsets[:, 1], offsets[:, 0])) + 180.0) / BIN).astype(np.int64)
    sine = np.clip(offsets[:, 2] / np.maximum(ranges, 1e-300), -1.0, 1.0)
    elevation = np.floor((np.degrees(np.arcsin(sine)) + 90.0) / BIN).astype(np.int64)
    return azimuth * 1000 + elevation, ranges
