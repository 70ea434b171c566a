"""What a cloud is like, before it is registered."""

from __future__ import annotations

import numpy as np

from csgm_ros.config import SupervoxelConfig, parameter_fields, profile
from csgm_ros.errors import DegenerateCloudError

LARGEST_VOXEL = parameter_fields(SupervoxelConfig)['voxel_size'].metadata['high']


def inspect(points: np.ndarray) -> str:
    """Describe a cloud: points, extent, radius, spacing, and the parameters that suit its density.

    Parameters
    ----------
    points : (N, 3) ndarray
        Any unit; rows that are not finite are left out.

    Raises
    ------
    DegenerateCloudError
        When all points are in one place.
    """
    from scipy.spatial import cKDTree

    finite = points[np.isfinite(points).all(axis=1)]
    radius = float(np.linalg.norm(finite - finite.mean(axis=0), axis=1).max())
    distinct = np.unique(finite, axis=0)
    if radius == 0 or len(distinct) < 2:
        raise DegenerateCloudError('all points are in one place; record the cloud again')
    sample = np.random.default_rng(0).permutation(len(distinct))[:5000]
    spacing = float(np.median(cKDTree(distinct).query(distinct[sample], k=2)[0][:, 1]))
    extent = np.ptp(finite, axis=0)
    default = profile().supervoxels.voxel_size
    voxel = min(max(default, round(2 * spacing / radius, 3)), LARGEST_VOXEL)
    lines = [
        f'points   {len(points)} ({len(points) - len(finite)} not finite, {len(finite) - len(distinct)} repeated)',
        f'extent   {extent[0]:.4g} x {extent[1]:.4g} x {extent[2]:.4g}',
        f'radius   {radius:.4g} (largest distance to the centroid: the unit of the relative lengths)',
        f'spacing  {spacing:.4g} (median distance to the nearest neighbour) = {spacing / radius:.4f} radii',
        f'voxel    supervoxels.voxel_size {default:g} is {default * radius:.4g} in the unit of this cloud',
    ]
    if voxel > default:
        lines.append(f'suggest  --set supervoxels.voxel_size={voxel:g}: the cloud is sparser than two points a voxel')
    else:
        lines.append('suggest  the defaults suit this density')
    return '\n'.join(lines)
