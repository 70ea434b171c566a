"""A table top in a room: most of the room is below it, and nothing but what stands on it is in the part."""

import numpy as np
import pytest
from scenes import box, rectangle
from scipy.spatial.transform import Rotation

from csgm_ros.transform.ladder import Ladder
from csgm_ros.transform.parts import faces
from csgm_ros.transform.planes import STARTS, candidates, dominant
from csgm_ros.types import Similarity

TOP, LOW, HIGH = 0.8, np.array([3.0, 2.0]), np.array([5.4, 3.6])


def room(seed):
    """A floor of 8 by 6 m, two walls, and a table with things on it, sampled anew by every seed."""
    shapes, rng = np.random.default_rng(5), np.random.default_rng(seed)
    parts = [
        rectangle(rng, (0, 0, 0), (8, 0, 0), (0, 6, 0), 1250),
        rectangle(rng, (0, 0, 0), (8, 0, 0), (0, 0, 1.5), 1670),
        rectangle(rng, (0, 0, 0), (0, 6, 0), (0, 0, 1.5), 1670),
        rectangle(rng, (*LOW, TOP), (HIGH[0] - LOW[0], 0, 0), (0, HIGH[1] - LOW[1], 0), 3120),
    ]
    for _ in range(12):
        size = shapes.uniform(0.1, 0.45, 3)
        corner = np.append(shapes.uniform(LOW + 0.2, HIGH - 0.2) - size[:2] / 2, TOP)
        parts.append(box(rng, corner, size, 2000))
    return np.concatenate(parts) + rng.normal(0, 0.004, (sum(map(len, parts)), 3))


def table(points):
    inside = ((points[:, :2] > LOW + 0.1) & (points[:, :2] < HIGH - 0.1)).all(1)
    return points[inside & (points[:, 2] > TOP - 0.03)]


def tops(planes):
    return [plane for plane in planes if abs(plane.point[2] - TOP) < 0.05 and plane.normal[2] > 0.99]


def test_faces_are_those_that_are_not_dominant_and_either_way_up():
    whole = Ladder(table(room(1)), room(2), 0).flights[0].rung(1.0)
    assert not tops(dominant(whole))
    assert len(tops(faces(whole))) == 1
    floors = [plane.normal[2] for plane in faces(whole) if abs(plane.point[2]) < 0.05 and abs(plane.normal[2]) > 0.99]
    assert len(floors) == 1
    assert floors[0] < 0.0  # the other one is dominant


@pytest.mark.parametrize('scale', [1.0, 0.3])
def test_a_table_top_is_found_in_a_room(scale):
    truth = Similarity(scale, Rotation.from_euler('xyz', (40, -70, 110), degrees=True).as_matrix(), np.ones(3))
    ladder = Ladder(truth.inverse().apply(table(room(1))), room(2), 0)
    given = scale == 1.0
    scales = np.ones(1) if given else scale * np.exp(np.arange(-1.03, 1.0, 0.1))
    found = ladder.best(candidates(ladder, scales, STARTS, faces), estimate_scale=not given, every_kind=True)
    best = Similarity.from_matrix(found[0])
    assert best.displacement(truth, ladder.flights[0].part.points) < 0.05
