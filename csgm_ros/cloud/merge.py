"""Several clouds of one sensor merged into one: the last N messages of a topic."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from csgm_ros.cloud.voxels import voxelized
from csgm_ros.errors import InputError
from csgm_ros.types import Cloud

FINEST = 1e-5  # of the radius: cells that the voxel grid can number


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
    edge = max(voxel_size, FINEST) * float(np.sqrt(np.max(((points - points.mean(axis=0)) ** 2).sum(axis=1))))
    if edge == 0.0:
        return points[:1], None if colors is None else colors[:1]
    merged, voxel = voxelized(points, edge)
    if colors is None:
        return merged, None
    sums = np.stack([np.bincount(voxel, weights=column, minlength=len(merged)) for column in colors.T], axis=1)
    return merged, np.rint(sums / np.bincount(voxel)[:, None]).astype(np.uint8)
