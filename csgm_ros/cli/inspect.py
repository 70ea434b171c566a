"""What a cloud is like, before it is registered, and what to expect of two."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from csgm_ros.cloud.cells import cells, working_size
from csgm_ros.cloud.outliers import without_extremes
from csgm_ros.cloud.pattern import Pattern, pattern
from csgm_ros.cloud.plane_fit import fit_planes
from csgm_ros.cloud.prepare import MIN_POINTS
from csgm_ros.cloud.surface_variation import even, surface_variation
from csgm_ros.cloud.survey import survey
from csgm_ros.cloud.thin import parts_of
from csgm_ros.config import SupervoxelConfig, parameter_fields, profile
from csgm_ros.errors import CsgmError, DegenerateCloudError
from csgm_ros.scale import radius
from csgm_ros.structure.extract import cut
from csgm_ros.types import Supervoxels

LARGEST_VOXEL = parameter_fields(SupervoxelConfig)['voxel_size'].metadata['high']
SAMPLES = 5000  # points whose neighbours are asked
CELLS, MOST_CELLS = 4000, 40_000
ON_PLANE = 1.5  # cells
LOOSE = 0.005  # of the surface: held by less along some direction, a cloud slides there (corridors, walls, pipes do)
FEW_NODES = 15
FAR = 20.0  # radii from the origin, beyond which coordinates are those of a map
SENSOR_RANGE = 0.3, 300.0  # radius of what a depth sensor or lidar sees, metres
QUANTA = (1.0, 0.1, 0.01, 0.001, 0.0001)


@dataclass(frozen=True, eq=False)
class Inspection:
    """What was found about one cloud; lengths in its own unit.

    Attributes
    ----------
    total, not_finite, repeated : int
        Points; of a large cloud, how many are repeated is estimated.
    extent : (3,) ndarray
    radius, spacing, noise : float
        Largest distance to the centroid; median distances to the nearest neighbour and off the local plane.
    metric : bool or None
        Whether the unit is the metre; None where nothing tells.
    unit : str
        The unit and why.
    planes : tuple of float
        Shares of the surface on its dominant planes.
    held : float
        How much of the surface stops the cloud from sliding along the direction held least: the mean squared cosine of
        the normals with it. 1/3 where all directions are held alike, 0 along a corridor without ends.
    loosest : (3,) ndarray
        That direction.
    pattern : Pattern
    variation : float
        Surface variation at an even density.
    supervoxels : Supervoxels or None
        None where the cloud has too little structure.
    """

    total: int
    not_finite: int
    repeated: int
    extent: np.ndarray
    radius: float
    spacing: float
    noise: float
    metric: bool | None
    unit: str
    planes: tuple[float, ...]
    held: float
    loosest: np.ndarray
    pattern: Pattern
    variation: float
    supervoxels: Supervoxels | None

    @property
    def nodes(self) -> int:
        """Supervoxels with the default parameters."""
        return 0 if self.supervoxels is None else len(self.supervoxels)


def inspect(points: np.ndarray) -> Inspection:
    """Look at a cloud.

    Parameters
    ----------
    points : (N, 3) ndarray
        Any unit; rows that are not finite are left out.

    Raises
    ------
    DegenerateCloudError
        When all points are in one place.
    """
    return inspect_parts(parts_of(points), len(points))


def inspect_parts(parts: Iterable[np.ndarray], rows: int) -> Inspection:
    """Look at a cloud of so many rows part by part, as at one larger than memory; else see :func:`inspect`."""
    from scipy.spatial import cKDTree

    config = profile()
    seen = survey(parts, rows, config.preprocess.max_points, config.threads or os.cpu_count() or 1)
    first = _distinct(seen.places)
    distinct = seen.places[first]
    whole = distinct if seen.places is seen.points else seen.points
    if len(distinct) < 2 or len(whole) < 2:
        raise DegenerateCloudError('all points are in one place; record the cloud again')
    inner_places = distinct[seen.inner[first]]
    sample = inner_places[np.random.default_rng(0).permutation(len(inner_places))[:SAMPLES]]
    # a tree as quick to build as can be: it is asked some thousand times
    tree = cKDTree(distinct, balanced_tree=False, compact_nodes=False)
    spacings = tree.query(sample, k=2)[0][:, 1]
    inner = without_extremes(whole)
    length = radius(inner)
    found = pattern(distinct if seen.drawn is seen.places else seen.drawn, spacings)
    shares, held, loosest = _planes(inner)
    metric, unit = _unit(distinct, length, found)
    return Inspection(
        total=seen.total,
        not_finite=seen.total - seen.finite,
        repeated=round((1.0 - len(distinct) / len(seen.places)) * seen.finite),
        extent=seen.high - seen.low,
        radius=length,
        spacing=float(np.median(spacings)),
        noise=float(np.median(fit_planes(distinct, 12, sample[:1000]).extents()[:, 0])),
        metric=metric,
        unit=unit,
        planes=shares,
        held=held,
        loosest=loosest,
        pattern=found,
        variation=surface_variation(even(inner, length)),
        supervoxels=_supervoxels(inner, length),
    )


def description(found: Inspection) -> str:
    """Return an inspection as lines for a person, the suggested parameters last."""
    default = profile().supervoxels.voxel_size
    extent, ratio = found.extent, found.spacing / found.radius
    spread = {'depth grid': 'a depth image of about {} x {} pixels', 'lidar rings': 'about {} rings of a lidar'}
    how = spread.get(found.pattern.kind, f'{found.pattern.kind} density, no rows of a sensor at the origin')
    planes = ', '.join(f'{share:.0%}' for share in found.planes) or 'none'
    lines = [
        f'points   {found.total} ({found.not_finite} not finite, {found.repeated} repeated)',
        f'extent   {extent[0]:.4g} x {extent[1]:.4g} x {extent[2]:.4g}',
        f'radius   {found.radius:.4g} (largest distance to the centroid: the unit of the relative lengths)',
        f'unit     {found.unit}',
        f'spacing  {found.spacing:.4g} (median distance to the nearest neighbour) = {ratio:.4f} radii',
        f'pattern  {how.format(*found.pattern.size)}',
        f'planes   {planes} of the surface',
        f'held     {found.held:.3f} along {vector(found.loosest)}, where least of it stops a slide; 1/3 is even',
        f'noise    {found.noise:.3g} off the local plane; surface variation {found.variation:.2f}, 0 flat, 1 none',
        f'voxel    supervoxels.voxel_size {default:g} is {default * found.radius:.4g} in the unit of this cloud',
        f'nodes    about {found.nodes} supervoxels with the default parameters',
    ]
    return '\n'.join([*lines, *(f'suggest  {text}' for text in suggestions(found))])


def suggestions(found: Inspection) -> list[str]:
    """Return the parameters that suit a cloud, a line each."""
    default = profile().supervoxels.voxel_size
    voxel = min(max(default, round(2 * found.spacing / found.radius, 3)), LARGEST_VOXEL)
    lines = []
    if voxel > default:
        lines.append(f'--set supervoxels.voxel_size={voxel:g}: the cloud is sparser than two points a voxel')
    if found.nodes < FEW_NODES:
        lines.append('a cloud of more structure: so few supervoxels carry no graph, and planes must find it alone')
    return lines or ['the defaults suit this density']


def expectation(source: Inspection, target: Inspection) -> str:
    """Return what to expect of a pair, lines for a person."""
    config = profile()
    start = target.radius / source.radius
    factor, wide = config.hypotheses.scale_factor, config.hypotheses.plane_scale_factor
    lines = [
        f'scale    {start:.4g} target units per source unit by the radii, Eq. (1); searched from '
        f'{start / factor:.3g} to {start * factor:.3g}, by planes from {start / wide:.3g} to {start * wide:.3g}'
    ]
    if source.metric and target.metric:
        lines.append('suggest  --set scale.estimate_scale=false: both seem to be in metres')
    ratio = (source.spacing / source.radius) / (target.spacing / target.radius)
    name, times = ('source', ratio) if ratio > 1 else ('target', 1 / ratio)
    lines.append(f'density  the {name} is {times:.1f} times as sparse for its size: it decides what can be told apart')
    name, loose = min(('source', source), ('target', target), key=lambda each: each[1].held)
    if loose.held < LOOSE:
        lines.append(f'expect   ambiguous: next to nothing stops a slide along {vector(loose.loosest)} of the {name}')
    limit = config.preprocess.max_surface_variation
    if max(source.variation, target.variation) > limit:
        rough = f'one is rougher than preprocess.max_surface_variation ({limit:g})'
        lines.append(f'expect   attempts on smoothed clouds, where the first is not certain: {rough}')
    if min(source.nodes, target.nodes) < FEW_NODES:
        lines.append('expect   little from the graph: a cloud of so few supervoxels has none worth matching')
    return '\n'.join([*lines, 'overlap  cannot be told before; a fifth of the larger cloud is about the least'])


def _unit(points: np.ndarray, length: float, found: Pattern) -> tuple[bool | None, str]:
    """Guess the unit from what sensors, exporters and maps leave in numbers."""
    if np.linalg.norm(points.mean(axis=0)) > FAR * length and np.abs(points).max() > 1e4:
        return True, 'metres, probably: coordinates of a map, far from their origin'
    quantum = next((q for q in QUANTA if _multiples(points, q)), None)
    if quantum == 1.0 and length > 50.0:
        return False, 'millimetres, probably: every coordinate is a whole number'
    if found.size and SENSOR_RANGE[0] < length < SENSOR_RANGE[1]:
        return True, f'metres, probably: {found.kind} with the reach of a sensor'
    if found.size and 1e3 * SENSOR_RANGE[0] < length:
        return False, f'millimetres, probably: {found.kind}, whose reach in metres no sensor has'
    if quantum is not None and quantum < 1.0:
        return True, f'metres, probably: coordinates are multiples of {quantum:g}, as a survey stores them'
    return None, 'unknown: nothing in the numbers tells it; a model from photos has a unit of its own'


def _multiples(points: np.ndarray, quantum: float) -> bool:
    values = points[:SAMPLES].ravel() / quantum
    return bool((np.abs(values - np.round(values)) < 1e-6 * np.maximum(1.0, np.abs(values))).mean() > 0.999)


def vector(direction: np.ndarray) -> str:
    """Return a direction of either sign as text, its largest component positive."""
    return '({:.2f}, {:.2f}, {:.2f})'.format(*(direction * np.sign(direction[np.argmax(np.abs(direction))]) + 0.0))


def _planes(points: np.ndarray) -> tuple[tuple[float, ...], float, np.ndarray]:
    """Return the share of the surface on each dominant plane, and how much holds which direction least."""
    if len(points) < MIN_POINTS:
        return (), 0.0, np.array([1.0, 0.0, 0.0])
    size = working_size(points, CELLS)
    occupied = cells(points, size, MOST_CELLS, np.random.default_rng(0))
    shares: list[float] = []
    for plane in occupied.planes:
        near = np.abs((occupied.points - plane.point) @ plane.normal) < ON_PLANE * size
        shares.append(float((near & (np.abs(occupied.normals @ plane.normal) > 0.85)).mean()))
    normals = occupied.normals[occupied.normals.any(axis=1)]
    held, directions = np.linalg.eigh(normals.T @ normals / max(len(normals), 1))
    return tuple(shares), float(max(held[0], 0.0)), directions[:, 0]


def _supervoxels(points: np.ndarray, length: float) -> Supervoxels | None:
    try:
        return cut((points - points.mean(axis=0)) / length, profile())
    except CsgmError:
        return None


def _distinct(points: np.ndarray) -> np.ndarray:
    """Return where each different point is first; rows are told apart by 64 bits, sorted ten times as fast."""
    bits = np.ascontiguousarray(points + 0.0).view(np.uint64)  # -0.0 is 0.0
    mixed = np.zeros(len(points), np.uint64)
    for column in bits.T:
        mixed = (mixed ^ column) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(32)
    return np.sort(np.unique(mixed, return_index=True)[1])
