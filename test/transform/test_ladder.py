"""How far clouds agree, compared over scales."""

import numpy as np
from scipy.spatial.transform import Rotation
from test_planes import hall, view

from csgm_ros.transform.ladder import Ladder


def test_chance_agrees_with_little_at_any_scale():
    source, target = view(hall(1)), hall(2)
    ladder, rng = Ladder(source, target, 0), np.random.default_rng(0)
    middle = source.mean(0) * (1.0, 1.0, 0.0)
    right, chance = ladder.scores([np.eye(4)])[0], []
    for scale in (1.0, 4.0):
        placed = np.tile(np.eye(4), (40, 1, 1))
        placed[:, :3, :3] = scale * Rotation.from_euler('z', rng.uniform(0.0, 2 * np.pi, (40, 1))).as_matrix()
        placed[:, :3, 3] = np.pad(rng.uniform((2, 2), (10, 7), (40, 2)), ((0, 0), (0, 1)))
        placed[:, :3, 3] -= placed[:, :3, :3] @ middle
        chance.append(ladder.scores(placed).mean())
    assert max(chance) < 0.01 * right


def test_it_does_not_matter_which_is_called_the_source():
    source, target = view(hall(1)), hall(2)
    forth, back = Ladder(source, target, 0), Ladder(target, source, 0)
    transforms = np.array([np.diag([scale, scale, scale, 1.0]) for scale in (0.3, 1.0, 1.7, 4.0)])
    assert forth.flight(1.7)[1] is False  # the source is a part of the target at some of the scales, ...
    assert forth.flight(4.0)[1] is True  # ... and the target of the source at others
    np.testing.assert_allclose(forth.scores(transforms), back.scores(np.linalg.inv(transforms)))


def test_a_cloud_with_too_few_surfaces_in_its_cells_is_not_seen():
    few = hall(1)[:: len(hall(1)) // 40]
    assert Ladder(view(hall(1)), hall(2), 0).sees(1.0)
    assert not Ladder(few, hall(2), 0).sees(1.0)
