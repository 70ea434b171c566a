"""Step 2b, micro structure: what describes a node (Sec. III-B and Sec. III-C)."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from csgm_ros.cloud.outliers import distances_from
from csgm_ros.config import Config
from csgm_ros.errors import InputError
from csgm_ros.structure.esf import WIDTH, fill
from csgm_ros.structure.fpfh import fpfh
from csgm_ros.types import PreparedCloud, Supervoxels

CHUNK = 4  # groups that a thread takes at a time
ESF_UNIT, FPFH_UNIT = 0.1, 50.0  # bring both to one scale; FPFH tells nodes apart better and gets twice the weight


def of_supervoxels(
    supervoxels: Supervoxels, surface: PreparedCloud, config: Config, rng: np.random.Generator, relative: float
) -> np.ndarray:
    """Return the ESF of each bare supervoxel, (n, 640): the paper's descriptor (kind ``esf``)."""
    starts, members = members_of(supervoxels.voxel_labels, len(supervoxels))
    samples = config.descriptors.esf_samples
    return esf_of_groups(supervoxels.voxel_points, starts, members, rng, samples, config.threads)


def of_surroundings(
    supervoxels: Supervoxels, surface: PreparedCloud, config: Config, rng: np.random.Generator, relative: float
) -> np.ndarray:
    """Return ESF and FPFH of each supervoxel's surroundings, (n, 673) (kind ``context``).

    The ESF of the bare supervoxel is at chance: the cut differs between two clouds, and so does what one supervoxel
    holds. Its surroundings stay.
    """
    part = config.descriptors
    radius = part.context_radius * config.supervoxels.seed_size * relative
    shapes, features = context(
        surface.points, surface.normals, supervoxels.centroids, radius, rng, part.esf_samples, config.threads
    )
    return np.column_stack([shapes / ESF_UNIT, features / FPFH_UNIT])


def esf(points: np.ndarray, rng: np.random.Generator, samples: int = 20000) -> np.ndarray:
    """Return the ensemble of shape functions (ESF) of one shape, (640,), summing to 1.

    Parameters
    ----------
    points : (N, 3) array_like
        The shape. Its scale, place and rotation do not matter, up to the grid's resolution and chance.
    rng : Generator
        Draws one 64-bit state; the samples come from that.
    samples : int
        Random triples of points.

    Returns
    -------
    (640,) ndarray
        Zeros, which no valid descriptor is, if the points span no triangle: fewer than three distinct ones, or all
        on one line.

    Raises
    ------
    InputError
        If the points are not finite (N, 3), or no samples are wanted.

    Notes
    -----
    Source: Sec. III-C (ESF 640), after Wohlkinger and Vincze 2011 in the form that PCL gave it. PCL does not return
    for points that span no triangle and can read beyond its grid; both are ruled out here.
    """
    return esf_of_groups(points, np.array([0, len(points)]), np.arange(len(points)), rng, samples, threads=1)[0]


def esf_of_groups(
    points: np.ndarray,
    starts: np.ndarray,
    members: np.ndarray,
    rng: np.random.Generator,
    samples: int = 20000,
    threads: int = 0,
) -> np.ndarray:
    """Return the :func:`esf` of many groups of points, (n, 640).

    Parameters
    ----------
    points : (N, 3) array_like
        All points.
    starts : (n + 1,) array_like of int
        Group g has the points ``members[starts[g]:starts[g + 1]]``.
    members : (k,) array_like of int
        Indices of points, group after group; see :func:`members_of`.
    rng : Generator
        Draws one 64-bit state a group.
    samples : int
        Random triples of points per group.
    threads : int
        Threads at most; 0 takes every core. The result does not depend on it.

    Returns
    -------
    (n, 640) ndarray
        Rows sum to 1; rows of zeros are not valid (``rows.any(1)`` tells).

    Raises
    ------
    InputError
        If the points are not finite (N, 3), the groups do not fit them, or no samples are wanted.
    """
    points, starts, members = _checked(points, starts, members, samples)
    count = len(starts) - 1
    states = rng.integers(2**64, size=count, dtype=np.uint64)
    rows = np.empty((count, WIDTH))

    def describe(first: int) -> None:
        fill(points, starts, members, states, samples, first, min(first + CHUNK, count), rows)

    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
        list(pool.map(describe, range(0, count, CHUNK)))
    return rows


def members_of(labels: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (starts, members) of :func:`esf_of_groups` for (N,) labels below ``count``; -1 is in no group."""
    sizes = np.bincount(labels[labels >= 0], minlength=count)
    return np.concatenate(([0], np.cumsum(sizes))), np.argsort(labels, kind='stable')[len(labels) - sizes.sum() :]


def context(
    voxel_points: np.ndarray,
    voxel_normals: np.ndarray,
    nodes: np.ndarray,
    radius: float,
    rng: np.random.Generator,
    samples: int = 4000,
    threads: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Describe the surroundings of nodes: ESF of the ball around each, and FPFH.

    Parameters
    ----------
    voxel_points, voxel_normals : (v, 3) ndarray
        The cloud, evenly sampled, and its normals with a consistent sign, as
        :func:`csgm_ros.structure.supervoxels.segment` returns them.
    nodes : (n, 3) ndarray
        Centroids of the supervoxels.
    radius : float
        Of the ball, in the unit of the points.
    rng : Generator
        For the ESF.
    samples, threads : int
        See :func:`esf_of_groups`.

    Returns
    -------
    esf : (n, 640) ndarray
        Rows sum to 1; zeros where the ball holds no triangle.
    fpfh : (n, 33) ndarray
        Each of the three histograms of a row sums to 100; zeros where the ball holds no pair with normals.

    Raises
    ------
    InputError
        If the points or nodes are not finite (k, 3), or the radius is not positive.

    Notes
    -----
    The paper describes a node by the ESF of its supervoxel alone (Sec. III-C); that puts the true counterpart in the
    middle of the ranking, because the two clouds are cut in different places. Around the node both have the same.
    """
    nodes = np.asarray(nodes, np.float64)
    if nodes.ndim != 2 or nodes.shape[1] != 3 or not np.isfinite(nodes).all():
        raise InputError(f'nodes must be finite (n, 3), not {nodes.shape}')
    if not 0 < radius < np.inf:
        raise InputError(f'the radius of the surroundings must be positive, not {radius!r}')
    starts, members = _balls(np.asarray(voxel_points, np.float64), nodes, radius)
    shapes = esf_of_groups(voxel_points, starts, members, rng, samples, threads)
    return shapes, fpfh(voxel_points, voxel_normals, radius, nodes)


def _balls(points: np.ndarray, nodes: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return (starts, members) of the points within the radius of each node."""
    near = [np.flatnonzero(distances_from(node, points) <= radius) for node in nodes]
    sizes = [len(members) for members in near]
    return np.concatenate(([0], np.cumsum(sizes, dtype=np.int64))), np.concatenate([np.empty(0, np.int64), *near])


def _checked(
    points: np.ndarray, starts: np.ndarray, members: np.ndarray, samples: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the arrays in the types the kernel is compiled for, or raise: the kernel itself checks no index."""
    points = np.ascontiguousarray(points, np.float64)
    starts, members = np.ascontiguousarray(starts, np.int64), np.ascontiguousarray(members, np.int64)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise InputError(f'points must be finite (N, 3), not {points.shape}: drop rows with NaN or infinity before')
    if (
        starts.ndim != 1
        or not len(starts)
        or starts[0] != 0
        or starts[-1] != len(members)
        or (np.diff(starts) < 0).any()
    ):
        raise InputError('starts must ascend from 0 to the number of members')
    if len(members) and not (members.min() >= 0 and members.max() < len(points)):
        raise InputError(f'members must be indices of the {len(points)} points')
    if samples < 1:
        raise InputError(f'samples must be at least 1, not {samples!r}')
    return points, starts, members
