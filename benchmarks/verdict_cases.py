"""Labelled cases for the verdict: what may be accepted, what may not, and what cannot be told.

Every kind of case is a function of a random generator that returns source and target in one frame and unit, and how
they belong together; :func:`cases` moves the source into a pose (and, unless the scale is given, a unit) of its own.
A place is a kind and a number: even numbers are for fitting thresholds, odd ones for testing them, never mixed.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from benchmarks import meshes, metrics
from benchmarks.datasets import apply, database_c_pair, real_names, real_pair, similarity
from benchmarks.meshes import random_rotation, shared_folder
from benchmarks.verdict_worlds import World, depth, furniture, fused, lidar, photos, views_of_room, walls
from csgm_ros.io.files import read_cloud


@dataclass(frozen=True, eq=False)
class Case:
    """Two clouds and what may be said about them.

    Attributes
    ----------
    name, kind : str
        Unique name; the class it is counted in.
    half : int
        0 for fitting, 1 for testing; all cases of one place are in one half.
    source, target : (N, 3), (M, 3) ndarray
    pose : (4, 4) ndarray
        Where source points belong, or, of clouds that do not belong together, where the scene has them.
    related : bool
        False where nothing may be accepted.
    determined : bool
        False where other transforms fit exactly as well, so that nothing may be accepted though the pose is known.
    rigid : bool
        The scale is given (1).
    eyes : pair of (3,) ndarray or None
        Where the sensors stood, each in its own cloud's frame; None where unknown or several.
    real : bool
        Real clouds: their truth is known to some centimetres.
    metre : float
        In units of the target; of real clouds.
    """

    name: str
    kind: str
    half: int
    source: np.ndarray
    target: np.ndarray
    pose: np.ndarray
    related: bool = True
    determined: bool = True
    rigid: bool = False
    eyes: tuple[np.ndarray | None, np.ndarray | None] = (None, None)
    real: bool = False
    metre: float = 1.0


@dataclass(frozen=True, eq=False)
class Scene:
    """What a kind's function returns: clouds in one frame and unit."""

    source: np.ndarray
    target: np.ndarray
    related: bool = True
    determined: bool = True
    eyes: tuple = (None, None)
    pose: np.ndarray = field(default_factory=lambda: np.eye(4))
    metre: float = 1.0


# --- corridors


def _corridor(rng, pieces: list[int], *, pitch: float = 3.0, width: float = 2.2) -> World:
    """A corridor along x; each piece has the doors, niches and things of the seed that it is given."""
    world, length = World(), pitch * len(pieces)
    world.box((length / 2, width / 2, -0.05), (length, width, 0.1))
    world.box((length / 2, width / 2, 2.55), (length, width, 0.1))
    for place, seed in enumerate(pieces):
        own, x = np.random.default_rng(seed), pitch * place
        for side, y in ((0, 0.0), (1, width)):
            door, wide = own.uniform(0.6, pitch - 0.6), own.uniform(0.7, 1.0)
            out = -0.05 if side == 0 else 0.05
            for start, stop in ((0.0, door - wide / 2), (door + wide / 2, pitch)):
                world.box((x + (start + stop) / 2, y + out, 1.25), (stop - start, 0.1, 2.5))
            world.box((x + door, y + 3 * out, 1.05), (wide, 0.1, 2.1))
            world.box((x + door, y + out, 2.3), (wide, 0.1, 0.4))
        for _ in range(own.integers(1, 4)):
            size = own.uniform((0.2, 0.2, 0.3), (0.7, 0.5, 1.6))
            y = own.choice([size[1] / 2, width - size[1] / 2])
            world.box((x + own.uniform(0.4, pitch - 0.4), y, size[2] / 2), size)
    return world


def _along(first: float, last: float, rng, *, step: float = 1.0, width: float = 2.2):
    eyes = np.arange(first, last, step)
    return [
        ((x, width / 2 + rng.uniform(-0.3, 0.3), 1.5), (x + sign * 2.0, width / 2 + rng.uniform(-1, 1), 1.2))
        for x in eyes
        for sign in (1, -1)
    ]


def _between(points: np.ndarray, low: float, high: float) -> np.ndarray:
    return points[(points[:, 0] >= low) & (points[:, 0] <= high)]


def _corridor_clouds(world: World, rng, source: tuple[float, float], target: tuple[float, float]):
    one = photos(world, _along(source[0], source[1], rng), rng, points=14000)
    other = fused(world, _along(target[0], target[1], rng), rng, voxel=0.025)
    return _between(one, *source), _between(other, *target)


def corridor_identical(rng) -> Scene:
    """All pieces alike and no end in sight: slid by one piece it fits as well."""
    world = _corridor(rng, [int(rng.integers(1 << 30))] * 8)
    first = 3.0 * rng.integers(1, 4) + rng.uniform(0, 3)
    return Scene(*_corridor_clouds(world, rng, (first, first + 9), (4.0, 16.0)), determined=False)


def corridor_plain(rng) -> Scene:
    """Bare walls: it slides."""
    world = World()
    for y, z, sizes in ((1.1, -0.05, (24, 2.2, 0.1)), (-0.05, 1.25, (24, 0.1, 2.5)), (2.25, 1.25, (24, 0.1, 2.5))):
        world.box((12, y, z), sizes)
    if rng.random() < 0.5:
        world.box((12, rng.uniform(0.2, 2.0), rng.uniform(1.8, 2.4)), (24, 0.15, 0.15))
    return Scene(*_corridor_clouds(world, rng, (6, 14), (5, 17)), determined=False)


def corridor_varied(rng) -> Scene:
    """No two pieces alike, well overlapping: there is an answer."""
    world = _corridor(rng, [int(seed) for seed in rng.integers(1 << 30, size=8)])
    return Scene(*_corridor_clouds(world, rng, (5, 14), (4, 16)))


def corridor_half(rng) -> Scene:
    """No two pieces alike, overlapping by half of the length."""
    world = _corridor(rng, [int(seed) for seed in rng.integers(1 << 30, size=8)])
    return Scene(*_corridor_clouds(world, rng, (2, 12), (7, 18)))


def corridor_apart(rng) -> Scene:
    """Two stretches of one corridor that share nothing but their cross section."""
    world = _corridor(rng, [int(seed) for seed in rng.integers(1 << 30, size=8)])
    return Scene(*_corridor_clouds(world, rng, (1, 10.5), (12, 22)), related=False)


# --- rooms


def _room(rng, size=None, count: int | None = None) -> tuple[World, np.ndarray]:
    size = rng.uniform((3.5, 3.0), (6.5, 4.5)) if size is None else size
    world = walls(World(), size, gap=rng.uniform(0.0, 1.2), ceiling=bool(rng.random() < 0.3))
    count = rng.integers(5, 11) if count is None else count
    return furniture(world, rng, (0.5, 0.5), size - 0.5, count), size


def room(rng) -> Scene:
    """A furnished room by photos and by a depth camera that is carried through it."""
    world, size = _room(rng)
    return Scene(photos(world, views_of_room(size, rng), rng), fused(world, views_of_room(size, rng), rng, voxel=0.025))


def room_scanned(rng) -> Scene:
    """A lidar's turn in a room and one frame of a depth camera, both viewpoints known."""
    world, size = _room(rng)
    eye = np.array([*(size * rng.uniform(0.35, 0.65, 2)), 1.2])
    corner = np.array([*(size * rng.uniform(0.15, 0.3, 2)), 1.6])
    one = depth(world, corner, (*(size * 0.7), 0.6), rng, rays=20000)
    return Scene(one, lidar(world, eye, rng, lowest=-50, highest=40), eyes=(corner, eye))


def _halves(rng, share: float) -> Scene:
    world, size = _room(rng, rng.uniform((5.5, 3.2), (8.0, 4.5)), rng.integers(8, 14))
    middle = rng.uniform(0.4, 0.6)
    parts = (0.0, middle + share / 2), (middle - share / 2, 1.0)
    one = photos(world, views_of_room(size, rng, 10, part=parts[0]), rng)
    other = fused(world, views_of_room(size, rng, 10, part=parts[1]), rng, voxel=0.025)
    cut = [np.array(part) * size[0] + (-0.2, 0.2) * (np.array(part) % 1 == 0) for part in parts]
    return Scene(_between(one, *cut[0]), _between(other, *cut[1]), related=share > 0.05)


def room_halves_0(rng) -> Scene:
    """Opposite halves of a room that do not overlap: nothing may be accepted."""
    return _halves(rng, rng.uniform(-0.05, 0.0))


def room_halves_15(rng) -> Scene:
    """Opposite halves of a room that overlap by 10 to 20 % of its length."""
    return _halves(rng, rng.uniform(0.1, 0.2))


def room_halves_30(rng) -> Scene:
    """Opposite halves of a room that overlap by 25 to 35 % of its length."""
    return _halves(rng, rng.uniform(0.25, 0.35))


def room_twin(rng) -> Scene:
    """Rooms of the same walls with other furniture: hotel, office, classroom."""
    size, gap = rng.uniform((3.5, 3.0), (6.5, 4.5)), rng.uniform(0.0, 1.2)
    worlds = [
        furniture(walls(World(), size, gap=gap), rng, (0.5, 0.5), size - 0.5, rng.integers(5, 11)) for _ in range(2)
    ]
    one = photos(worlds[0], views_of_room(size, rng), rng)
    return Scene(one, fused(worlds[1], views_of_room(size, rng), rng, voxel=0.025), related=False)


def room_mirrored(rng) -> Scene:
    """A room and its mirror image, as flats on both sides of a staircase are."""
    scene = room(rng)
    return Scene(scene.source * (-1, 1, 1), scene.target, related=False)


def room_other(rng) -> Scene:
    """Two different rooms."""
    (one, size), (other, wide) = _room(rng), _room(rng)
    return Scene(
        photos(one, views_of_room(size, rng), rng),
        fused(other, views_of_room(wide, rng), rng, voxel=0.025),
        related=False,
    )


def room_part(rng) -> Scene:
    """A corner of a large room, seen in one view, in the cloud of the whole."""
    world, size = _room(rng, rng.uniform((6.0, 4.0), (9.0, 6.0)), rng.integers(12, 20))
    at = np.array([*rng.uniform((0.8, 0.8), size - 0.8), 0.6])
    eye = at + np.append(rng.uniform(-1.2, 1.2, 2), 1.3)
    eye[:2] = np.clip(eye[:2], 0.4, size - 0.4)
    one = depth(world, eye, at, rng, rays=16000, reach=3.0)
    return Scene(one, fused(world, views_of_room(size, rng, 16), rng, voxel=0.03), eyes=(eye, None))


def room_lacking(rng) -> Scene:
    """The part that the source shows was cut out of the target."""
    scene = room_part(rng)
    centre = np.median(scene.source, 0)
    reach = np.percentile(np.linalg.norm(scene.source - centre, axis=1), 95)
    kept = np.linalg.norm(scene.target - centre, axis=1) > reach
    return Scene(scene.source, scene.target[kept], related=False, eyes=scene.eyes)


def corner(rng) -> Scene:
    """Three bare walls that meet: any scale fits."""
    size = rng.uniform((3.0, 3.0), (5.0, 5.0))
    world = World().box((size[0] / 2, size[1] / 2, -0.05), (*size, 0.1))
    world.box((-0.05, size[1] / 2, 1.3), (0.1, size[1], 2.6)).box((size[0] / 2, -0.05, 1.3), (size[0], 0.1, 2.6))
    views = [((1.6, 1.6, 1.5), (0.3, 0.3, 0.5)), ((2.0, 1.2, 1.2), (0.2, 0.8, 0.6)), ((1.2, 2.0, 1.6), (0.8, 0.2, 0.4))]
    far = [((2.2, 2.4, 1.5), (0.3, 0.2, 0.6)), ((1.8, 1.5, 1.8), (0.4, 0.3, 0.2))]
    source, target = photos(world, views, rng, points=9000), fused(world, far, rng, voxel=0.025)
    reach = rng.uniform(1.2, 1.8)
    return Scene(
        source[np.linalg.norm(source, axis=1) < reach],
        target[np.linalg.norm(target, axis=1) < reach * rng.uniform(1.0, 1.3)],
        determined=False,
    )


# --- streets


def _street(rng, length: float = 120.0, *, repeated: bool = False) -> World:
    world = World().box((length / 2, 0, -0.05), (length, 60, 0.1))
    for side in (-1, 1):
        x = 0.0
        while x < length:
            wide, high, back = rng.uniform(8, 20), rng.uniform(5, 15), rng.uniform(7, 12)
            if repeated:
                wide, high, back = 10.0, 8.0, 9.0
            world.box(
                (x + wide / 2, side * (back + 5), high / 2), (wide - (0.0 if repeated else rng.uniform(0, 3)), 10, high)
            )
            for bay in np.arange(x + 1.5, x + wide - 1.5, 3.0):
                world.box((bay, side * (back - 0.15), 1.6), (1.2, 0.4, 1.4))
            x += wide
        things = np.arange(5.0, length, 10.0) if repeated else rng.uniform(0, length, rng.integers(10, 20))
        for x in things:
            kind = 1 if repeated else rng.integers(3)
            if kind == 0:
                world.box((x, side * rng.uniform(3.5, 5.5), 0.75), rng.uniform((3.6, 1.6, 1.3), (5.0, 2.0, 2.2)))
            elif kind == 1:
                world.cylinder((x, side * 6.0, 3.0), 0.12, 6.0)
            else:
                world.cylinder((x, side * 6.5, 1.5), 0.2, 3.0).sphere((x, side * 6.5, 4.0), rng.uniform(1.0, 2.0))
    return world


def _street_pair(rng, apart: float, *, repeated: bool = False, related: bool = True) -> Scene:
    world = _street(rng, repeated=repeated)
    eye = np.array([45.0 + rng.uniform(-10, 0), rng.uniform(-2, 2), 1.8])
    other = np.array([eye[0] + apart, rng.uniform(-2, 2), rng.uniform(1.2, 2.0)])
    target = lidar(world, eye, rng, reach=45)
    source = lidar(world, other, rng, rings=int(rng.choice([16, 32])), lowest=-15, highest=15, reach=30)
    return Scene(source, target, related=related, determined=not repeated, eyes=(other, eye))


def street_near(rng) -> Scene:
    """A small lidar and a large one in one street, up to 8 m apart."""
    return _street_pair(rng, rng.uniform(0, 8))


def street_far(rng) -> Scene:
    """The same, 15 to 30 m apart: half of it overlaps."""
    return _street_pair(rng, rng.uniform(15, 30))


def street_apart(rng) -> Scene:
    """The same, 75 to 85 m apart: no overlap."""
    world = _street(rng, 170.0)
    eye = np.array([40.0, rng.uniform(-2, 2), 1.8])
    other = np.array([eye[0] + rng.uniform(78, 88), rng.uniform(-2, 2), 1.6])
    source = lidar(world, other, rng, rings=32, lowest=-15, highest=15, reach=30)
    return Scene(source, lidar(world, eye, rng, reach=45), related=False, eyes=(other, eye))


def street_repeated(rng) -> Scene:
    """Terraced houses and lamps at one pitch on both sides."""
    return _street_pair(rng, rng.uniform(0, 8), repeated=True)


def street_photographed(rng) -> Scene:
    """A stretch of a street by photos from a car, and a lidar's turn."""
    world = _street(rng)
    views = [
        ((x, rng.uniform(-1, 1), 1.6), (x + 6 * np.sign(y), y, 2.5)) for x in np.arange(35, 65, 3.0) for y in (-9, 9)
    ]
    eye = np.array([50 + rng.uniform(-5, 5), rng.uniform(-2, 2), 1.8])
    source = photos(world, views, rng, points=20000, noise=0.004, reach=25, wave=0.8)
    return Scene(source, lidar(world, eye, rng, reach=45), eyes=(None, eye))


# --- repeats


def _shelf(rng, repeated: bool) -> World:
    world, columns, rows = World(), 7, 4
    book = rng.uniform((0.15, 0.12, 0.15), (0.4, 0.25, 0.3))
    for row in range(rows + 1):
        world.box((columns * 0.3, 0, row * 0.4), (columns * 0.6, 0.35, 0.03))
    for column in range(columns + 1):
        world.box((column * 0.6, 0, rows * 0.2), (0.03, 0.35, rows * 0.4))
    world.box((columns * 0.3, 0.18, rows * 0.2), (columns * 0.6, 0.02, rows * 0.4))
    for row, column in itertools.product(range(rows), range(columns)):
        for _ in range(1 if repeated else rng.integers(0, 3)):
            size = book if repeated else rng.uniform((0.08, 0.1, 0.1), (0.4, 0.25, 0.35))
            x = 0.3 if repeated else rng.uniform(0.1, 0.5)
            world.box((column * 0.6 + x, -0.05, row * 0.4 + size[2] / 2), size)
    return world


def _shelf_pair(rng, repeated: bool) -> Scene:
    world = _shelf(rng, repeated)
    columns = rng.uniform(0.3, 0.7), rng.uniform(1.5, 2.2)
    views = [((x, -1.6, z), (x, 0, z - 0.1)) for x in np.arange(0.3, 4.0, 0.6) for z in (0.7, 1.2)]
    one, other = photos(world, views, rng, points=26000), fused(world, views, rng, voxel=0.012, noise=0.003)
    one = one[(np.abs(one[:, 0] - columns[1]) < 1.1) & (one[:, 2] > 0.25) & (one[:, 2] < 1.35)]
    other = other[(np.abs(other[:, 0] - 2.1) < 1.75) & (other[:, 2] > 0.15) & (other[:, 2] < 1.45)]
    return Scene(one, other, determined=not repeated)


def shelf_repeated(rng) -> Scene:
    """Identical bays of a shelf whose ends are out of sight."""
    return _shelf_pair(rng, True)


def shelf_varied(rng) -> Scene:
    """The same shelf with different things in it."""
    return _shelf_pair(rng, False)


def windows(rng) -> Scene:
    """A facade of identical windows whose ends are out of sight."""
    world = World().box((15, 0.5, 8), (60, 1, 30))
    for x, z in itertools.product(np.arange(-6, 36, 3.0), np.arange(-2, 18, 3.2)):
        world.box((x, -0.1, z - 0.9), (1.6, 0.4, 0.15)).box((x, -0.1, z + 0.9), (1.6, 0.3, 0.2))
        world.box((x - 0.8, -0.05, z), (0.15, 0.25, 1.8)).box((x + 0.8, -0.05, z), (0.15, 0.25, 1.8))
    centre = rng.uniform(10, 18), rng.uniform(6, 10)
    one = photos(
        world, [((centre[0] + d, -9, centre[1]), (centre[0] + d, 0, centre[1])) for d in (-3, 0, 3)], rng, wave=1
    )
    other = fused(world, [((14 + d, -12, 8), (14 + d, 0, 8)) for d in (-5, 0, 5)], rng, voxel=0.08, rays=20000)
    return Scene(one, other, determined=False)


# --- little structure


def flat(rng) -> Scene:
    """A floor, perhaps with a little relief that is no more than noise."""
    world = World().box((0, 0, -0.05), (8, 8, 0.1))
    views = [((x, y, 1.6), (x + 0.3, y, 0)) for x in (-0.8, 0.4) for y in (-0.6, 0.6)]
    return Scene(photos(world, views, rng, points=9000), fused(world, views[:3], rng, voxel=0.03), determined=False)


def flat_relief(rng) -> Scene:
    """A floor with a few low things on it, seen whole by both: there is an answer, if the things are seen."""
    world = World().box((0, 0, -0.05), (8, 8, 0.1))
    for _ in range(rng.integers(4, 8)):
        size = rng.uniform((0.2, 0.2, 0.06), (0.7, 0.5, 0.2))
        world.box((*rng.uniform(-1.2, 1.2, 2), size[2] / 2), size, rng.uniform(0, 90))
    views = [((x, y, 1.8), (x + 0.3, y, 0)) for x in (-0.6, 0.6) for y in (-0.6, 0.6)]
    return Scene(photos(world, views, rng), fused(world, views, rng, voxel=0.02))


def pipe(rng) -> Scene:
    """A pipe, or a bundle of rails: almost on one line."""
    world = World()
    if rng.random() < 0.5:
        world.triangles(*_turned(rng.uniform(0.08, 0.15) * np.ones(2), np.array([-6.0, 6.0]), axis=0))
    else:
        for y in rng.uniform(-0.3, 0.3, 3):
            world.box((0, y, rng.uniform(0, 0.2)), (12, 0.08, 0.12))
    views = [((x, -1.5, z), (x, 0, 0.05)) for x in np.arange(-2, 2.1, 0.8) for z in (-0.6, 1.0)]
    one, other = photos(world, views, rng, points=9000), fused(world, views, rng, voxel=0.015)
    return Scene(_between(one, -1.8, 1.6), _between(other, -2.2, 2.2), determined=False)


# --- objects


def _turned(radii: np.ndarray, heights: np.ndarray, axis: int = 2, sides: int = 48):
    """Mesh of a surface of revolution of the profile (radius, height)."""
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    rings = [
        np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(sides, h)])
        for r, h in zip(radii, heights, strict=True)
    ]
    vertices = np.roll(np.concatenate(rings), axis - 2, axis=1)
    faces = []
    for ring, k in itertools.product(range(len(radii) - 1), range(sides)):
        a, b, up = ring * sides + k, ring * sides + (k + 1) % sides, sides
        faces += [(a, b, a + up), (b, b + up, a + up)]
    return vertices, np.array(faces)


def _around(rng, distance: float, count: int = 10, arc: tuple[float, float] = (0, 2 * np.pi), height: float = 0.3):
    angles = rng.uniform(*arc) * 0 + np.linspace(*arc, count, endpoint=False) + rng.uniform(0, 0.3)
    return [
        ((distance * np.cos(a), distance * np.sin(a), distance * rng.uniform(-0.1, 0.6)), (0, 0, height))
        for a in angles
    ]


def _symmetric_world(rng, kind: int) -> tuple[World, float]:
    world = World()
    if kind == 0:
        heights = np.linspace(0, 1, 12)
        world.triangles(*_turned(0.25 + 0.12 * np.sin(rng.uniform(3, 9) * heights + rng.uniform(0, 6)), heights))
    elif kind == 1:
        world.sphere((0, 0, 0.4), 0.4)
    elif kind == 2:
        world.box((0, 0, 0.4), rng.uniform(0.4, 1.0, 3))
    elif kind == 3:
        world.box((0, 0, 0.7), (1.4, 0.8, 0.05))
        for a, b in itertools.product((-1, 1), (-1, 1)):
            world.box((a * 0.62, b * 0.32, 0.34), (0.07, 0.07, 0.68))
    elif kind == 4:
        world.cylinder((0, 0, 0.5), rng.uniform(0.2, 0.4), 1.0)
    elif kind == 5:
        world.cone((0, 0, 0), rng.uniform(0.3, 0.5), 1.0)
    elif kind == 6:  # a star of equal arms
        arms = int(rng.integers(3, 6))
        for k in range(arms):
            angle = 2 * np.pi * k / arms
            world.box((0.4 * np.cos(angle), 0.4 * np.sin(angle), 0.1), (0.7, 0.12, 0.2), np.degrees(angle))
        world.cylinder((0, 0, 0.4), 0.08, 0.8)
    else:  # stairs of two equal flights, symmetric under a half turn
        for k in range(4):
            world.box((0.15 + 0.2 * k, 0.25, 0.1 * (k + 1) / 2), (0.2, 0.5, 0.1 * (k + 1)))
            world.box((-0.15 - 0.2 * k, -0.25, 0.1 * (k + 1) / 2), (0.2, 0.5, 0.1 * (k + 1)))
    return world, 2.5


def symmetric(rng) -> Scene:
    """An object that some turn brings onto itself."""
    world, distance = _symmetric_world(rng, int(rng.integers(8)))
    views = _around(rng, distance)
    one = photos(world, views, rng, points=9000, texture=0.85, noise=0.0015, wide=(0.35, 0.35), wave=6)
    return Scene(
        one, fused(world, _around(rng, distance), rng, voxel=0.015, noise=0.003, wide=(0.35, 0.35)), determined=False
    )


def mug(rng) -> Scene:
    """A surface of revolution with a handle and a spout: what breaks the symmetry is small."""
    world, distance = _symmetric_world(rng, 0)
    world.box((0.42, 0, 0.5), (0.28, 0.06, rng.uniform(0.3, 0.5)))
    angle = rng.uniform(1.5, 2.5)
    world.box((0.4 * np.cos(angle), 0.4 * np.sin(angle), 0.75), (0.25, 0.1, 0.1), np.degrees(angle))
    one = photos(world, _around(rng, distance), rng, points=9000, texture=0.85, noise=0.0015, wide=(0.35, 0.35), wave=6)
    return Scene(one, fused(world, _around(rng, distance), rng, voxel=0.015, noise=0.003, wide=(0.35, 0.35)))


FIT_MESHES = ('bunny', 'igea', 'springer')
TEST_MESHES = ('armadillo', 'skull')
MIRROR_SYMMETRIC = ('springer', 'skull')  # to less than 0.2 % of the radius


def _drawn(rng, half: int, but: tuple[str, ...] = ()) -> str:
    """Draw the name of a mesh."""
    names = (FIT_MESHES, TEST_MESHES)[half] if shared_folder() else ()
    names = tuple(name for name in names if name not in but)
    chosen = int(rng.integers(len(names) + 4))
    if chosen < len(names):
        return names[chosen]
    family = ('blob', 'machine', 'branch', 'head')[chosen - len(names)]
    return f'{family}{2 * int(rng.integers(2)) + half}'


def _two_views(rng, name: str, **options) -> Scene:
    pair = database_c_pair(meshes.load(name), int(rng.integers(1 << 30)), **options)
    thin = rng.permutation(len(pair.target))[:30000]
    return Scene(pair.source[rng.permutation(len(pair.source))[:15000]], pair.target[thin], pose=pair.T_target_source)


def object_views(rng, half: int) -> Scene:
    """Two views of one object, as Database C has them."""
    return _two_views(rng, _drawn(rng, half))


def object_views_far(rng, half: int) -> Scene:
    """Two views of one object, 100 degrees apart."""
    return _two_views(rng, _drawn(rng, half), separation_deg=100.0)


def object_mirrored(rng, half: int) -> Scene:
    """An object and its mirror image, but for those that are their own."""
    scene = _two_views(rng, _drawn(rng, half, but=MIRROR_SYMMETRIC))
    return Scene(scene.source * (-1, 1, 1), scene.target, related=False, pose=scene.pose)


def object_other(rng, half: int) -> Scene:
    """Two different objects."""
    first = _drawn(rng, half)
    one = _two_views(rng, first)
    rng = np.random.default_rng(rng.integers(1 << 30))
    second = next(name for name in iter(lambda: _drawn(rng, half), None) if name != first)
    return Scene(one.source, _two_views(rng, second).target, related=False)


def object_part(rng, half: int) -> Scene:
    """A part of an object, a quarter of it, in the whole."""
    mesh = meshes.load(_drawn(rng, half))
    points = np.concatenate([mesh.vertices, mesh.vertices[mesh.triangles].mean(1)])
    points = points[rng.permutation(len(points))]
    size = np.linalg.norm(points, axis=1).max()
    near = np.linalg.norm(points - points[0], axis=1)
    one = points[near < np.percentile(near, rng.uniform(12, 30))][:12000]
    other = points[rng.permutation(len(points))[:30000]]
    return Scene(one + rng.normal(0, 0.004 * size, one.shape), other + rng.normal(0, 0.002 * size, other.shape))


SYNTHETIC: tuple[tuple[Callable[..., Scene], int], ...] = (
    (corridor_identical, 20),
    (corridor_plain, 16),
    (corridor_varied, 24),
    (corridor_half, 24),
    (corridor_apart, 28),
    (room, 56),
    (room_scanned, 36),
    (room_halves_0, 36),
    (room_halves_15, 24),
    (room_halves_30, 28),
    (room_twin, 60),
    (room_mirrored, 40),
    (room_other, 40),
    (room_part, 50),
    (room_lacking, 40),
    (corner, 16),
    (street_near, 40),
    (street_far, 30),
    (street_apart, 30),
    (street_repeated, 20),
    (street_photographed, 24),
    (shelf_repeated, 20),
    (shelf_varied, 24),
    (windows, 16),
    (flat, 14),
    (flat_relief, 20),
    (pipe, 16),
    (symmetric, 48),
    (mug, 20),
    (object_views, 40),
    (object_views_far, 24),
    (object_mirrored, 36),
    (object_other, 40),
    (object_part, 24),
)
"""Kinds and how many cases of each; every case is a place of its own."""
LEAST, SIMULATED = 4, 24
OBJECTS = {object_views, object_views_far, object_mirrored, object_other, object_part}


def synthetic(kind: Callable[..., Scene], number: int) -> Case:
    """Return one synthetic case; ``number`` is its place, every third has the scale given."""
    rng = np.random.default_rng([number, *kind.__name__.encode()])
    half = number % 2
    scene = kind(rng, half) if kind in OBJECTS else kind(rng)
    rigid = number % 6 in (4, 5)
    if kind is corner and rigid:  # three planes fix everything but the scale
        scene = Scene(scene.source, scene.target)
    return _placed(f'{kind.__name__}-{number}', kind.__name__, half, scene, rigid, rng)


def _placed(name: str, kind: str, half: int, scene: Scene, rigid: bool, rng, *, real: bool = False) -> Case:
    """Give the source a pose and a unit of its own; with the scale given, the unit of the target."""
    given = np.cbrt(np.linalg.det(scene.pose[:3, :3])) if rigid else np.exp(rng.uniform(np.log(0.1), np.log(10)))
    pose = similarity(given, random_rotation(rng), rng.normal(size=3) * given * np.ptp(scene.source, 0).max())
    order = rng.permutation(len(scene.source))
    eyes = scene.eyes
    return Case(
        name,
        kind,
        half,
        apply(pose, scene.source)[order].astype(np.float32).astype(float),
        scene.target.astype(np.float32).astype(float),
        scene.pose @ np.linalg.inv(pose),
        scene.related,
        scene.determined,
        rigid,
        (None if eyes[0] is None else apply(pose, np.asarray(eyes[0])[None])[0], eyes[1]),
        real,
        scene.metre,
    )


# --- real clouds


def _read(path) -> np.ndarray:
    points = read_cloud(path).points
    return points[np.random.default_rng(0).permutation(len(points))[:100000]]


def _place_scenes() -> Iterator[tuple[str, int, Scene]]:
    """Yield the pairs of ``places``; lidar scans have their sensor in the origin before they were moved."""
    halves = {'cubicle_1': 0, 'bin_shelf': 1, 'phone_desk': 1, 'street1_left': 0, 'street1_right': 0, 'canyon_qt1': 1}
    for name, half in halves.items():
        folder = shared_folder() / 'data' / 'places' / name
        label = json.loads((folder / 'gt.json').read_text())
        eyes = (None, None)
        if label['kind'].startswith('lidar'):
            eyes = np.array(label['random_similarity'])[:3, 3], np.zeros(3)
        truth = np.array(label['T_target_source'])
        yield name, half, Scene(_read(folder / 'source.ply'), _read(folder / 'target.ply'), eyes=eyes, pose=truth)


def _unrelated() -> dict[str, np.ndarray]:
    return {path.stem: _read(path) for path in sorted((shared_folder() / 'data' / 'unrelated').glob('*.ply'))}


def _frames(name: str, half: int, count: int) -> Iterator[tuple[str, int, Scene]]:
    """Yield single depth frames of a moving camera that see its map well enough, to be found in that map."""
    folder = shared_folder() / 'data' / name
    data, target = np.load(folder / 'frames.npz'), _read(folder / 'map.ply')
    on_map = np.flatnonzero((data['state'] == 1) & (data['share_on_map'] > 0.5))
    for index in on_map[np.linspace(0, len(on_map) - 1, count).astype(int)]:
        pose = data['T_map_camera'][index]
        scene = Scene(_frame(data, index), target, eyes=(np.zeros(3), None), pose=pose, metre=metrics.split(pose)[0])
        yield f'{name}-{index}', half, scene


def _frame(data, index: int) -> np.ndarray:
    z = data['depth'][index] / 1000.0
    v, u = np.mgrid[: z.shape[0], : z.shape[1]]
    k = data['K']
    points = np.stack([(u - k[0, 2]) / k[0, 0] * z, (v - k[1, 2]) / k[1, 1] * z, z], 2)[z > 0]
    return points[::2]


def real(half: int | None = None, *, windows: int = 10, crosses: int = 60) -> Iterator[Case]:
    """Yield the real cases: related pairs, many twice (scale unknown and given), and clouds that share nothing."""
    if shared_folder() is None:
        return
    kitchen = {name: real_pair(name) for name in real_names()}
    related = [(name, 0, Scene(p.source, p.target, pose=p.T_target_source)) for name, p in kitchen.items()]
    places = list(_place_scenes())
    scenes = [('place', *item) for item in places] + [('kitchen', *item) for item in related]
    scenes += [('kitchen, other window', *item) for item in itertools.islice(_windows(kitchen), windows)]
    scenes += [
        ('frame in map', *item) for item in (*_frames('sequence_desk', 1, 12), *_frames('sequence_kitchen', 0, 8))
    ]
    for kind, name, own, scene in scenes:
        if half not in (None, own):
            continue
        for rigid in (False, True) if kind == 'place' else (name.endswith(tuple('02468')),):
            rng = np.random.default_rng([rigid, *name.encode()])
            yield _placed(f'{name}-{"given" if rigid else "unknown"}', kind, own, scene, rigid, rng, real=True)
    yield from _crossed([*((n, h, s.source) for n, h, s in related[3:6] + places)], related, places, crosses)


def _windows(kitchen) -> Iterator[tuple[str, int, Scene]]:
    from benchmarks.database_b import cross_pairs

    for one, other in cross_pairs(list(kitchen)):
        pair = kitchen[one]
        yield f'{one}|{other}', 0, Scene(pair.source, kitchen[other].target, pose=pair.T_target_source)


def _crossed(sources, related, places, count: int) -> Iterator[Case]:
    """Yield pairs of clouds of different places; both clouds of a pair are of one half."""
    single = _unrelated()
    halves = {name: number % 2 for number, name in enumerate(single)}
    sources = [*sources, *((name, halves[name], cloud) for name, cloud in single.items())]
    targets = [(n, h, s.target) for n, h, s in related[3:6] + places]
    targets += [(name, halves[name], cloud) for name, cloud in single.items()]
    outdoors = {'street1_left': 'street', 'street1_right': 'street'}
    pairs = [
        (one, other)
        for one, other in itertools.product(sources, targets)
        if one[1] == other[1]
        and outdoors.get(one[0], one[0]) != outdoors.get(other[0], other[0])
        and not (one[0].startswith(('kitchen', 'crop')) and other[0].startswith(('kitchen', 'crop')))
    ]
    rng = np.random.default_rng(0)
    for number in rng.permutation(len(pairs))[:count]:
        (name, half, source), (against, _, target) = pairs[number]
        scene = Scene(source, target, related=False)
        yield _placed(f'{name}|{against}', 'unrelated', half, scene, False, rng, real=True)


def simulated(number: int) -> Case:
    """Return the demonstration's room by simulated photos and a simulated depth camera."""
    from csgm_ros.demo.simulation import simulate

    pair = simulate(number, sfm_points=20000, height=240, width=320)
    rng = np.random.default_rng([number, 7])
    target = pair.target[np.isfinite(pair.target).all(2)].astype(float)
    scene = Scene(pair.source, target, eyes=(None, np.zeros(3)), pose=pair.truth.matrix)
    return _placed(f'simulated-{number}', 'simulated', number % 2, scene, number % 3 == 2, rng)


def cases(share: float = 1.0, half: int | None = None) -> Iterator[tuple[str, Callable[[], Case]]]:
    """Yield names and makers of the synthetic cases, kind by turns; ``share`` below 1 takes the first of each kind."""
    kinds = [
        (kind.__name__, lambda n, kind=kind: synthetic(kind, n), max(LEAST, round(share * most)))
        for kind, most in SYNTHETIC
    ]
    kinds.append(('simulated', simulated, max(LEAST, round(share * SIMULATED))))
    for number in range(max(count for *_, count in kinds)):
        for name, make, count in kinds:
            if number < count and half in (None, number % 2):
                yield f'{name}-{number}', lambda make=make, number=number: make(number)
