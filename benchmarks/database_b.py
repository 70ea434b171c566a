"""Database B, real Kinect and SfM clouds with ground truth, beside the peers; also by the rule of 3DCSR."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import harness, metrics, tables
from benchmarks.datasets import Pair, moved, overlaps, real_names, real_pair

METHODS = ('csgm', 'fgr+sicp', 'ransac+sicp', 'ransac-scale+sicp', 'kiss+sicp', 'teaser+sicp', 'gicp', 'cpd')
MIN_OVERLAP = 0.3
"""Share of either cloud that lies on the other, from which the clouds of two windows count as a pair."""


def main() -> None:
    parser = harness.parser(__doc__, METHODS)
    parser.set_defaults(seeds=[0])
    parser.add_argument('--cross', action='store_true', help='also the SfM cloud of one window to the Kinect of others')
    options = parser.parse_args()
    if not real_names():
        print('skipped: no real pairs; CSGM_SHARED must name the folder that holds data/kinect_sfm')
        return
    names = real_names()[:2] if options.quick else real_names()
    cases = [harness.Case('same window', _maker(name, name, seed)) for seed in options.seeds for name in names]
    if options.cross:
        cases += [harness.Case('other window', _maker(*names, 0)) for names in cross_pairs(names)]
    rows = harness.run_all('database_b', cases[: options.pairs or None], options)
    tables.report('database_b', 'Database B: real pairs', summary(rows), options.results)


def _maker(source: str, target: str, seed: int):
    """Seed 0 is the pair as it is; every other seed moves the source by a random similarity first."""

    def make() -> Pair:
        one, other = real_pair(source), real_pair(target)
        name = source if source == target else f'{source}|{target}'
        pair = Pair(f'{name}-{seed}', one.source, other.target, one.T_target_source, one.clean_source, 'real')
        return moved(pair, np.random.default_rng(seed)) if seed else pair

    return make


def cross_pairs(names: Sequence[str]) -> list[tuple[str, str]]:
    """Return (source, target) of different windows that show enough of the same place; all share one frame."""
    pairs = {name: real_pair(name) for name in names}
    return [
        (one, other)
        for one in names
        for other in names
        if one != other and min(overlaps(pairs[one], pairs[other].target, 0.08)) >= MIN_OVERLAP
    ]


def summary(rows: list[harness.Row]) -> str:
    """Return one table per setting and the pairs that the product gets wrong."""
    parts = [
        'Right: mean displacement < 0.10 m, rotation < 5 degrees, scale < 6 %. Recall by 3DCSR: translation error '
        '< 0.3 radii and rotation error < 15 degrees, with its 95 % interval; RRE and RTE are means over its '
        'successes / medians over all. F-norm and log RMSE (natural, metres) are the measures of the paper.'
    ]
    for setting, runs in tables.grouped(rows, 'setting').items():
        parts += [f'{setting.capitalize()}:', _table(runs)]
        ours = [row for row in runs if row['method'] == 'csgm']
        if ours:
            parts.append(tables.matched_nodes(ours))
    own = [row for row in rows if row['method'] in harness.OURS]
    wrong = [row for row in own if not int(row['right_loose'])]
    lines = [
        f'- {row["method"]}, {row["pair"]}: {"accepted" if int(row["accepted"]) else "rejected"}, '
        f'{100 * float(row["mean"]):.0f} cm, {float(row["rotation"]):.1f} degrees ({row["reason"]})'
        for row in wrong
    ]
    if own:
        parts.append('Not right:\n' + '\n'.join(lines) if lines else 'The product is right on every pair.')
    return '\n\n'.join(parts)


def _table(rows: list[harness.Row]) -> str:
    header = (
        'method',
        'runs',
        'right',
        '3DCSR recall',
        'cm',
        'RRE, deg',
        'RTE',
        'scale, %',
        'F-norm mean',
        'log RMSE mean',
        'wall s',
        'accepted / wrong / missed',
    )
    return tables.table(header, [_line(method, runs) for method, runs in tables.grouped(rows, 'method').items()])


def _line(method: str, runs: list[harness.Row]) -> tuple:
    good = [row for row in runs if int(row['right_3dcsr'])]
    low, high = metrics.wilson(len(good), len(runs))
    f_norm = tables.numbers(runs, 'f_matrix')
    log_rmse = [math.log(max(value, 1e-12)) for value in tables.numbers(runs, 'rmse_absolute')]
    return (
        method,
        len(runs),
        tables.percent(runs, 'right_loose'),
        f'{100 * len(good) / len(runs):.0f} % ({100 * low:.0f}-{100 * high:.0f})',
        f'{100 * tables.median(tables.numbers(runs, "mean")):.1f}',
        f'{_mean(tables.numbers(good, "rotation")):.1f} / {tables.median(tables.numbers(runs, "rotation")):.1f}',
        f'{_mean(tables.numbers(good, "rte")):.3f} / {tables.median(tables.numbers(runs, "rte")):.3f}',
        f'{100 * tables.median(tables.numbers(runs, "scale")):.1f}',
        f'{_mean(f_norm):.2f}',
        f'{_mean(log_rmse):.2f}',
        f'{tables.median(tables.numbers(runs, "wall")):.2f}',
        tables.verdict_counts(runs),
    )


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else math.nan


if __name__ == '__main__':
    main()
