"""How far clouds agree, compared over scales."""

import numpy as np
from scipy.spatial.transform import Rotation
from test_planes import hall, view

from csgm_ros.transform.ladder import Ladder


def test_chance_agrees_no_better_at_a_large_scale():
    source, target = view(hall(1)), hall(2)
    ladder, rng = Ladder(source, target, 0), np.random.default_rng(0)
    middle = source.mean(0) * (1.0, 1.0, 0.0)
    chance = []
    for scale in (1.0, 4.0):
        placed = np.tile(np.eye(4), (40, 1, 1))
        placed[:, :3, :3] = scale * Rotation.from_euler('z', rng.uniform(0.0, 2 * np.pi, (40, 1))).as_matrix()
        placed[:, :3, 3] = np.pad(rng.uniform((2, 2), (10, 7), (40, 2)), ((0, 0), (0, 1)))
        placed[:, :3, 3] -= placed[:, :3, :3] @ middle
        chance.append(ladder.scores(placed).mean())
    assert chance[1] < chance[0]
