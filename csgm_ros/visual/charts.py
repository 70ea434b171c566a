"""The small pictures of a report, as data that a page can hold."""

from __future__ import annotations

import base64
import io

import numpy as np

LARGEST = 480  # pixels of the side of a matrix
SIZE = 3.9, 2.9  # inches of a chart: its letters are as large as those of the page


def png(pixels: np.ndarray, colors: int = 128) -> str:
    """Return an (H, W, 3) picture in [0, 1] as the source of an <img>."""
    from PIL import Image

    image = Image.fromarray(np.round(255 * np.clip(pixels, 0, 1)).astype(np.uint8))
    buffer = io.BytesIO()
    image.quantize(colors, dither=Image.Dither.NONE).save(buffer, 'PNG', optimize=True)
    return 'data:image/png;base64,' + base64.b64encode(buffer.getvalue()).decode()


def matrix(values: np.ndarray) -> str:
    """Return a matrix as a picture: dark is its smallest value, yellow its largest."""
    from matplotlib import colormaps

    values = np.asarray(values, float)
    for axis in (0, 1):  # means of blocks, as pixels of one value would hide how the others are
        block = -(-values.shape[axis] // LARGEST)
        values = np.add.reduceat(values, np.arange(0, values.shape[axis], block), axis=axis) / block
    low, high = values.min(initial=0.0), values.max(initial=0.0)
    pixels = colormaps['viridis']((values - low) / ((high - low) or 1.0))[..., :3]
    zoom = max(1, LARGEST // max(*values.shape, 1) // 2)
    return png(pixels.repeat(zoom, axis=0).repeat(zoom, axis=1))


def curve(points: np.ndarray, x: str, y: str) -> str:
    """Return an (n, 2) curve as inline SVG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE, layout='constrained')
    axes = figure.add_subplot(xlabel=x, ylabel=y)
    axes.plot(*points.T, marker='.', color='#1f78b5')
    axes.grid(alpha=0.3)
    return _svg(figure)


def histogram(named: dict[str, tuple[np.ndarray, str]], reach: float, inlier_distance: float) -> str:
    """Return the distances of both clouds as inline SVG; ``inlier_distance`` is marked."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE, layout='constrained')
    axes = figure.add_subplot(xlabel='distance to the other cloud (unit of the target)', ylabel='share of the points')
    for name, (values, color) in named.items():
        near = values[values < reach]
        label = f'{name}, {(values < inlier_distance).mean():.0%} left of the line'
        weights = np.full(len(near), 1 / len(values))
        axes.hist(near, bins=60, range=(0.0, reach), weights=weights, histtype='step', color=color, label=label)
    axes.axvline(inlier_distance, color='#222222', lw=1, ls='--')
    axes.legend(fontsize=9)
    return _svg(figure)


def _svg(figure) -> str:
    import matplotlib

    buffer = io.StringIO()
    with matplotlib.rc_context({'svg.fonttype': 'none', 'svg.hashsalt': 'csgm'}):
        figure.savefig(buffer, format='svg', metadata={'Date': None})
    text = buffer.getvalue()
    return text[text.index('<svg') :]
