"""A recorded walk of a depth sensor through a map, with its true poses."""

import numpy as np

from csgm_ros.io.files import read_cloud
from csgm_ros.tracking.localization import moved
from csgm_ros.types import rotation_angle


class Sequence:
    def __init__(self, folder):
        with np.load(folder / 'frames.npz') as file:
            self.depth, self.stamps, self.truth, k = (file[n] for n in ('depth', 'stamp', 'T_map_camera', 'K'))
        self.map = read_cloud(folder / 'map.ply').points
        v, u = np.mgrid[: self.depth.shape[1], : self.depth.shape[2]]
        self._rays = np.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], np.ones(u.shape)], axis=-1)

    def points(self, number):
        return (self._rays * (self.depth[number][..., None] / 1000.0)).reshape(-1, 3)

    def right(self, number, matrix):
        """The rule of the data: 10 cm, 5 degrees, 6 %."""
        angle, shift, scale = self.errors(number, matrix)
        return shift < 0.1 and angle < 5 and abs(scale) < 0.06

    def errors(self, number, matrix):
        """Degrees, metres of mean displacement, relative scale."""
        truth, points = self.truth[number], self.points(number)
        scales = [np.cbrt(np.linalg.det(m[:3, :3])) for m in (matrix, truth)]
        turn = (matrix[:3, :3] / scales[0]) @ (truth[:3, :3] / scales[1]).T
        angle = np.degrees(rotation_angle(turn))
        shift = np.linalg.norm(moved(matrix, points) - moved(truth, points), axis=1).mean() / scales[1]
        return angle, shift, scales[0] / scales[1] - 1
