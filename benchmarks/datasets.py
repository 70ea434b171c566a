"""Pairs of clouds with exact ground truth, made by the paper's recipes or read from ``$CSGM_SHARED``.

Every pair keeps one direction: ``T_target_source`` moves ``source`` onto ``target``.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, cKDTree
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from benchmarks.meshes import Mesh, random_rotation, shared_folder
from csgm_ros.cloud.voxels import voxel_means
from csgm_ros.io.files import read_cloud


@dataclass(frozen=True, eq=False)
class Pair:
    """Two clouds and how they belong together.

    Attributes
    ----------
    name : str
        Where it comes from, with the seed; unique within a benchmark.
    source, target : (N, 3), (M, 3) float64 ndarray
        The clouds, each in its own unit and frame.
    T_target_source : (4, 4) ndarray or None
        The true similarity; None where the clouds show different things.
    clean_source : (K, 3) ndarray
        Source points without noise, outliers or clutter: what the error is measured on.
    kind : str
        ``synthetic`` (error relative to the radius), ``real`` (metres) or ``place`` (metres, more for a large source).
    metre : float
        Target units a metre.
    """

    name: str
    source: np.ndarray
    target: np.ndarray
    T_target_source: np.ndarray | None
    clean_source: np.ndarray
    kind: str = 'synthetic'
    metre: float = 1.0


def similarity(scale: float, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Return the homogeneous (4, 4) matrix of ``x -> scale * rotation @ x + translation``."""
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation
    matrix[:3, 3] = translation
    return matrix


def apply(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Move (N, 3) points by a homogeneous (4, 4) matrix."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def diameter(points: np.ndarray) -> float:
    """Return the largest distance between two of (N, 3) points."""
    return float(pdist(points[ConvexHull(points).vertices]).max())


def database_c(
    mesh_vertices: np.ndarray,
    mesh_triangles: np.ndarray,
    rng: np.random.Generator,
    *,
    separation_deg: float = 60.0,
    keep_every: float = 3.0,
    holes: int = 10,
    scale_range: tuple[float, float] = (3.0, 5.0),
    rotation_deg: tuple[float, float] | None = (30.0, 60.0),
    noise_db: float = 40.0,
    outlier_share: float = 0.3,
    outlier_offset: float = 0.01,
    clutter_share: float = 0.0,
    name: str = 'database_c',
) -> Pair:
    """Make a cross-source pair as the paper's Database C (Sec. IV-A, steps 1 to 4).

    Where the text is silent: the second view is turned by plus or minus ``separation_deg``, drawn; the ten
    deleted parts are discs in the view plane, with a radius of 5 % of the diameter, around random points; the
    noise's variance is the mean variance per axis over ``10 ** (noise_db / 10)``.

    Parameters
    ----------
    mesh_vertices, mesh_triangles : (N, 3), (M, 3) ndarray
        The object, centred; triangle centres are added as points.
    rng : Generator
        All randomness comes from here.
    separation_deg : float
        Angle between the two views about y.
    keep_every : float
        The second view keeps one of so many points; below 1 the *first* view is thinned by the inverse.
    holes : int
        Discs removed from the second view.
    scale_range : (float, float)
        Source units per target unit, drawn log-uniformly when the range spans over a factor of 10.
    rotation_deg : (float, float) or None
        Range of the angles about x, y and z; None for any rotation.
    noise_db : float
        Signal-to-noise ratio of the second view; inf for none.
    outlier_share, outlier_offset : float
        Share of the points that occur once more with a random offset of up to this share of the diameter.
    clutter_share : float
        Share of the final source that is uniform in the ball around it: not in the paper.

    Returns
    -------
    Pair
        Source: second view, target: first view, with the exact similarity between them.
    """
    points = np.concatenate([mesh_vertices, mesh_vertices[mesh_triangles].mean(axis=1)])
    target = points[points[:, 2] >= 0]
    view = Rotation.from_euler('y', rng.choice([-1, 1]) * separation_deg, degrees=True).as_matrix()
    clean = points @ view.T
    clean = clean[_every(len(clean), keep_every)]
    target = target[_every(len(target), 1 / keep_every)]
    clean = _with_holes(clean[clean[:, 2] > 0], holes, 0.05 * diameter(points), rng)

    pose = _random_similarity(diameter(points), scale_range, rotation_deg, rng)
    clean = apply(pose, clean)
    size = diameter(clean)
    noisy = clean + rng.normal(size=clean.shape) * np.sqrt(clean.var(axis=0).mean() / 10 ** (noise_db / 10))
    twice = rng.choice(len(clean), round(outlier_share * len(clean)), replace=False)
    outliers = clean[twice] + _directions(len(twice), rng) * rng.uniform(0, outlier_offset * size, (len(twice), 1))
    source = np.concatenate([noisy, outliers])
    source = np.concatenate([source, _clutter(source, clutter_share, rng)])
    return Pair(name, source, target, np.linalg.inv(pose @ similarity(1.0, view, np.zeros(3))), clean)


def same_source(
    vertices: np.ndarray,
    rng: np.random.Generator,
    *,
    angle_deg: float,
    snr_db: float,
    outlier_share: float,
    points: int = 2000,
    name: str = 'same_source',
) -> Pair:
    """Make two half views of one object, as the paper's same-source protocol (Sec. IV-B, after JR-MPC).

    Each view is the object turned in the xz-plane with the points of negative z rejected, thinned to ``points``,
    with noise at ``snr_db`` and outliers uniform around five random points of the view. Where the text is silent:
    the two views draw their points independently; the outliers lie in balls of a quarter of the view's radius;
    ``outlier_share`` is relative to the inliers. The object is scaled to radius 1 first. The unit is shared.
    """
    centred = vertices - vertices.mean(axis=0)
    centred /= np.linalg.norm(centred, axis=1).max()
    rotation = Rotation.from_euler('y', angle_deg, degrees=True).as_matrix()
    target_clean = _half_view(centred, points, rng)
    source_clean = _half_view(centred @ rotation.T, points, rng)
    target = _noisy_view(target_clean, snr_db, outlier_share, rng)
    source = _noisy_view(source_clean, snr_db, outlier_share, rng)
    return Pair(name, source, target, similarity(1.0, rotation.T, np.zeros(3)), source_clean)


def real_names() -> tuple[str, ...]:
    """Return the names of the real Kinect and SfM pairs at hand; empty without ``$CSGM_SHARED``."""
    folder = shared_folder()
    return tuple(sorted(path.parent.name for path in folder.glob('data/kinect_sfm/*/gt.json'))) if folder else ()


def real_pair(name: str) -> Pair:
    """Read a real pair of ``$CSGM_SHARED/data/kinect_sfm``: the SfM cloud to the Kinect cloud in metres."""
    folder = shared_folder() / 'data' / 'kinect_sfm' / name
    source, target = (read_cloud(folder / file).points for file in ('sfm.ply', 'kinect.ply'))
    truth = np.array(json.loads((folder / 'gt.json').read_text())['sfm_to_kinect'])
    return Pair(name, source, target, truth, source, kind='real')


def place_names() -> tuple[str, ...]:
    """Return the names of the pairs of other places and sensors at hand; empty without ``$CSGM_SHARED``."""
    folder = shared_folder()
    return tuple(sorted(path.parent.name for path in folder.glob('data/places/*/gt.json'))) if folder else ()


def place_pair(name: str) -> Pair:
    """Read a pair of ``$CSGM_SHARED/data/places``; the target is in metres."""
    folder = shared_folder() / 'data' / 'places' / name
    source, target = (read_cloud(folder / file).points for file in ('source.ply', 'target.ply'))
    truth = np.array(json.loads((folder / 'gt.json').read_text())['T_target_source'])
    return Pair(name, source, target, truth, source, kind='place')


def frame_pair(sequence: str, number: int) -> Pair:
    """Read a depth frame of ``$CSGM_SHARED/data/sequence_SEQUENCE`` (source, metres) and its SfM map (target)."""
    folder = shared_folder() / 'data' / f'sequence_{sequence}'
    with np.load(folder / 'frames.npz') as data:
        depth, camera, truth = data['depth'][number] / 1000.0, data['K'], data['T_map_camera'][number]
    rows, columns = np.nonzero(depth)
    z = depth[rows, columns]
    source = np.column_stack([(columns - camera[0, 2]) * z / camera[0, 0], (rows - camera[1, 2]) * z / camera[1, 1], z])
    metre = float(np.cbrt(np.linalg.det(truth[:3, :3])))
    name = f'{sequence}_{number:03d}'
    return Pair(name, source, read_cloud(folder / 'map.ply').points, truth, source, 'place', metre)


def frame_numbers(sequence: str) -> np.ndarray:
    """Return the frames of a sequence that lie on its map: state 1."""
    with np.load(shared_folder() / 'data' / f'sequence_{sequence}' / 'frames.npz') as data:
        return np.flatnonzero(data['state'] == 1)


def swapped(pair: Pair) -> Pair:
    """Return the pair with source and target exchanged."""
    truth = np.linalg.inv(pair.T_target_source)
    metre = pair.metre * float(np.cbrt(np.linalg.det(truth[:3, :3])))
    return Pair(f'{pair.name}-swapped', pair.target, pair.source, truth, pair.target, pair.kind, metre)


def shared_unit(pair: Pair) -> Pair:
    """Return the pair with its source in the target's unit: the scale is given, and 1."""
    scale = float(np.cbrt(np.linalg.det(pair.T_target_source[:3, :3])))
    truth = pair.T_target_source @ np.diag([1 / scale] * 3 + [1.0])
    return dataclasses.replace(
        pair, source=scale * pair.source, clean_source=scale * pair.clean_source, T_target_source=truth
    )


def part(pair: Pair, rng: np.random.Generator, *, share: tuple[float, float] = (0.05, 0.2)) -> Pair:
    """Return the pair with a source cut to a ball: a small view in a large map.

    Parameters
    ----------
    pair : Pair
        With a truth.
    rng : Generator
        Draws the ball's centre, on the truly placed source, and its size.
    share : (float, float)
        Bounds of the share of the target's surface that lies on the part, counted in cells of a hundredth of the
        target's extent.

    Raises
    ------
    ValueError
        If no ball in 200 has such an overlap.
    """
    size = np.ptp(pair.target, axis=0).max() / 100
    cells = voxel_means(pair.target, size)
    placed = apply(pair.T_target_source, pair.source)
    on_source = np.isfinite(cKDTree(voxel_means(placed, size)).query(cells, distance_upper_bound=2 * size)[0])
    overlap, count = cells[on_source], on_source.sum()
    for _ in range(200):
        wanted = rng.uniform(*share) * len(cells)
        if wanted >= count:
            continue
        centre = overlap[rng.integers(count)]
        reach = np.partition(np.linalg.norm(overlap - centre, axis=1), int(wanted))[int(wanted)]
        inside = np.linalg.norm(placed - centre, axis=1) <= reach
        if inside.sum() >= 1000:
            source = pair.source[inside]
            return dataclasses.replace(pair, name=f'{pair.name}-part', source=source, clean_source=source)
    raise ValueError(f'{pair.name}: no part overlaps with {share[0]:.0%} to {share[1]:.0%} of the target')


def unrelated(source: Pair, target: Pair) -> Pair:
    """Pair one pair's source with another's target. The caller answers for the two showing different things."""
    return Pair(f'{source.name}|{target.name}', source.source, target.target, None, source.clean_source, source.kind)


def overlaps(pair: Pair, target: np.ndarray, reach: float) -> tuple[float, float]:
    """Return the shares of the truly placed source, and of a target in its frame, that lie within ``reach`` (its unit).

    One of ten points is looked at.
    """
    clouds = apply(pair.T_target_source, pair.clean_source)[::10], target[::10]
    distances = [
        cKDTree(other).query(cloud, distance_upper_bound=reach)[0] for cloud, other in (clouds, reversed(clouds))
    ]
    return float(np.isfinite(distances[0]).mean()), float(np.isfinite(distances[1]).mean())


def moved(pair: Pair, rng: np.random.Generator, *, scale_range: tuple[float, float] = (0.05, 20.0)) -> Pair:
    """Return the pair with its source in another random pose and unit, and in another order."""
    scale = np.exp(rng.uniform(*np.log(scale_range)))
    pose = similarity(scale, random_rotation(rng), rng.normal(size=3) * scale)
    source = apply(pose, pair.source)[rng.permutation(len(pair.source))]
    truth = pair.T_target_source @ np.linalg.inv(pose)
    clean = apply(pose, pair.clean_source)
    return dataclasses.replace(pair, source=source, T_target_source=truth, clean_source=clean)


def database_c_pair(mesh: Mesh, seed: int, **options) -> Pair:
    """Return :func:`database_c` of a mesh with a seed of its own: the same for the same mesh, seed and options."""
    rng = np.random.default_rng([seed, *mesh.name.encode()])
    return database_c(mesh.vertices, mesh.triangles, rng, name=f'{mesh.name}-{seed}', **options)


def _every(count: int, step: float) -> np.ndarray:
    """Indices of every ``step``-th of ``count`` points, ``step`` not necessarily whole; all of them below 1."""
    return np.arange(0, count, max(step, 1.0)).astype(np.int64)


def _with_holes(points: np.ndarray, count: int, radius: float, rng: np.random.Generator) -> np.ndarray:
    centres = points[rng.choice(len(points), count, replace=False), :2]
    distance = np.linalg.norm(points[:, None, :2] - centres, axis=2) if count else np.full((len(points), 1), np.inf)
    return points[(distance > radius).all(axis=1)]


def _random_similarity(size: float, scale_range, rotation_deg, rng: np.random.Generator) -> np.ndarray:
    low, high = scale_range
    scale = np.exp(rng.uniform(np.log(low), np.log(high))) if high > 10 * low else rng.uniform(low, high)
    if rotation_deg is None:
        rotation = random_rotation(rng)
    else:
        rotation = Rotation.from_euler('xyz', rng.uniform(*rotation_deg, 3), degrees=True).as_matrix()
    return similarity(scale, rotation, [0.0, 0.0, scale * rng.uniform(0, 0.5) * size])


def _directions(count: int, rng: np.random.Generator) -> np.ndarray:
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _clutter(points: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """Points uniform in the ball around a cloud, so many that they are ``share`` of both together."""
    count = round(len(points) * share / (1 - share))
    centre = points.mean(axis=0)
    radius = np.linalg.norm(points - centre, axis=1).max()
    return centre + _directions(count, rng) * radius * np.cbrt(rng.uniform(0, 1, (count, 1)))


def _half_view(points: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    visible = points[points[:, 2] >= 0]
    return visible[rng.choice(len(visible), min(count, len(visible)), replace=False)]


def _noisy_view(points: np.ndarray, snr_db: float, outlier_share: float, rng: np.random.Generator) -> np.ndarray:
    noisy = points + rng.normal(size=points.shape) * np.sqrt(points.var(axis=0).mean() / 10 ** (snr_db / 10))
    count = round(outlier_share * len(points))
    centres = points[rng.choice(len(points), 5)][rng.integers(0, 5, count)]
    radius = 0.25 * np.linalg.norm(points - points.mean(axis=0), axis=1).max()
    spread = _directions(count, rng) * radius * np.cbrt(rng.uniform(0, 1, (count, 1)))
    return np.concatenate([noisy, centres + spread])
