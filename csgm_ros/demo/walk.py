"""A simulated depth sensor that is carried through the simulated room, and the map that photos of the room gave."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from csgm_ros.demo.scene import Room
from csgm_ros.demo.simulation import kinect_frame, look_at, random_similarity, sfm_cloud
from csgm_ros.types import Similarity

RATE = 7.5  # frames a second
SECONDS = 24.0
BLOCKED = 9.0, 10.5  # a hand before the sensor
KIDNAPPED = 15.0, 3.0  # when, and for how long nothing is seen
HEIGHT, WIDTH = 180, 240
MAP_POINTS = 60000


@dataclass(frozen=True, eq=False)
class Walk:
    """What a sensor saw, and the truth.

    Attributes
    ----------
    map_points : (M, 3) ndarray
        In a unit and pose of their own.
    stamps : (F,) ndarray
        Seconds.
    frames : (F, H, W, 3) float32 ndarray
        Metres in the optical frame; NaN where nothing came back.
    truth : list of Similarity
        From each frame to the map.
    blocked : (F,) bool ndarray
        Frames without a return.
    gauge : Similarity
        From the room, in metres, to the map.
    """

    map_points: np.ndarray
    stamps: np.ndarray
    frames: np.ndarray
    truth: list[Similarity]
    blocked: np.ndarray
    gauge: Similarity

    @property
    def interruptions(self) -> dict[str, float]:
        """When the sensor sees again, after what."""
        ends = {'blocked': BLOCKED[1], 'kidnapped': sum(KIDNAPPED)}
        return {what: end for what, end in ends.items() if end + 5.0 < self.stamps[-1]}


def walk(seed: int = 0, *, seconds: float = SECONDS) -> Walk:
    """Carry a sensor through the room, blocked for a while and later put elsewhere while nobody looks."""
    rng = np.random.default_rng(seed)
    room = Room(rng)
    points, _ = sfm_cloud(room, rng, MAP_POINTS)
    gauge = random_similarity(rng)
    start, pause = KIDNAPPED
    times = np.arange(0.0, seconds, 1.0 / RATE)
    times = times[(times < start) | (times >= start + pause)]
    blocked = (times >= BLOCKED[0]) & (times < BLOCKED[1])
    frames, truth = np.full((len(times), HEIGHT, WIDTH, 3), np.nan, np.float32), []
    for number, time in enumerate(times):
        pose = carried(time)
        truth.append(gauge @ pose)
        if not blocked[number]:
            frames[number] = kinect_frame(room, pose, rng, HEIGHT, WIDTH)[0]
    return Walk(gauge.apply(points), times, frames, truth, blocked, gauge)


def carried(time: float) -> Similarity:
    """Return where the sensor is: on an arc before the furniture, from the other side once it was kidnapped."""
    phase = 0.22 * time if time < KIDNAPPED[0] else 1.2 - 0.22 * (time - KIDNAPPED[0] - KIDNAPPED[1])
    eye = (-1.3 + 0.75 * phase, -1.9 + 0.25 * np.sin(1.3 * phase), 1.35 + 0.12 * np.sin(2.1 * phase))
    at = (0.9 * np.sin(0.8 * phase - 0.9), 0.9, 0.7 + 0.1 * np.sin(1.7 * phase))
    return look_at(np.array(eye), np.array(at))
