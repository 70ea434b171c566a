"""Harder than the paper: Database C with one difficulty at a time, success against its strength."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import harness, meshes, plots, tables
from benchmarks.datasets import database_c_pair

METHODS = ('csgm', 'fgr+sicp', 'ransac-scale+sicp', 'kiss+sicp')
SWEEPS: dict[str, tuple[str, list[tuple[float, dict[str, object]]]]] = {
    'separation': (
        'angle between the views, degrees',
        [(angle, {'separation_deg': float(angle)}) for angle in (30, 45, 60, 75, 90, 105, 120)],
    ),
    'density': (
        'points kept in the second view, one of',
        [(ratio, {'keep_every': float(ratio)}) for ratio in (1, 3, 10, 20, 30)],
    ),
    'noise': ('signal to noise, dB', [(level, {'noise_db': float(level)}) for level in (50, 40, 35, 30, 25, 20)]),
    'outliers': (
        'clutter, % of the source',
        [(share, {'clutter_share': share / 100}) for share in (0, 10, 20, 30, 40, 50, 60)],
    ),
    'scale': (
        'source units per target unit',
        [(scale, {'scale_range': (scale, scale), 'rotation_deg': None}) for scale in (0.05, 0.2, 1.0, 5.0, 20.0)],
    ),
}


def main() -> None:
    parser = harness.parser(__doc__, METHODS)
    parser.set_defaults(seeds=[0])
    parser.add_argument('--sweeps', nargs='+', choices=tuple(SWEEPS), default=list(SWEEPS), help='default: all')
    options = parser.parse_args()
    names = harness.mesh_names(options.meshes)
    if options.quick:
        names = names[:1]
    cases = []
    for sweep in options.sweeps:
        values = SWEEPS[sweep][1]
        for value, changes in values[:: len(values) - 1] if options.quick else values:
            mine = [(name, seed) for seed in options.seeds for name in names]
            cases += [
                harness.Case(f'{sweep} {value:g}', _maker(name, seed, changes))
                for name, seed in mine[: options.pairs or None]
            ]
    rows = harness.run_all('stress', cases, options)
    tables.report('stress', 'Harder than the paper', summary(rows, options.results), options.results)


def _maker(name: str, seed: int, changes: dict[str, object]):
    return lambda: database_c_pair(meshes.load(name), seed, **changes)


def summary(rows: list[harness.Row], folder: Path) -> str:
    """Return one table and one plot per sweep: share of pairs within 0.02 (0.05) of the radius."""
    parts = [
        'Share of pairs with RMSE/r below 0.02, below 0.05 in brackets. Clutter is uniform in the ball around the '
        'source, beside the outliers of the recipe; the sweep over the scale draws any rotation.'
    ]
    for sweep, runs in tables.grouped(
        [{**row, 'sweep': str(row['setting']).split()[0]} for row in rows], 'sweep'
    ).items():
        label = SWEEPS[sweep][0]
        file = folder / f'stress_{sweep}.png'
        methods = tables.grouped(runs, 'method')
        plots.curves(
            file,
            {method: _curve(of_method) for method, of_method in methods.items()},
            label,
            'pairs within 0.02 of the radius, %',
            log_x=sweep in ('density', 'scale'),
        )
        settings = list(tables.grouped(runs, 'setting'))
        lines = [(method, *(_cell(of_method, name) for name in settings)) for method, of_method in methods.items()]
        count = len(runs) // len(methods) // len(settings)
        header = (label, *(name.split()[1] for name in settings))
        parts += [f'{sweep.capitalize()}, {count} pairs each:', tables.table(header, lines)]
        parts += [_judged(runs, settings), f'![{sweep}](results/{file.name})']
    return '\n\n'.join(part for part in parts if part)


def _cell(runs: list[harness.Row], setting: str) -> str:
    own = [row for row in runs if row['setting'] == setting]
    return f'{tables.percent(own, "right_tight")} ({tables.percent(own, "right_loose")})'


def _judged(runs: list[harness.Row], settings: list[str]) -> str:
    """Say what the product's verdict made of each setting."""
    own = [row for row in runs if row['method'] == 'csgm']
    if not own:
        return ''
    counts = [tables.verdict_counts([row for row in own if row['setting'] == name]) for name in settings]
    return f'Verdict of `csgm` (accepted / wrong / missed): {"; ".join(counts)}.'


def _curve(runs: list[harness.Row]) -> list[tuple[float, float]]:
    groups = tables.grouped(runs, 'setting').items()
    points = [(name, tables.numbers(group, 'right_tight')) for name, group in groups]
    return [(float(name.split()[1]), 100 * sum(values) / len(values)) for name, values in points]


if __name__ == '__main__':
    main()
