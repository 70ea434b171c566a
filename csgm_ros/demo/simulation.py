"""A simulated Kinect and a simulated SfM reconstruction of one room, with the transform between them known."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from csgm_ros.demo.scene import Hits, Room
from csgm_ros.errors import InputError
from csgm_ros.io.atomic import write_text
from csgm_ros.io.files import write_cloud
from csgm_ros.types import Cloud, Similarity

HEIGHT, WIDTH = 480, 640
FOCAL = 525.0 / 640  # of a Kinect, relative to the width


@dataclass(frozen=True, eq=False)
class SimulatedPair:
    """Two clouds of one place and the truth.

    Attributes
    ----------
    source : (N, 3) ndarray
        SfM points, in a unit and pose of their own.
    source_colors : (N, 3) ndarray
        In [0, 1].
    target : (H, W, 3) float32 ndarray
        One organised Kinect frame, metres, optical frame (z forward); NaN where no depth came back.
    target_colors : (H, W, 3) ndarray
        In [0, 1].
    truth : Similarity
        ``x_target = s R x_source + t``.
    """

    source: np.ndarray
    source_colors: np.ndarray
    target: np.ndarray
    target_colors: np.ndarray
    truth: Similarity


def simulate(seed: int = 0, *, height: int = HEIGHT, width: int = WIDTH, sfm_points: int = 40000) -> SimulatedPair:
    """Build a room and let both sensors see it.

    Parameters
    ----------
    seed : int
        The same seed gives the same room and the same noise.
    height, width : int
        Pixels of the Kinect frame.
    sfm_points : int
        Points of the SfM cloud, at most.

    Returns
    -------
    SimulatedPair
    """
    rng = np.random.default_rng(seed)
    room = Room(rng)
    pose = look_at(np.array([1.45, -2.45, 1.7]) + rng.uniform(-0.15, 0.15, 3), np.array([-0.1, 0.75, 0.75]))
    target, target_colors = kinect_frame(room, pose, rng, height, width)
    points, source_colors = sfm_cloud(room, rng, sfm_points)
    gauge = random_similarity(rng)
    source = gauge.apply(points)
    truth = Similarity(1.0, pose.rotation.T, -pose.rotation.T @ pose.translation) @ gauge.inverse()
    return SimulatedPair(source, source_colors, target, target_colors, truth)


def write_pair(folder: str | Path, seed: int = 0) -> None:
    """Write `kinect.ply`, `sfm.ply` and `truth.json` of :func:`simulate` into a folder, made when missing.

    Raises
    ------
    InputError
        Where the folder cannot be made or written to.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f'{folder}: cannot be made ({error.strerror}); choose another place') from None
    pair = simulate(seed)
    seen = np.isfinite(pair.target).all(axis=2)
    write_cloud(folder / 'kinect.ply', pair.target[seen], pair.target_colors[seen])
    write_cloud(folder / 'sfm.ply', pair.source, pair.source_colors)
    write_text(folder / 'truth.json', json.dumps({'T_target_source': pair.truth.matrix.tolist()}, indent=2) + '\n')


def recording(pair: SimulatedPair, frames: int = 10) -> list[tuple[str, Cloud]]:
    """Return the pair as stamped messages: the map once on /source, then the frame on /target at 10 Hz."""

    def message(points: np.ndarray, colors: np.ndarray, frame_id: str, seconds: float) -> Cloud:
        return Cloud(points, (255 * colors).round().astype(np.uint8), frame_id, int(1e9 * seconds))

    sfm = message(pair.source, pair.source_colors, 'sfm', 1.0)
    kinect = [
        message(pair.target, pair.target_colors, 'camera_depth_optical_frame', 1.0 + i / 10) for i in range(frames)
    ]
    return [('/source', sfm), *(('/target', frame) for frame in kinect)]


def kinect_frame(
    room: Room, pose: Similarity, rng: np.random.Generator, height: int = HEIGHT, width: int = WIDTH
) -> tuple[np.ndarray, np.ndarray]:
    """Return one organised depth frame (H, W, 3) float32 in the optical frame, and its colours (H, W, 3).

    Noise grows with the square of the range, as disparity is what a Kinect measures; depth is lost at grazing angles,
    on dark surfaces, beside occluding edges (the projector's shadow) and beyond 5 m.

    Parameters
    ----------
    room : Room
    pose : Similarity
        From the optical frame to the room, scale 1.
    rng : numpy.random.Generator
    height, width : int
    """
    rays = pixel_rays(height, width)
    directions = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    origins = np.broadcast_to(pose.translation, directions.shape)
    hits = room.cast(origins, directions @ pose.rotation.T)
    depth = hits.distance * directions[:, 2]
    noisy = depth + rng.normal(0, 1, len(depth)) * (0.001 + 0.0019 * np.square(np.nan_to_num(depth) - 0.4))
    step = np.maximum(0.0028 * np.square(np.nan_to_num(depth)), 1e-4)  # one step of the disparity
    noisy = np.round(noisy / step) * step
    lost = rng.uniform(0, 1, len(depth)) > room.reflectance(hits) * np.clip(hits.cosine / 0.25, 0, 1)
    lost |= (hits.cosine < 0.1) | ~(depth < 5.0) | (depth < 0.5) | _in_shadow(room, hits, pose)
    points = np.where(lost[:, None], np.nan, rays * noisy[:, None]).astype(np.float32)
    return points.reshape(height, width, 3), room.colors(hits).reshape(height, width, 3)


def sfm_cloud(room: Room, rng: np.random.Generator, points: int = 40000) -> tuple[np.ndarray, np.ndarray]:
    """Return an SfM reconstruction (N, 3) in the room's frame, metres, and its colours (N, 3).

    Points lie where a colour camera found texture, with noise along the line of sight that grows with the square of
    the range, gaps where nothing was matched, and outliers on wrong matches.
    """
    found, colors = [], []
    cameras = 24
    for angle in np.linspace(-0.75, 0.45, cameras):
        eye = np.array([2.9 * np.sin(-angle) * 0.8, -2.5 + 0.35 * np.cos(3 * angle), 1.5 + 0.25 * np.sin(5 * angle)])
        pose = look_at(eye, np.array([0.0, 0.8, 0.75]) + rng.uniform(-0.25, 0.25, 3))
        hits = _random_view(room, pose, rng, 4 * points // cameras)
        keep = room.texture(hits) & (hits.cosine > 0.2)
        sight = hits.points[keep] - pose.translation
        along = rng.normal(0, 1, len(sight)) * 0.0022 * np.square(hits.distance[keep])
        outlier = rng.uniform(0, 1, len(sight)) < 0.03
        along = np.where(outlier, rng.normal(0, 0.35, len(sight)), along) / hits.distance[keep]
        found.append(hits.points[keep] + sight * along[:, None] + rng.normal(0, 0.003, sight.shape))
        colors.append(room.colors(hits)[keep])
    points_found, colors_found = np.concatenate(found), np.concatenate(colors)
    centers = points_found[rng.integers(0, len(points_found), 14)]
    gaps = np.linalg.norm(points_found[:, None] - centers, axis=2) < rng.uniform(0.08, 0.22, 14)
    kept = np.flatnonzero(~gaps.any(axis=1))
    kept = np.sort(rng.permutation(kept)[:points])
    return points_found[kept], colors_found[kept]


def look_at(eye: np.ndarray, at: np.ndarray) -> Similarity:
    """Return the pose (optical frame to room, z forward, y down) of a camera at ``eye`` that looks at ``at``."""
    forward = (at - eye) / np.linalg.norm(at - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return Similarity(1.0, np.stack([right, np.cross(forward, right), forward], axis=1), np.asarray(eye, float))


def pixel_rays(height: int, width: int) -> np.ndarray:
    """Return (H * W, 3) rays of a pinhole camera in the optical frame, each with z = 1."""
    v, u = np.mgrid[:height, :width]
    focal = FOCAL * width
    x, y = (u - (width - 1) / 2) / focal, (v - (height - 1) / 2) / focal
    return np.stack([x, y, np.ones_like(x)], axis=2).reshape(-1, 3)


def random_similarity(rng: np.random.Generator) -> Similarity:
    """Draw a rotation about any axis, a translation and a scale between 1/20 and 20: the gauge of an SfM cloud."""
    w, *axis = rng.normal(size=4)
    scale = float(np.exp(rng.uniform(-np.log(20), np.log(20))))
    return Similarity.from_quaternion(np.array([*axis, w]), rng.normal(0, 10, 3), scale)


def _random_view(room: Room, pose: Similarity, rng: np.random.Generator, rays: int) -> Hits:
    """Cast rays through random pixels of a wide colour camera."""
    pixels = np.column_stack([rng.uniform((-0.75, -0.55), (0.75, 0.55), (rays, 2)), np.ones(rays)])
    directions = pixels / np.linalg.norm(pixels, axis=1, keepdims=True)
    return room.cast(np.broadcast_to(pose.translation, directions.shape), directions @ pose.rotation.T)


def _in_shadow(room: Room, hits: Hits, pose: Similarity) -> np.ndarray:
    """Return (N,) booleans: the projector, 7.5 cm beside the camera, does not reach the point."""
    projector = pose.translation + 0.075 * pose.rotation[:, 0]
    there = hits.material >= 0
    sight = np.nan_to_num(hits.points, nan=1.0) - projector
    distance = np.linalg.norm(sight, axis=1)
    lit = room.cast(np.broadcast_to(projector, sight.shape), sight / distance[:, None])
    return there & (lit.distance < distance - 0.02)
