"""A picture of where a sensor has been, and of where it was believed to be."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from csgm_ros.io.atomic import replacing

GAP = 1.0  # seconds without a frame that break a line


def draw_paths(
    path: str | Path,
    map_points: np.ndarray,
    stamps: np.ndarray,
    truth: np.ndarray,
    estimate: np.ndarray,
    blocked: np.ndarray,
    caption: str,
) -> None:
    """Draw the map from above with both paths, and the distance between them over time.

    Parameters
    ----------
    path : str or Path
        A .png to write.
    map_points : (M, 3) ndarray
        Metres, z up.
    stamps : (F,) ndarray
        Seconds.
    truth, estimate : (F, 3) ndarray
        Places of the sensor; NaN where none was given.
    blocked : (F,) bool ndarray
        Frames that saw nothing.
    caption : str
        One line under the picture.
    """
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot

    figure, (above, beside) = pyplot.subplots(1, 2, figsize=(13, 6.2), dpi=90, width_ratios=(1.25, 1))
    height = map_points[:, 2]
    low, high = np.quantile(map_points[:, :2], (0.01, 0.99), axis=0)
    inside = ((map_points[:, :2] > low - 0.3) & (map_points[:, :2] < high + 0.3)).all(1)
    above.scatter(*map_points[inside, :2].T, c=height[inside], s=0.5, cmap='Greys', vmin=-1.5, vmax=3.0, lw=0)
    broken = np.flatnonzero(np.diff(stamps) > GAP) + 1
    for k, part in enumerate(np.split(np.arange(len(stamps)), broken)):
        label = None if k else 'true path'
        above.plot(*truth[part, :2].T, color='#1f6fb4', lw=6, alpha=0.35, label=label, solid_capstyle='round')
        lines = np.where(blocked[part, None], np.nan, estimate[part])
        above.plot(*lines[:, :2].T, color='#e8731a', lw=2, label=None if k else 'given out by the node')
        beside.plot(stamps[part], 100 * np.linalg.norm(lines - truth[part], axis=1), color='#e8731a', lw=1.5)
    if blocked.any():
        above.plot(*truth[blocked, :2].T, 'x', color='#b02020', ms=5, label='sensor covered')
    for text, number in [('start', 0), *(('put here', int(k)) for k in broken)]:
        above.annotate(text, truth[number, :2], (6, -14), textcoords='offset points', fontsize=10)
        above.plot(*truth[number, :2], 'o', color='#1f6fb4', ms=7)
    none = np.isnan(estimate[:, 0])
    for begin, end in _stretches(none, stamps):
        beside.axvspan(begin, end, color='#dddddd', lw=0)
    beside.set(xlabel='time, s', ylabel='distance from the truth, cm', title='grey: lost, nothing is given out')
    beside.set_ylim(bottom=0.0)
    above.set(xlabel='m', ylabel='m', aspect='equal', title='the map from photos, from above')
    above.legend(loc='upper center', bbox_to_anchor=(0.5, -0.1), ncols=3, fontsize=9, frameon=False)
    figure.text(0.5, 0.015, caption, ha='center', fontsize=10, color='#333333', family='monospace')
    figure.subplots_adjust(left=0.06, right=0.98, top=0.93, bottom=0.18, wspace=0.16)
    with replacing(path) as file:
        figure.savefig(file, format='png')
    pyplot.close(figure)


def _stretches(flags: np.ndarray, stamps: np.ndarray) -> list[tuple[float, float]]:
    """Return begin and end of each run of true flags, and of each gap between the stamps."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False])).astype(int))).reshape(-1, 2)
    gaps = [(k, k + 1) for k in np.flatnonzero(np.diff(stamps) > GAP)]
    last = len(stamps) - 1
    return [(float(stamps[int(a)]), float(stamps[min(int(b), last)])) for a, b in [*edges.tolist(), *gaps]]
