"""Several clouds of one sensor merged into one: the last N messages of a topic."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from csgm_ros.errors import InputError
from csgm_ros.types import Cloud


def merge(clouds: Sequence[Cloud], voxel_size: float) -> Cloud:
    """Merge clouds of one frame; the mean of each occupied voxel stays, of points and of colours.

    Parameters
    ----------
    clouds : sequence of Cloud
        Oldest first, all in the same frame. A single cloud is returned as it is.
    voxel_size : float
        Edge of the voxels relative to the merged cloud's radius (its largest distance to the centroid); 0 keeps
        every point.

    Returns
    -------
    Cloud
        With the newest stamp. Colours only where every cloud has them.

    Raises
    ------
    InputError
        When the clouds are in different frames.
    """
    if len(clouds) == 1:
        return clouds[0]
    frames = sorted({cloud.frame_id for cloud in clouds})
    if len(frames) > 1:
        raise InputError(f'clouds to merge are in different frames ({", ".join(frames)}); set fixed_frame to one')
    points = np.concatenate([cloud.points for cloud in clouds])
    colored = all(cloud.colors is not None for cloud in clouds)
    colors = np.concatenate([cloud.colors for cloud in clouds]) if colored else None
    if voxel_size > 0.0:
        points, colors = average_voxels(points, colors, voxel_size)
    newest = max(cloud.stamp for cloud in clouds)
    return Cloud(points, colors, frames[0], newest, sum(cloud.dropped for cloud in clouds))


def average_voxels(
    points: np.ndarray, colors: np.ndarray | None, voxel_size: float
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the mean point and colour of each occupied voxel; ``voxel_size`` relative to the radius."""
    centered = points - points.mean(axis=0)
    edge = voxel_size * float(np.sqrt((centered**2).sum(axis=1).max()))
    if edge == 0.0:
        return points[:1], None if colors is None else colors[:1]
    cells = np.floor(centered / edge).astype(np.int64)
    cells -= cells.min(axis=0)
    extent = cells.max(axis=0) + 1
    keys = (cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]
    _, voxel, counts = np.unique(keys, return_inverse=True, return_counts=True)
    merged = average(points, voxel, counts)
    return merged, None if colors is None else np.rint(average(colors, voxel, counts)).astype(np.uint8)


def average(values: np.ndarray, group: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the mean of each group's (N, 3) values."""
    sums = [np.bincount(group, weights=column, minlength=len(counts)) for column in values.T]
    return np.stack(sums, axis=1) / counts[:, None]
