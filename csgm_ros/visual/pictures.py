"""Pictures of clouds that a person can judge: points drawn with a depth buffer, laid out with matplotlib."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from csgm_ros.config import profile
from csgm_ros.io.atomic import replacing
from csgm_ros.io.cloud_file import CloudFile
from csgm_ros.io.results import SOURCE_TINT, TARGET_TINT
from csgm_ros.types import Similarity, Supervoxels
from csgm_ros.visual.slices import common, frame_of, principal_axes, slices

PAPER = np.array([1.0, 1.0, 1.0])
STRAY = 0.15  # of the extent of all but a few points: what lies farther out does not make the rest smaller


def before_after(path: str | Path, source: CloudFile, target: CloudFile, transform: Similarity, caption: str) -> None:
    """Draw both clouds as they came, the source moved onto the target from several sides, and slices.

    Parameters
    ----------
    path : str or Path
        A .png to write.
    source, target : CloudFile
        Rows that are not finite are left out.
    transform : Similarity
        From source to target.
    caption : str
        One line under the picture.
    """
    source, target = finite(source), finite(target)
    moved = CloudFile(transform.apply(source.points), source.colors)
    meeting = [_within(cloud, *common(moved.points, target.points)) for cloud in (target, moved)]
    laid = [_tinted(meeting[0], TARGET_TINT), _tinted(meeting[1], SOURCE_TINT)]
    title, came = 'before: both as they came, source orange, target blue', source
    frames = frame_of(source.points), frame_of(target.points)
    if not seen_together(frames[1] @ frames[0].inverse()):
        title = 'before: size matched, source orange, target blue'
        came = CloudFile((frames[1].inverse() @ frames[0]).apply(source.points), source.colors)
    raw = [_tinted(target, TARGET_TINT), _tinted(came, SOURCE_TINT)]
    front = upright(target.points)
    above, oblique = np.array([front[0], -front[2], front[1]]), turned(front, 28, 22)
    panels = [
        ('before: the source, in a unit and pose of its own', [source], upright(source.points)),
        ('before: the target', [target], oblique),
        (title, raw, oblique),
        ('after: the source on the target', laid, oblique),
        ('after, from above', laid, above),
        ('after, in their own colours', meeting, oblique),
    ]
    drawn = [(title, draw(clouds, view)) for title, clouds, view in panels]
    drawn += [(f'{title}: dark where both are', pixels) for title, pixels in slices(moved.points, target.points)]
    _write(path, drawn, 3, caption)


def seen_together(came: Similarity) -> bool:
    """Tell whether one picture shows both clouds; ``came`` goes from the source's frame of radius 1 to the target's."""
    return 0.1 < came.scale < 10.0 and float(np.linalg.norm(came.translation)) < 6.0


def supervoxels(path: str | Path, clouds: Sequence[tuple[str, Supervoxels | None]]) -> None:
    """Draw clouds in the colours of their supervoxels, grey where there is none.

    Parameters
    ----------
    path : str or Path
        A .png to write.
    clouds : sequence of (str, Supervoxels or None)
        With titles; None where a cloud has too little structure.
    """
    drawn = []
    for name, cloud in clouds:
        if cloud is None:
            drawn.append((f'{name}: too little structure', np.ones((430, 560, 3))))
            continue
        hues = palette(max(len(cloud), 1))
        colors = np.where(cloud.voxel_labels[:, None] < 0, 0.8, hues[cloud.voxel_labels])
        view = turned(principal_axes(cloud.voxel_points), 25, 25)
        drawn.append((f'{name}: {len(cloud)} supervoxels', draw([_enlarged(cloud.voxel_points, colors)], view)))
    _write(path, drawn, min(len(drawn), 3), 'each colour is a supervoxel, a node of the graph')


def palette(count: int) -> np.ndarray:
    """Return (count, 3) colours of which neighbours in order are far apart in hue."""
    turns = np.arange(count) * 0.6180339887
    return np.array(
        [
            colorsys.hsv_to_rgb(turn % 1.0, 0.45 + 0.4 * (k % 3) / 2, 0.95 - 0.3 * (k % 2))
            for k, turn in enumerate(turns)
        ]
    )


def _enlarged(points: np.ndarray, colors: np.ndarray) -> CloudFile:
    """Fill voxels, of a cloud of radius 1, as densely as pixels are."""
    edge = profile().supervoxels.voxel_size
    steps = np.linspace(-edge / 2, edge / 2, 5)
    offsets = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    return CloudFile((points[:, None] + offsets).reshape(-1, 3), np.repeat(colors, len(offsets), axis=0))


def _write(path: str | Path, drawn: list[tuple[str, np.ndarray]], columns: int, caption: str) -> None:
    """Lay titled pictures out in rows and write them with few colours."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    rows = -(-len(drawn) // columns)
    height = 4.5 * rows + 0.7
    figure = Figure(figsize=(5 * columns, height), dpi=80, facecolor='white')
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes:
        axis.set_axis_off()
    for axis, (title, pixels) in zip(axes, drawn, strict=False):
        axis.imshow(pixels, interpolation='lanczos')
        axis.set_title(title, fontsize=12, color='#333333')
    figure.text(0.5, 0.2 / height, caption, ha='center', fontsize=12, color='#333333', family='monospace')
    edges = {'top': 1 - 0.5 / height, 'bottom': 0.6 / height}
    figure.subplots_adjust(left=0.01, right=0.99, wspace=0.02, hspace=0.08, **edges)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[..., :3]
    with replacing(path) as file:
        Image.fromarray(pixels).quantize(256, dither=Image.Dither.NONE).save(file, 'png', optimize=True)


def draw(clouds: list[CloudFile], view: np.ndarray, size: tuple[int, int] = (430, 560)) -> np.ndarray:
    """Draw clouds from one side, nearer points over farther ones, shaded by depth.

    Parameters
    ----------
    clouds : list of CloudFile
    view : (3, 3) ndarray
        Rows: the directions right, down and away from the eye.
    size : (int, int)
        Height and width in pixels.

    Returns
    -------
    (H, W, 3) ndarray
        In [0, 1].
    """
    points = np.concatenate([cloud.points for cloud in clouds]) @ view.T
    colors = np.concatenate([shades(cloud, TARGET_TINT) if cloud.colors is None else cloud.colors for cloud in clouds])
    low, high = _span(points)
    height, width = size
    step = max((high[0] - low[0]) / (width - 20), (high[1] - low[1]) / (height - 20), 1e-12)
    pixel = np.round((points[:, :2] - (low[:2] + high[:2]) / 2) / step + (width / 2, height / 2)).astype(int)
    fade = np.clip((points[:, 2] - low[2]) / max(high[2] - low[2], 1e-12), 0, 1)[:, None]
    colors = colors * (1 - 0.35 * fade) + PAPER * 0.35 * fade
    order = np.argsort(-points[:, 2], kind='stable')
    image = np.tile(PAPER, (height, width, 1))
    for dy, dx in ((1, 1), (1, 0), (0, 1), (0, 0)):
        u, v = pixel[order, 0] + dx, pixel[order, 1] + dy
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        image[v[inside], u[inside]] = colors[order][inside]
    return image


def _span(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of a box around points, blind to a few far outliers."""
    low, high = np.quantile(points, (0.004, 0.996), axis=0)
    slack = STRAY * (high - low)
    return np.maximum(points.min(axis=0), low - slack), np.minimum(points.max(axis=0), high + slack)


def upright(points: np.ndarray) -> np.ndarray:
    """Return a view of finite points from the front, (3, 3), rows as of :func:`draw`.

    In an optical frame (z ahead, y down, REP-103) it is that of the sensor. A cloud in any other frame is taken to be
    flat, as places are, and its shortest principal axis to be the vertical, up where z goes up.
    """
    middle, ahead = np.median(points, axis=0), points[:, 2] > 0
    if ahead.mean() > 0.99 and np.linalg.norm(middle) * frame_of(points).scale > 1.0:
        return np.eye(3)
    right, _, up = principal_axes(points)
    up = up * (np.sign(up[2]) or 1.0)
    return np.array([right, -up, np.cross(right, -up)])


def finite(cloud: CloudFile) -> CloudFile:
    """Return a cloud without the rows that are not finite, and without normals."""
    keep = np.isfinite(cloud.points).all(axis=1)
    return CloudFile(cloud.points[keep], None if cloud.colors is None else cloud.colors[keep])


def _within(cloud: CloudFile, low: np.ndarray, high: np.ndarray) -> CloudFile:
    keep = ((cloud.points >= low) & (cloud.points <= high)).all(axis=1)
    return CloudFile(cloud.points[keep], None if cloud.colors is None else cloud.colors[keep])


def shades(cloud: CloudFile, tint: tuple[float, float, float]) -> np.ndarray:
    """Return the (N, 3) colours of a cloud in one tint, its own brightness kept a little where it has one."""
    brightness = 0.8 if cloud.colors is None else 0.55 + 0.6 * cloud.colors.mean(axis=1, keepdims=True)
    return np.clip(np.tile(tint, (len(cloud.points), 1)) * brightness, 0, 1)


def _tinted(cloud: CloudFile, tint: tuple[float, float, float]) -> CloudFile:
    return CloudFile(cloud.points, shades(cloud, tint))


def turned(view: np.ndarray, yaw: float, pitch: float) -> np.ndarray:
    """Return a view from further right (yaw) and from further above (pitch), degrees."""
    cy, sy = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    cp, sp = np.cos(np.radians(pitch)), np.sin(np.radians(pitch))
    around = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    over = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    return over @ around @ view
