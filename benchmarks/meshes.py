"""Triangle meshes for the synthetic pairs: scanned ones from ``$CSGM_SHARED``, and sculptures of our own.

The sculptures exist so that nothing is tuned to a handful of scans: any seed gives another asymmetric shape,
from four families (blobs, machine parts, branches, heads) with different curvature and different flat shares.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

FAMILIES = ('blob', 'machine', 'branch', 'head')
SCULPTURES = tuple(f'{family}{seed}' for seed in range(3) for family in FAMILIES)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Centred triangle mesh: ``vertices`` (N, 3) float64 in any unit, ``triangles`` (M, 3) vertex indices."""

    name: str
    vertices: np.ndarray
    triangles: np.ndarray


def shared_folder() -> Path | None:
    """Return the folder ``$CSGM_SHARED`` (holds ``data/``), or None where it is unset."""
    value = os.environ.get('CSGM_SHARED')
    return Path(value) if value else None


def scanned_names() -> tuple[str, ...]:
    """Return the names of the scanned meshes at hand, in alphabetical order; empty without ``$CSGM_SHARED``."""
    folder = shared_folder()
    return tuple(sorted(path.stem for path in (folder / 'data' / 'meshes').glob('*.npz'))) if folder else ()


@lru_cache(maxsize=32)
def load(name: str) -> Mesh:
    """Return a mesh by name: a scanned one, or a sculpture such as ``machine7`` (family and seed). Do not change it.

    Raises
    ------
    KeyError
        For a name that is neither.
    """
    if name in scanned_names():
        data = np.load(shared_folder() / 'data' / 'meshes' / f'{name}.npz')
        return Mesh(name, data['vertices'].astype(float), data['triangles'].astype(np.int64))
    family = name.rstrip('0123456789')
    if family in FAMILIES and family != name:
        return sculpture(family, int(name[len(family) :]))
    raise KeyError(f'no mesh {name!r}: scanned are {scanned_names()} (from $CSGM_SHARED), sculptures are FAMILY + seed')


def sculpture(family: str, seed: int, resolution: int = 96) -> Mesh:
    """Return a random asymmetric shape: the zero level of a random implicit function.

    Parameters
    ----------
    family : str
        One of :data:`FAMILIES`.
    seed : int
        Same seed, same mesh.
    resolution : int
        Grid cells along each axis; 96 gives some 15,000 to 40,000 vertices.
    """
    rng = np.random.default_rng([FAMILIES.index(family), seed])
    parts = _parts(family, rng)
    low = np.min([part.centre - part.reach for part in parts], axis=0)
    high = np.max([part.centre + part.reach for part in parts], axis=0)
    step = (high - low).max() / resolution
    axes = [np.arange(start - 3 * step, stop + 4 * step, step) for start, stop in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1)
    vertices, triangles = isosurface(_field(parts, family, grid.reshape(-1, 3), rng).reshape(grid.shape[:3]))
    order = rng.permutation(len(vertices))  # "every third point" must not pick a lattice
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    vertices = vertices[order] * step
    return Mesh(f'{family}{seed}', vertices - vertices.mean(axis=0), rng.permutation(place[triangles]))


@dataclass(frozen=True, eq=False)
class _Part:
    """One primitive: a rounded box (``roundness`` 0..1 from box to ellipsoid) in a pose."""

    centre: np.ndarray
    half_size: np.ndarray
    rotation: np.ndarray
    roundness: float

    @property
    def reach(self) -> float:
        """Radius of a ball that holds the part."""
        return 1.15 * float(np.linalg.norm(self.half_size))

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Approximate signed distance of (N, 3) points, negative inside."""
        local = np.abs((points - self.centre) @ self.rotation)
        ball = (np.linalg.norm(local / self.half_size, axis=1) - 1) * self.half_size.min()
        excess = local - self.half_size
        box = np.linalg.norm(np.maximum(excess, 0), axis=1) + np.minimum(excess.max(axis=1), 0)
        return self.roundness * ball + (1 - self.roundness) * box


def _parts(family: str, rng: np.random.Generator) -> list[_Part]:
    """Draw the primitives of a shape; each but the first starts near an earlier one, so the shape holds together."""
    count = {'blob': 9, 'machine': 8, 'branch': 12, 'head': 5}[family]
    parts: list[_Part] = []
    for index in range(count):
        half_size = {
            'blob': rng.uniform(0.15, 0.5, 3),
            'machine': rng.uniform(0.1, 0.6, 3),
            'branch': np.array([rng.uniform(0.3, 0.7), *rng.uniform(0.07, 0.16, 2)]),
            'head': rng.uniform(0.5, 0.8, 3) if index == 0 else rng.uniform(0.12, 0.35, 3),
        }[family]
        rotation = random_rotation(rng)
        centre = np.zeros(3)
        if parts:
            parent = parts[0 if family == 'head' else rng.integers(len(parts))]
            direction = rng.normal(size=3)
            direction *= 0.9 / np.linalg.norm(direction)
            centre = parent.centre + parent.rotation @ (parent.half_size * direction)
            if family == 'branch':
                centre = centre + 0.8 * half_size[0] * rotation[:, 0]
        parts.append(_Part(centre, half_size, rotation, 0.0 if family == 'machine' else rng.uniform(0.6, 1.0)))
    return parts


def _field(parts: list[_Part], family: str, points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Signed value of the shape at (N, 3) points: a smooth union, plus waves in space that carve detail."""
    blend = {'blob': 0.06, 'machine': 0.005, 'branch': 0.03, 'head': 0.05}[family]
    value = parts[0].distance(points)
    for part in parts[1:]:
        other = part.distance(points)
        mix = np.clip(0.5 + 0.5 * (value - other) / blend, 0, 1)
        value = value * (1 - mix) + other * mix - blend * mix * (1 - mix)
    detail = {'blob': 0.03, 'machine': 0.002, 'branch': 0.01, 'head': 0.035}[family]
    for frequency in (4.0, 9.0, 18.0):
        for _ in range(4):
            wave = points @ (random_rotation(rng)[0] * frequency * rng.uniform(0.7, 1.4))
            value = value + detail * 6 / (frequency + 6) * np.sin(wave + rng.uniform(0, 2 * np.pi))
    return value


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Return a (3, 3) rotation, uniform over all rotations."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def isosurface(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate the zero level of a (X, Y, Z) grid by surface nets: one vertex per cell that the level crosses.

    Returns
    -------
    vertices : (N, 3) ndarray
        In grid steps; the mean of the level's crossings with the cell's twelve edges.
    triangles : (M, 3) int64 ndarray
        Two for every grid edge that the level crosses.
    """
    inside = values < 0
    cells = np.array(values.shape) - 1
    total = np.zeros((*cells, 3))
    count = np.zeros(cells, np.int64)
    faces = []
    for axis in range(3):
        start = np.moveaxis(values, axis, 0)[:-1]
        stop = np.moveaxis(values, axis, 0)[1:]
        crossed = np.moveaxis((start < 0) != (stop < 0), 0, axis)
        edges = np.argwhere(crossed)
        first = values[tuple(edges.T)]
        offset = np.zeros((len(edges), 3))
        offset[:, axis] = first / (first - values[tuple((edges + np.eye(3, dtype=int)[axis]).T)])
        around = _cells_around(edges, axis)
        for cell in around:
            np.add.at(total, tuple(cell.T), edges + offset)
            np.add.at(count, tuple(cell.T), 1)
        quads = np.stack([np.ravel_multi_index(cell.T, cells) for cell in around], axis=1)
        flip = ~inside[tuple(edges.T)]  # so that the normals point outwards
        quads[flip] = quads[flip][:, ::-1]
        faces.append(quads)
    quads = np.concatenate(faces)
    used = np.flatnonzero(count.ravel())
    index = np.full(count.size, -1)
    index[used] = np.arange(len(used))
    quads = index[quads]
    vertices = total.reshape(-1, 3)[used] / count.ravel()[used, None]
    return vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _cells_around(edges: np.ndarray, axis: int) -> list[np.ndarray]:
    """Return the four cells around each grid edge, in turn; the grid's border must lie outside the shape."""
    u, v = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]]
    return [edges - u - v, edges - v, edges, edges - u]
