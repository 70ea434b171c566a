"""Clouds with a known truth for the tests: a scene without any symmetry, and shapes that are all symmetry."""

from __future__ import annotations

import numpy as np

from csgm_ros.types import Similarity


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Return a (3, 3) rotation, uniform over all rotations."""
    x, y, z, w = (q := rng.normal(size=4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def random_similarity(
    rng: np.random.Generator, scales: tuple[float, float] = (0.05, 20.0), offset: float = 1e3
) -> Similarity:
    """Return a rotation about a random axis, a scale drawn log-uniformly, and a translation ``offset`` long."""
    translation = rng.normal(size=3)
    scale = float(np.exp(rng.uniform(*np.log(scales))))
    return Similarity(scale, random_rotation(rng), offset * translation / np.linalg.norm(translation))


def rectangle(rng: np.random.Generator, corner, u, v, density: float) -> np.ndarray:
    """Sample the parallelogram of edges ``u`` and ``v`` at ``corner``, ``density`` points per unit area."""
    corner, u, v = (np.asarray(part, float) for part in (corner, u, v))
    count = round(density * np.linalg.norm(np.cross(u, v)))
    return corner + rng.random((count, 1)) * u + rng.random((count, 1)) * v


def box(rng: np.random.Generator, corner, size, density: float) -> np.ndarray:
    """Sample the six faces of an axis-parallel box."""
    corner, edges = np.asarray(corner, float), np.diag(np.asarray(size, float))
    faces = []
    for axis in range(3):
        u, v = edges[(axis + 1) % 3], edges[(axis + 2) % 3]
        faces += [rectangle(rng, start, u, v, density) for start in (corner, corner + edges[axis])]
    return np.concatenate(faces)


def ball(rng: np.random.Generator, centre, radius: float, density: float) -> np.ndarray:
    """Sample a sphere uniformly."""
    directions = rng.normal(size=(round(density * 4 * np.pi * radius**2), 3))
    return np.asarray(centre, float) + radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def cylinder(rng: np.random.Generator, centre, radius: float, height: float, density: float) -> np.ndarray:
    """Sample the mantle and both lids of an upright cylinder; ``centre`` is that of its lower lid."""
    mantle, lid = round(density * 2 * np.pi * radius * height), round(density * np.pi * radius**2)
    angle = rng.uniform(0.0, 2 * np.pi, mantle + 2 * lid)
    distance = radius * np.concatenate([np.ones(mantle), np.sqrt(rng.random(2 * lid))])
    z = np.concatenate([height * rng.random(mantle), np.zeros(lid), np.full(lid, height)])
    return np.asarray(centre, float) + np.column_stack([distance * np.cos(angle), distance * np.sin(angle), z])


def room(seed: int, density: float = 1500.0, noise: float = 0.004) -> np.ndarray:
    """Sample a scene without symmetry: an L of floor with walls, boxes, a ball and a cylinder; radius about 2.

    Every seed draws other points and other noise on the same surfaces, as two sensors do; (N, 3), shuffled.
    """
    rng = np.random.default_rng(seed)
    parts = [
        rectangle(rng, (0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (0.0, 1.2, 0.0), density),
        rectangle(rng, (0.0, 1.2, 0.0), (1.3, 0.0, 0.0), (0.0, 1.1, 0.0), density),
        rectangle(rng, (0.0, 0.0, 0.0), (0.0, 2.3, 0.0), (0.0, 0.0, 0.9), density),
        box(rng, (0.3, 1.5, 0.0), (0.5, 0.6, 0.35), density),
        box(rng, (1.7, 0.1, 0.0), (0.3, 0.4, 1.1), density),
        box(rng, (2.5, 0.6, 0.0), (0.4, 0.5, 0.2), density),
        ball(rng, (0.8, 0.55, 0.3), 0.3, density),
        cylinder(rng, (1.6, 0.85, 0.0), 0.18, 0.7, density),
    ]
    points = np.concatenate(parts)
    return rng.permutation(points + rng.normal(scale=noise, size=points.shape))


def radius(points: np.ndarray) -> float:
    """Return the largest distance of (N, 3) points to their centroid."""
    return float(np.linalg.norm(points - points.mean(0), axis=1).max())


def error(found: Similarity, truth: Similarity, source: np.ndarray) -> float:
    """Return the RMS displacement between two transforms over the radius of the moved source."""
    return found.displacement(truth, source) / radius(truth.apply(source))
