"""The few plots of the results, each one panel with one curve a method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np


def curves(
    path: Path, lines: Mapping[str, Sequence[tuple[float, float]]], x_label: str, y_label: str, *, log_x: bool = False
) -> None:
    """Draw (x, y) points per method as lines into a PNG file; the product's own line is the thick one."""
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6, 3.6), dpi=80)
    for name, points in lines.items():
        x, y = np.array(sorted(points)).T
        own = name.startswith('csgm')
        axes.plot(x, y, 'o-', label=name, linewidth=2.5 if own else 1.0, markersize=3, zorder=3 if own else 2)
    axes.set(xlabel=x_label, ylabel=y_label, xscale='log' if log_x else 'linear')
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path)
    pyplot.close(figure)
