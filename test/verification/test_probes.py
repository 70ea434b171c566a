"""What is tried on purpose once there is a winner."""

import numpy as np
from scenes import random_rotation

from csgm_ros.verification.probes import mirrors, symmetries

STAY = np.eye(4)


def wall(rng, tilt):
    """A wall 3 by 1, its normals spread in two directions that its edges are not, and its edges."""
    turn = random_rotation(rng)
    points = rng.uniform(-0.5, 0.5, (500, 3)) * (3.0, 1.0, 0.001)
    spread = rng.normal(size=(500, 2)) * (0.2, 0.3)
    lean = np.array([[np.cos(tilt), -np.sin(tilt)], [np.sin(tilt), np.cos(tilt)]])
    normals = np.column_stack([spread @ lean.T, np.ones(500)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return points @ turn.T, normals @ turn.T, turn[:, :2].T


def test_a_wall_is_slid_along_its_edges_whatever_its_roughness_faces():
    rng = np.random.default_rng(0)
    for tilt in np.radians((0.0, 13.0, 30.0, 45.0)):
        points, normals, edges = wall(rng, tilt)
        moved = symmetries(STAY, points, normals, np.ones(len(points)))
        slides = np.array([m[:3, 3] for m in moved if np.allclose(m[:3, :3], np.eye(3))])
        directions = slides / np.linalg.norm(slides, axis=1, keepdims=True)
        for edge in edges:
            assert np.abs(directions @ edge).max() > np.cos(np.radians(6.0))


def test_parallel_mirrors_are_apart():
    rng = np.random.default_rng(1)
    points, normals, _ = wall(rng, 0.3)
    clouds = points + np.array((0.01, 0.0, 0.0)), points + np.array((0.5, 0.0, 0.0))
    both = [mirrors(STAY, points, normals, np.ones(len(points)), clouds, apart) for apart in (0.0, 0.05)]
    assert len(both[0]) == 3 * len({tuple(np.round(m[:3, :3].ravel(), 9)) for m in both[0]})
    assert len(both[1]) < len(both[0]) - 90  # the two near ones are one, in all directions
    for number, change in enumerate(both[1]):
        parallel = [m for m in both[1][:number] if np.allclose(m[:3, :3], change[:3, :3])]
        assert all(np.linalg.norm(m[:3, 3] - change[:3, 3]) > 0.1 for m in parallel)
