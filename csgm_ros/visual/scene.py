"""The 3-D scene of a report: points thinned, ordered, quantised and packed; poses, graphs and views as numbers."""

from __future__ import annotations

import base64
import gzip
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from csgm_ros.cloud.prepare import normals_of
from csgm_ros.io.results import SOURCE_TINT, TARGET_TINT
from csgm_ros.types import Similarity
from csgm_ros.visual.pictures import palette, seen_together, turned, upright
from csgm_ros.visual.report_data import ReportData, Segmentation
from csgm_ros.visual.slices import common, frame_of, principal_axes

SHOWN = 200_000  # points of a cloud at most
LEVELS = 8  # each holds as many points as all before it, evenly spread
REACH = 4.0  # inlier distances at which the colour of the distance ends
SLAB = 0.02  # half the thickness of a slice, in radii of the target
FIELD, ASPECT = 40.0, 1.3  # degrees that the view is high, and how much wider it is
COLORS = 64
LIGHT = np.array([0.36, 0.48, 0.8])
LABELLED = 0.06  # of the radius: as near a point must be to a voxel to belong to its supervoxel


@dataclass(frozen=True, eq=False)
class Shown:
    """A cloud as it is drawn.

    Attributes
    ----------
    points, normals : (N, 3) ndarray
        Own unit, in drawing order.
    colors : (N, 3) ndarray or None
        In [0, 1].
    labels : (N,) int ndarray or None
        Supervoxel, -1 for none.
    frame : Similarity
        Own unit to centre 0, radius 1.
    """

    points: np.ndarray
    normals: np.ndarray
    colors: np.ndarray | None
    labels: np.ndarray | None
    frame: Similarity

    @cached_property
    def tree(self) -> cKDTree:
        """Of the points."""
        return cKDTree(self.points)


class Arrays:
    """Named arrays of bytes and 16-bit words in one compressed text; words are cut into planes of bytes."""

    def __init__(self):
        self.index: dict[str, dict] = {}
        self._parts: list[bytes] = []
        self._offset = 0

    def add(self, name: str, values: np.ndarray) -> str:
        """Keep a uint8 or uint16 array under a name, which is returned."""
        values = np.ascontiguousarray(values).ravel()
        wide = values.dtype == np.uint16
        planes = [values & 255, values >> 8] if wide else [values]
        part = b''.join(plane.astype(np.uint8).tobytes() for plane in planes)
        self.index[name] = {'offset': self._offset, 'length': len(values), 'wide': wide}
        self._parts.append(part)
        self._offset += len(part)
        return name

    def packed(self) -> str:
        """Return everything, gzipped, in base64."""
        return base64.b64encode(gzip.compress(b''.join(self._parts), 6, mtime=0)).decode()


def scene(data: ReportData) -> tuple[dict, str, tuple[Shown, Shown]]:
    """Return the scene of a report.

    Returns
    -------
    manifest : dict
        What the page needs to know beside the points; lengths in radii of the target, about its middle.
    arrays : str
        The points, see :class:`Arrays`.
    shown : (Shown, Shown)
        Source and target as they are drawn.
    """
    segmentations = data.segmentations or (None, None)
    source, target = (
        _shown(cloud.points, cloud.colors, segmentation)
        for cloud, segmentation in zip((data.source, data.target), segmentations, strict=True)
    )
    arrays = Arrays()
    axes = _axes(target.frame.apply(target.points))
    poses, before = _poses(data, source, target, arrays)
    manifest = {
        'clouds': {
            'source': _cloud('source', source, SOURCE_TINT, arrays),
            'target': _cloud('target', target, TARGET_TINT, arrays),
        },
        'poses': poses,
        'start': 2,
        'before': before,
        'graphs': _graphs(data, source, target),
        'palette': palette(COLORS).round(3).tolist(),
        'axes': axes.round(6).tolist(),
        'slab': SLAB,
        'field': FIELD,
        'views': _views(data, source, target, axes),
        'arrays': arrays.index,
    }
    return manifest, arrays.packed(), (source, target)


def distances(moving: Shown, still: Shown, transform: Similarity, reach: float, count: int | None = None) -> np.ndarray:
    """Return how far each (or the first ``count``) is from the other cloud's surface; ``reach`` where farther.

    Between its points a surface is taken to go on along their planes, no farther than to the next points.
    """
    tree = still.tree
    gap = 1.5 * float(np.median(tree.query(still.points[:2000], k=2)[0][:, -1]))
    moved = transform.apply(moving.points[:count])
    found, near = tree.query(moved, distance_upper_bound=np.hypot(reach, reach + gap))
    near = np.minimum(near, len(still.points) - 1)  # where there is none, the distance is infinite
    height = ((moved - still.points[near]) * still.normals[near]).sum(1)
    aside = np.sqrt(np.maximum(found**2 - height**2, 0.0))
    return np.minimum(np.hypot(height, np.maximum(aside - gap, 0.0)), reach)


def _shown(points: np.ndarray, colors: np.ndarray | None, segmentation: Segmentation | None) -> Shown:
    kept = np.flatnonzero(np.isfinite(points).all(axis=1))
    rng = np.random.default_rng(0)
    if len(kept) > SHOWN:
        kept = np.sort(rng.choice(kept, SHOWN, replace=False))
    frame = frame_of(points[kept])
    kept = kept[_drawing_order(frame.apply(points[kept]))]
    own = points[kept]
    labels = None
    if segmentation is not None:
        gaps, near = cKDTree(segmentation.points).query(own, distance_upper_bound=LABELLED / frame.scale)
        labels = np.where(np.isfinite(gaps), segmentation.labels[np.minimum(near, len(segmentation.labels) - 1)], -1)
    normals = normals_of(own, min(16, len(own)))
    return Shown(own, normals, None if colors is None else colors[kept], labels, frame)


def _drawing_order(points: np.ndarray) -> np.ndarray:
    """Order points so that any first part is an even sample and that neighbours in order are neighbours in space."""
    cells = np.clip((points + 2.0) * 16, 0, 63).astype(np.int64)
    along = np.argsort(cells @ (4096, 64, 1), kind='stable')
    position = np.arange(len(points))
    level = np.full(len(points), LEVELS)
    for step in range(LEVELS):
        level[position % 2 ** (step + 1) == 2**step] = LEVELS - step
    level[position % 2**LEVELS == 0] = 0
    return along[np.argsort(level, kind='stable')]


def _cloud(name: str, shown: Shown, tint: tuple, arrays: Arrays) -> dict:
    local = shown.frame.apply(shown.points)
    origin = local.min(axis=0)
    step = float(np.ptp(local, axis=0).max()) / 65535 or 1e-9
    light = 0.45 + 0.55 * np.abs(shown.normals @ LIGHT)
    return {
        'positions': arrays.add(f'{name}.positions', np.round((local - origin) / step).astype(np.uint16)),
        'origin': origin.tolist(),
        'step': step,
        'tint': tint,
        'light': arrays.add(f'{name}.light', _bytes(light)),
        'colors': None if shown.colors is None else arrays.add(f'{name}.colors', _bytes(shown.colors)),
        'labels': None
        if shown.labels is None
        else arrays.add(f'{name}.labels', np.where(shown.labels < 0, 255, shown.labels % COLORS).astype(np.uint8)),
    }


def _poses(data: ReportData, source: Shown, target: Shown, arrays: Arrays) -> tuple[list[dict], int]:
    """Poses of the source, first those before registration; and which of these to show."""
    to_view, from_local = target.frame, source.frame.inverse()
    came = to_view @ from_local
    in_sight = seen_together(came)
    first = 'as they came'
    note = 'Both clouds in the units and frames of their files.'
    if not in_sight:
        note += ' They are too different in size or place to be seen together.'
    poses = [
        _pose(first, note, came),
        _pose(
            'before: size and middle matched',
            'What step 1 knows: middle on middle, radius on radius.',
            Similarity.identity(),
        ),
    ]
    reach = REACH * data.inlier_distance
    for rank, pose in enumerate(data.poses):
        shares = f'{pose.fitness_source:.0%} of the source and {pose.fitness_target:.0%} of the target'
        said = f'{shares} lie on the other' + (
            f'; it fits {pose.ratio:.2f} times as well as the answer.' if rank else '.'
        )
        name = f'competing hypothesis {rank}'
        if rank == 0:
            name = 'registered: the answer' if data.accepted else 'best found, but rejected'
        made = _pose(name, said, to_view @ pose.transform @ from_local)
        forth = distances(source, target, pose.transform, reach)
        back = distances(target, source, pose.transform.inverse(), reach / pose.transform.scale)
        made['errors'] = {
            'source': arrays.add(f'source.error.{rank}', _bytes(forth / reach)),
            'target': arrays.add(f'target.error.{rank}', _bytes(back * pose.transform.scale / reach)),
        }
        poses.append(made)
    return poses, 0 if in_sight else 1


def _pose(name: str, note: str, transform: Similarity) -> dict:
    return {'name': name, 'note': note, 'matrix': transform.matrix.tolist()}


def _graphs(data: ReportData, source: Shown, target: Shown) -> dict | None:
    if data.graphs is None:
        return None
    made = {
        name: {
            'nodes': shown.frame.apply(graph.nodes).round(5).tolist(),
            'edges': np.unique(np.sort(graph.edges, axis=1), axis=0).tolist(),
            'tint': [0.55 * value for value in tint],
        }
        for name, graph, shown, tint in zip(
            ('source', 'target'), data.graphs, (source, target), (SOURCE_TINT, TARGET_TINT), strict=True
        )
    }
    # those made without knowing the answer tell what was right of them, in the same colours
    matches = np.unique(np.concatenate([data.matches, data.unguided_matches]), axis=0)
    return {**made, 'matches': matches.tolist(), 'inlier_distance': data.match_distance * target.frame.scale}


def _axes(points: np.ndarray) -> np.ndarray:
    """Return the principal axes of points as rows, the longest first, the last towards z."""
    axes = principal_axes(points)
    axes[2] *= np.sign(axes[2, 2]) or 1.0
    axes[0] = np.cross(axes[1], axes[2])
    return axes


def _views(data: ReportData, source: Shown, target: Shown, axes: np.ndarray) -> dict:
    """Return where to look from: right and down of the screen, the middle, and the distance."""
    moved = data.poses[0].transform.apply(source.points[:20_000])
    both = [target.frame.apply(cloud) for cloud in (target.points[:20_000], moved)]
    points = np.concatenate(both)
    low, high = common(*both)
    points = points[((points >= low) & (points <= high)).all(axis=1)]
    views = {'start': turned(upright(target.points), 28, 28)}
    for k in range(3):
        right, down = axes[(k + 1) % 3], -axes[(k + 2) % 3]
        if k < 2:  # keep the third axis upwards
            right, down = axes[1 - k], -axes[2]
        views[f'along{k}'] = np.array([right, down, np.cross(right, down)])
    return {name: _framed(rows, points) for name, rows in views.items()}


def _framed(rows: np.ndarray, points: np.ndarray) -> dict:
    """Return a view that all of (N, 3) points but a few outliers fill; ``rows`` are right, down and into the page."""
    low, high = np.quantile(points @ rows.T, (0.01, 0.99), axis=0)
    width, height, depth = high - low
    distance = 1.06 * max(width / ASPECT, height) / (2 * np.tan(np.radians(FIELD / 2))) + depth / 2
    center = rows.T @ ((low + high) / 2)
    right, down = rows[:2].tolist()
    return {'right': right, 'down': down, 'distance': distance, 'center': center.tolist(), 'width': width}


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.round(255 * np.clip(values, 0.0, 1.0)).astype(np.uint8)
