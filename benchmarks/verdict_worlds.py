"""Worlds that the verdict is tried on, and simulated sensors that look at them.

A world is made of boxes, cylinders, spheres and meshes; a sensor casts rays at it, so that what it cannot see is
missing from its cloud, as it is from a real one.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from csgm_ros.cloud.voxels import voxel_means


class World:
    """A scene for ray casting; z is up, lengths are metres."""

    def __init__(self):
        import open3d

        self._open3d = open3d
        self._scene = open3d.t.geometry.RaycastingScene()

    def box(self, centre, size, yaw: float = 0.0, tilt: float = 0.0) -> World:
        """Add a box with edges ``size``, turned by ``yaw`` about z and ``tilt`` about x (degrees)."""
        mesh = self._open3d.geometry.TriangleMesh.create_box(*np.maximum(size, 1e-3))
        return self._add(mesh.translate(-np.asarray(size, float) / 2), centre, yaw, tilt)

    def cylinder(self, centre, radius: float, height: float, tilt: float = 0.0) -> World:
        """Add an upright cylinder."""
        return self._add(self._open3d.geometry.TriangleMesh.create_cylinder(radius, height, 48), centre, 0.0, tilt)

    def cone(self, base, radius: float, height: float) -> World:
        """Add an upright cone, ``base`` the middle of its foot."""
        return self._add(self._open3d.geometry.TriangleMesh.create_cone(radius, height, 48), base)

    def sphere(self, centre, radius: float) -> World:
        """Add a sphere."""
        return self._add(self._open3d.geometry.TriangleMesh.create_sphere(radius, 32), centre)

    def triangles(self, vertices: np.ndarray, faces: np.ndarray) -> World:
        """Add a mesh of (N, 3) vertices and (M, 3) faces."""
        vector = self._open3d.utility
        return self._add(
            self._open3d.geometry.TriangleMesh(vector.Vector3dVector(vertices), vector.Vector3iVector(faces)),
            (0, 0, 0),
        )

    def _add(self, mesh, centre, yaw: float = 0.0, tilt: float = 0.0) -> World:
        mesh.rotate(Rotation.from_euler('xz', (tilt, yaw), degrees=True).as_matrix(), center=(0, 0, 0))
        mesh.translate(np.asarray(centre, float))
        self._scene.add_triangles(self._open3d.t.geometry.TriangleMesh.from_legacy(mesh))
        return self

    def cast(self, eye: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return range and cosine of incidence of (N, 3) unit rays from ``eye``; an infinite range where none hits."""
        rays = np.concatenate([np.broadcast_to(eye, directions.shape), directions], 1).astype(np.float32)
        answer = self._scene.cast_rays(self._open3d.core.Tensor(rays))
        cosines = np.abs((answer['primitive_normals'].numpy() * directions).sum(1))
        return answer['t_hit'].numpy().astype(float), cosines


def lidar(
    world: World, eye, rng, *, rings: int = 64, lowest: float = -25.0, highest: float = 15.0, reach: float = 80.0
) -> np.ndarray:
    """Return one turn of a spinning lidar, (N, 3): range noise of 2 cm, a few points lost."""
    elevation = np.radians(np.linspace(lowest, highest, rings))
    azimuth = np.linspace(0, 2 * np.pi, max(300, 24000 // rings), endpoint=False) + rng.uniform(0, 0.01)
    e, a = (grid.ravel() for grid in np.meshgrid(elevation, azimuth))
    directions = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    return _returns(world, np.asarray(eye, float), directions, rng, 0.02, 0.0, reach)


def depth(world: World, eye, at, rng, *, rays: int = 24000, quadratic: float = 0.0015, reach: float = 6.0):
    """Return one frame of a depth camera, (N, 3): noise that grows with the square of the range."""
    return _returns(world, np.asarray(eye, float), _frustum(eye, at, rng, rays), rng, 0.001, quadratic, reach)


def fused(
    world: World,
    views,
    rng,
    *,
    noise: float = 0.004,
    voxel: float = 0.02,
    rays: int = 12000,
    wide: tuple[float, float] = (0.7, 0.55),
    reach: float = 30.0,
) -> np.ndarray:
    """Return what several views (eye, at) see, averaged in voxels: a fusion of depth frames, or a surveyor's scan."""
    parts = [
        _returns(world, np.asarray(eye, float), _frustum(eye, at, rng, rays, wide), rng, noise, 0.0, reach)
        for eye, at in views
    ]
    return voxel_means(np.concatenate(parts), voxel)


def photos(
    world: World,
    views,
    rng,
    *,
    points: int = 15000,
    texture: float = 0.6,
    noise: float = 0.002,
    wide: tuple[float, float] = (0.7, 0.55),
    reach: float = 30.0,
    wave: float = 3.0,
) -> np.ndarray:
    """Return a cloud as structure from motion makes it: only where there is texture, with outliers and gaps."""
    frequencies, phases = rng.normal(0, wave, (5, 3)), rng.uniform(0, 2 * np.pi, 5)
    parts = []
    for eye, at in views:
        eye = np.asarray(eye, float)
        directions = _frustum(eye, at, rng, int(2.5 * points / len(views) / texture), wide)
        distance, cosines = world.cast(eye, directions)
        seen = np.isfinite(distance) & (distance < reach) & (cosines > 0.2)
        seen[seen] &= _textured(eye + distance[seen, None] * directions[seen], frequencies, phases, texture)
        distance, directions = distance[seen], directions[seen]
        error = rng.normal(0, noise, len(distance)) * distance
        outlier = rng.random(len(distance)) < 0.02
        error[outlier] = rng.normal(0, 0.08, outlier.sum()) * distance[outlier]
        parts.append(eye + (distance + error)[:, None] * directions)
    found = np.concatenate(parts)
    return found[rng.permutation(len(found))[:points]]


def _textured(points, frequencies, phases, share) -> np.ndarray:
    waves = np.sin(points @ frequencies.T + phases).sum(1)
    return 1 / (1 + np.exp(-1.702 * waves / np.sqrt(len(phases) / 2))) < share


def _frustum(eye, at, rng, rays: int, wide: tuple[float, float] = (0.6, 0.45)) -> np.ndarray:
    forward = np.asarray(at, float) - np.asarray(eye, float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0) if abs(forward[2]) < 0.98 else (0.0, 1.0, 0.0))
    right /= np.linalg.norm(right)
    u, v = rng.uniform(-1, 1, (2, rays)) * np.array(wide)[:, None]
    directions = forward + u[:, None] * right + v[:, None] * np.cross(right, forward)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _returns(world, eye, directions, rng, constant, quadratic, reach) -> np.ndarray:
    distance, cosines = world.cast(eye, directions)
    seen = np.isfinite(distance) & (distance < reach) & (rng.random(len(distance)) < cosines / 0.2)
    distance, directions = distance[seen], directions[seen]
    distance = distance + rng.normal(0, 1, len(distance)) * (constant + quadratic * distance**2)
    return eye + distance[:, None] * directions


def walls(world: World, size, *, height: float = 2.6, gap: float = 0.0, ceiling: bool = False) -> World:
    """Add a floor and four walls of a room with its corner in the origin; the wall at y = 0 has a ``gap``."""
    x, y = size
    world.box((x / 2, y / 2, -0.05), (x, y, 0.1))
    for centre, edges in (
        ((-0.05, y / 2, height / 2), (0.1, y, height)),
        ((x + 0.05, y / 2, height / 2), (0.1, y, height)),
        ((x / 2, y + 0.05, height / 2), (x, 0.1, height)),
        (((x + gap) / 2, -0.05, height / 2), (x - gap, 0.1, height)),
    ):
        world.box(centre, edges)
    return world.box((x / 2, y / 2, height + 0.05), (x, y, 0.1)) if ceiling else world


def furniture(world: World, rng, low, high, count: int) -> World:
    """Put tables, shelves, cupboards, lamps, chairs and balls anywhere between two corners of the floor."""
    for _ in range(count):
        x, y = rng.uniform(low, high)
        yaw = rng.choice([0, 90]) + rng.choice([0.0, rng.uniform(-30, 30)])
        kind = rng.integers(6)
        if kind == 0:
            size, z = rng.uniform((0.7, 0.5, 0.03), (1.6, 0.9, 0.06)), rng.uniform(0.4, 0.8)
            world.box((x, y, z), size, yaw)
            for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
                leg = Rotation.from_euler('z', yaw, degrees=True).apply((a * size[0] / 2.3, b * size[1] / 2.3, z / 2))
                world.cylinder(leg + np.array([x, y, 0.0]), 0.03, z)
            world.box((x, y, z + 0.1), rng.uniform(0.1, 0.4, 3) * (1, 1, 0.6), rng.uniform(0, 90))
        elif kind == 1:
            width, tall = rng.uniform(0.6, 1.3), rng.uniform(0.9, 2.0)
            for level in np.arange(0.05, tall, rng.uniform(0.25, 0.45)):
                world.box((x, y, level), (width, 0.35, 0.03), yaw)
                world.box((x, y, level + 0.12), (rng.uniform(0.1, width), rng.uniform(0.1, 0.3), 0.22), yaw)
        elif kind == 2:
            size = rng.uniform((0.4, 0.4, 0.4), (1.0, 0.7, 1.9))
            world.box((x, y, size[2] / 2), size, yaw)
        elif kind == 3:
            tall = rng.uniform(1.0, 1.8)
            world.cylinder((x, y, tall / 2), 0.03, tall).sphere((x, y, tall), rng.uniform(0.1, 0.25))
        elif kind == 4:
            world.box((x, y, 0.45), (0.45, 0.45, 0.06), yaw)
            back = Rotation.from_euler('z', yaw, degrees=True).apply((0, 0.2, 0.75)) + np.array([x, y, 0.0])
            world.box(back, (0.45, 0.05, 0.5), yaw)
        else:
            radius = rng.uniform(0.15, 0.4)
            world.sphere((x, y, radius), radius)
    return world


def views_of_room(size, rng, count: int = 8, *, part: tuple[float, float] = (0.0, 1.0)):
    """Return (eye, at) of a camera carried through the part of a room between two shares of its length."""
    x0, x1 = (share * size[0] for share in part)
    views = []
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        eye = np.array(
            [rng.uniform(x0 + 0.35 * (x1 - x0), x0 + 0.65 * (x1 - x0)), size[1] * rng.uniform(0.35, 0.65), 1.5]
        )
        at = eye + 2 * np.array([np.cos(angle), np.sin(angle), rng.uniform(-0.6, -0.1)])
        views.append((eye, at))
    return views
