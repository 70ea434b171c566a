"""Where the sensor is relative to where it started: each frame against the last few that differ."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from csgm_ros.tracking import surface
from csgm_ros.tracking.alignment import align, align_each
from csgm_ros.tracking.frames import Frame
from csgm_ros.tracking.surface import Surface
from csgm_ros.types import rotation_angle

KEPT = 25  # key frames in the model
POINTS, COARSE_POINTS = 2500, 500
FITS, SUDDEN = 0.35, 0.5  # share of a frame that must be on the model; of that of the last frame: else it was carried


class Keyframe(NamedTuple):
    """A frame that stays in the model: points and normals (N, 3) in the odometry frame, and the pose there."""

    points: np.ndarray
    normals: np.ndarray
    matrix: np.ndarray


class Odometry:
    """Frame-to-model odometry in metres.

    Parameters
    ----------
    voxel : float
        Edge of the frames' fine voxels, metres.

    Attributes
    ----------
    matrix : (4, 4) ndarray
        Rigid pose of the last frame in the odometry frame.
    quality : float
        Share of the last frame's points on the model.
    keyframes : deque of Keyframe
    model : tuple of Surface
        What the next frame is laid on, coarse to fine.
    """

    def __init__(self, voxel: float, rng: np.random.Generator):
        self._voxel, self._rng = voxel, rng
        self.keyframes: deque[Keyframe] = deque(maxlen=KEPT)
        self.model: tuple[Surface, ...] = ()
        self._pose: np.ndarray | None = None  # that was given with the last frame
        self.matrix, self.quality, self._stamp = np.eye(4), 0.0, 0.0
        self._velocity = np.eye(4)  # motion of the last interval, in the sensor's frame
        self._interval = 0.0

    def add(self, frame: Frame, stamp: float, *, pose: np.ndarray | None = None) -> bool:
        """Place the next frame; False, and nothing changed, where it does not fit.

        ``pose`` is the rigid (4, 4) pose of the sensor in a frame of somebody else's, such as wheel odometry.
        """
        motion = None if pose is None or self._pose is None else np.linalg.inv(self._pose) @ pose
        self._pose = pose
        if not self.model:
            self._keep(frame)
            self._stamp, self.quality = stamp, 1.0
            return True
        interval = stamp - self._stamp
        drawn = self._rng.permutation(len(frame.points))
        few, many = (frame.chosen(np.sort(drawn[:count])) for count in (COARSE_POINTS, POINTS))
        starts = self._starts(interval, motion)
        found = scores = None
        coarse, middle, fine = self.model
        found, scores = align_each(*few, coarse, starts, (coarse.voxel, 0.7 * coarse.voxel), iterations=8)
        found, scores = align_each(*few, middle, found, (middle.voxel,), iterations=8)
        fit = align(*many, fine, found[np.argmax(scores)], (1.5 * self._voxel, self._voxel))
        least, self.quality = max(FITS, SUDDEN * self.quality), fit.inliers
        if fit.inliers < least:
            return False
        moved = np.linalg.inv(self.matrix) @ fit.matrix
        self._velocity, self._interval = moved, interval
        self.matrix, self._stamp, self.fit = fit.matrix, stamp, fit
        if self._differs(frame, fit):
            self._keep(frame)
        return True

    def _starts(self, interval: float, motion: np.ndarray | None) -> np.ndarray:
        if motion is not None:
            return (self.matrix @ motion)[None]
        ahead = power(self._velocity, interval / self._interval) if self._interval > 0 else np.eye(4)
        starts = [self.matrix @ ahead, self.matrix]
        for axis in range(3):
            for angle in (-0.14, 0.14):
                starts.append(self.matrix @ ahead @ turned(axis, angle))
        return np.stack(starts)

    def _differs(self, frame: Frame, fit) -> bool:
        last = np.linalg.inv(self.keyframes[-1].matrix) @ fit.matrix
        shift = np.linalg.norm(last[:3, 3])
        return rotation_angle(last[:3, :3]) > 0.1 or shift > 5 * self._voxel or fit.inliers < 0.6

    def _keep(self, frame: Frame) -> None:
        turn, shift = self.matrix[:3, :3].T, self.matrix[:3, 3]
        self.keyframes.append(Keyframe(frame.points @ turn + shift, frame.normals @ turn, self.matrix.copy()))
        points = np.concatenate([kept.points for kept in self.keyframes])
        normals = np.concatenate([kept.normals for kept in self.keyframes])
        fine = surface.build(points, normals, 1.5 * self._voxel)
        middle = surface.build(fine.points, fine.normals, 4 * self._voxel)
        self.model = surface.build(middle.points, middle.normals, 10 * self._voxel), middle, fine


def power(matrix: np.ndarray, exponent: float) -> np.ndarray:
    """Return a rigid (4, 4) motion carried on for ``exponent`` times its time."""
    from scipy.spatial.transform import Rotation

    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(exponent * Rotation.from_matrix(matrix[:3, :3]).as_rotvec()).as_matrix()
    out[:3, 3] = exponent * matrix[:3, 3]
    return out


def between(first: np.ndarray, second: np.ndarray, share: float) -> np.ndarray:
    """Return a similarity (4, 4) a share of the way from one to another of about the same scale."""
    return first @ power(np.linalg.inv(first) @ second, share)


def turned(axis: int, angle: float) -> np.ndarray:
    """Return a rotation about an axis of the frame as (4, 4)."""
    from scipy.spatial.transform import Rotation

    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(angle * np.eye(3)[axis]).as_matrix()
    return out
