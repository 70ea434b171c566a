"""A furnished room of our own that simulated sensors look at: no two places in it look alike."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Material:
    """How a surface looks to a colour camera and to an infrared one.

    Attributes
    ----------
    color : tuple of float
        Red, green and blue in [0, 1].
    texture : float
        Share of the surface that structure from motion finds features on, in [0, 1].
    reflectance : float
        Share of the infrared light that comes back, in [0, 1]; dark surfaces leave holes in a Kinect's depth.
    """

    color: tuple[float, float, float]
    texture: float
    reflectance: float = 0.9


MATERIALS = {
    'floor': Material((0.55, 0.45, 0.36), 0.45),
    'rug': Material((0.62, 0.25, 0.22), 0.95),
    'wall': Material((0.85, 0.84, 0.78), 0.10),
    'poster': Material((0.25, 0.45, 0.65), 0.97),
    'wood': Material((0.66, 0.48, 0.28), 0.55),
    'sofa': Material((0.30, 0.42, 0.36), 0.60),
    'cushion': Material((0.85, 0.62, 0.25), 0.90),
    'books': Material((0.52, 0.30, 0.42), 0.97),
    'metal': Material((0.62, 0.64, 0.68), 0.20, 0.75),
    'screen': Material((0.08, 0.08, 0.10), 0.05, 0.15),
    'leaves': Material((0.25, 0.52, 0.22), 0.92),
    'pot': Material((0.72, 0.40, 0.26), 0.50),
    'ball': Material((0.90, 0.88, 0.82), 0.70),
    'crate': Material((0.58, 0.52, 0.40), 0.85),
}
NAMES = tuple(MATERIALS)


@dataclass(frozen=True, eq=False)
class Hits:
    """What (N,) rays met: NaN points and material -1 where they met nothing.

    Attributes
    ----------
    points, normals : (N, 3) ndarray
        Metres in the room's frame; normals of unit length.
    distance, cosine : (N,) ndarray
        Length of the ray, and cosine between it and the normal, in [0, 1].
    material : (N,) int ndarray
        Index into NAMES.
    """

    points: np.ndarray
    normals: np.ndarray
    distance: np.ndarray
    cosine: np.ndarray
    material: np.ndarray


class Room:
    """A room of about 4.4 x 3.8 x 2.5 m, z up, its furniture moved a little by the generator.

    Parameters
    ----------
    rng : numpy.random.Generator
    """

    def __init__(self, rng: np.random.Generator):
        import open3d

        self._open3d = open3d
        self._scene = open3d.t.geometry.RaycastingScene()
        self._materials: list[int] = []
        self._waves = rng.normal(0, 12.0, (6, 3)), rng.uniform(0, 2 * np.pi, 6)
        self._build_shell()
        self._furnish(rng)

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        """Follow rays from (N, 3) origins along (N, 3) unit directions."""
        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        answer = self._scene.cast_rays(self._open3d.core.Tensor(rays))  # type: ignore[call-overload]  # its defaults are not stubbed
        distance = answer['t_hit'].numpy().astype(float)
        normals = answer['primitive_normals'].numpy().astype(float)
        hit = np.isfinite(distance)
        geometry = answer['geometry_ids'].numpy().astype(np.int64)
        material = np.where(hit, np.array(self._materials)[np.where(hit, geometry, 0)], -1)
        distance = np.where(hit, distance, np.nan)
        cosine = np.abs((normals * directions).sum(axis=1))
        return Hits(origins + distance[:, None] * directions, normals, distance, cosine, material)

    def texture(self, hits: Hits) -> np.ndarray:
        """Return (N,) booleans: where SfM finds something on the surface."""
        frequencies, phases = self._waves
        waves = np.sin(hits.points @ frequencies.T + phases)
        share = np.array([MATERIALS[name].texture for name in NAMES])[hits.material]
        # The sum of six unit waves is nearly normal with variance 3; the logistic curve turns it into a uniform rank.
        rank = 1 / (1 + np.exp(-1.702 * waves.sum(axis=1) / np.sqrt(3)))
        return (hits.material >= 0) & (rank < share)

    def colors(self, hits: Hits) -> np.ndarray:
        """Return (N, 3) colours in [0, 1]: the material's, shaded by its pattern and by a lamp overhead."""
        frequencies, phases = self._waves
        base = np.array([MATERIALS[name].color for name in NAMES])[hits.material]
        pattern = np.sin(hits.points @ frequencies.T * 2.5 + phases).mean(axis=1)
        share = np.array([MATERIALS[name].texture for name in NAMES])[hits.material]
        light = 0.72 + 0.28 * np.abs(hits.normals[:, 2])
        return np.nan_to_num(np.clip(base * (light + 0.45 * share * pattern)[:, None], 0, 1))

    def reflectance(self, hits: Hits) -> np.ndarray:
        """Return (N,) shares of the infrared light that come back."""
        return np.where(hits.material >= 0, np.array([MATERIALS[n].reflectance for n in NAMES])[hits.material], 0.0)

    def _build_shell(self) -> None:
        self._box('floor', (0, 0, -0.05), (4.4, 3.8, 0.1))
        self._box('wall', (0, 1.95, 1.25), (4.4, 0.1, 2.5))
        self._box('wall', (-2.25, 0, 1.25), (0.1, 3.8, 2.5))
        self._box('wall', (2.25, 0.9, 1.25), (0.1, 2.0, 2.5))
        self._box('rug', (-0.2, -0.1, 0.01), (1.9, 1.2, 0.02), 12)
        self._box('poster', (-0.65, 1.885, 1.65), (0.9, 0.03, 0.65))
        self._box('poster', (-2.185, -0.5, 1.5), (0.03, 0.7, 0.95))
        self._box('wood', (0.62, 1.86, 1.55), (0.5, 0.08, 0.05))

    def _furnish(self, rng: np.random.Generator) -> None:
        def near(x: float, y: float) -> np.ndarray:
            return np.array([x, y, 0.0]) + np.append(rng.uniform(-0.08, 0.08, 2), 0)

        def turn(degrees: float) -> float:
            return degrees + rng.uniform(-6, 6)

        self._sofa(near(-1.55, 0.45), turn(88))
        self._table(near(0.15, 0.15), turn(-18))
        self._shelf(near(1.5, 1.68), rng)
        self._desk(near(-0.55, 1.55), turn(2))
        self._chair(near(-0.35, 0.95), turn(155))
        plant = near(1.8, 0.45)
        self._cylinder('pot', _placed(plant, (0, 0, 0.17)), 0.17, 0.34)
        for _ in range(9):
            self._sphere('leaves', _placed(plant, rng.normal((0, 0, 0.72), 0.13)), rng.uniform(0.07, 0.15))
        lamp = near(-1.85, 1.55)
        self._cylinder('metal', _placed(lamp, (0, 0, 0.8)), 0.025, 1.6)
        self._cylinder('cushion', _placed(lamp, (0, 0, 1.65)), 0.2, 0.26)
        self._box('crate', _placed(near(0.95, -0.75), (0, 0, 0.17)), (0.45, 0.34, 0.34), turn(35))
        self._box('crate', _placed(near(1.0, -0.72), (0, 0, 0.43)), (0.26, 0.3, 0.18), turn(70))
        self._sphere('ball', _placed(near(-0.9, -0.75), (0, 0, 0.16)), 0.16)

    def _sofa(self, at: np.ndarray, yaw: float) -> None:
        for material, offset, size in (
            ('sofa', (0, 0, 0.2), (1.6, 0.8, 0.4)),
            ('sofa', (0, 0.34, 0.55), (1.6, 0.14, 0.5)),
            ('sofa', (-0.72, 0, 0.42), (0.16, 0.8, 0.34)),
            ('sofa', (0.72, 0, 0.38), (0.16, 0.8, 0.26)),
            ('cushion', (-0.35, 0.16, 0.54), (0.4, 0.16, 0.32)),
        ):
            self._box(material, _placed(at, offset, yaw), size, yaw)

    def _table(self, at: np.ndarray, yaw: float) -> None:
        self._box('wood', _placed(at, (0, 0, 0.44)), (0.95, 0.6, 0.05), yaw)
        for x, y in ((-0.42, -0.25), (0.42, -0.25), (-0.42, 0.25), (0.42, 0.25)):
            self._cylinder('metal', _placed(at, (x, y, 0.21), yaw), 0.025, 0.42)
        self._box('books', _placed(at, (0.2, 0.1, 0.51), yaw), (0.28, 0.2, 0.09), yaw + 25)
        self._cylinder('pot', _placed(at, (-0.26, -0.08, 0.56), yaw), 0.07, 0.2)

    def _shelf(self, at: np.ndarray, rng: np.random.Generator) -> None:
        for height in (0.04, 0.5, 0.95, 1.4, 1.82):
            self._box('wood', _placed(at, (0, 0, height)), (1.1, 0.32, 0.04))
        for x in (-0.55, 0.55):
            self._box('wood', _placed(at, (x, 0, 0.93)), (0.04, 0.32, 1.82))
        for height in (0.06, 0.52, 0.97, 1.42):
            left = -0.5
            while left < 0.45:
                width, tall, deep = rng.uniform((0.06, 0.16, 0.14), (0.2, 0.36, 0.28))
                if rng.uniform() < 0.75:
                    self._box(
                        'books', _placed(at, (left + width / 2, 0.02, height + tall / 2)), (width * 0.92, deep, tall)
                    )
                left += width

    def _desk(self, at: np.ndarray, yaw: float) -> None:
        self._box('wood', _placed(at, (0, 0, 0.73)), (1.3, 0.62, 0.04), yaw)
        self._box('wood', _placed(at, (0.45, 0, 0.36), yaw), (0.36, 0.58, 0.7), yaw)
        self._box('metal', _placed(at, (-0.6, 0, 0.36), yaw), (0.05, 0.55, 0.7), yaw)
        self._box('screen', _placed(at, (-0.1, 0.12, 1.03), yaw), (0.56, 0.04, 0.34), yaw - 14)
        self._box('metal', _placed(at, (-0.1, 0.14, 0.8), yaw), (0.2, 0.14, 0.1), yaw - 14)
        self._box('books', _placed(at, (0.44, -0.05, 0.86), yaw), (0.24, 0.3, 0.2), yaw + 20)

    def _chair(self, at: np.ndarray, yaw: float) -> None:
        self._box('cushion', _placed(at, (0, 0, 0.45)), (0.44, 0.44, 0.07), yaw)
        self._box('wood', _placed(at, (0, 0.2, 0.75), yaw), (0.42, 0.05, 0.46), yaw)
        for x, y in ((-0.18, -0.18), (0.18, -0.18), (-0.18, 0.18), (0.18, 0.18)):
            self._cylinder('metal', _placed(at, (x, y, 0.21), yaw), 0.02, 0.42)

    def _box(self, material: str, center, size, yaw: float = 0.0) -> None:
        mesh = self._open3d.geometry.TriangleMesh.create_box(*size).translate(-np.asarray(size) / 2)
        self._add(material, mesh, center, yaw)

    def _cylinder(self, material: str, center, radius: float, height: float) -> None:
        self._add(material, self._open3d.geometry.TriangleMesh.create_cylinder(radius, height, 40), center)

    def _sphere(self, material: str, center, radius: float) -> None:
        self._add(material, self._open3d.geometry.TriangleMesh.create_sphere(radius, 24), center)

    def _add(self, material: str, mesh, center, yaw: float = 0.0) -> None:
        mesh.rotate(_yaw_matrix(yaw), center=(0, 0, 0)).translate(np.asarray(center, float))
        self._scene.add_triangles(self._open3d.t.geometry.TriangleMesh.from_legacy(mesh))
        self._materials.append(NAMES.index(material))


def _yaw_matrix(degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _placed(at: np.ndarray, offset, yaw: float = 0.0) -> np.ndarray:
    """Return the place of a part whose ``offset`` is given in the frame of a piece of furniture."""
    return at + _yaw_matrix(yaw) @ np.asarray(offset, float)
