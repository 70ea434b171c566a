"""The verdict: what ``accepted`` is worth on related pairs and on pairs that show different things."""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import harness, meshes, metrics, tables
from benchmarks.database_b import cross_pairs
from benchmarks.datasets import Pair, database_c_pair, moved, overlaps, real_names, real_pair, unrelated

MAX_OVERLAP = 0.02
"""Share of either cloud on the other, up to which two real windows count as showing different things."""


def main() -> None:
    parser = harness.parser(__doc__, ['csgm'])
    parser.set_defaults(seeds=[0, 1])
    parser.add_argument('--unrelated', type=int, default=200, help='pairs that show different things (%(default)s)')
    options = parser.parse_args()
    names = harness.mesh_names(options.meshes)
    if options.quick:
        names, options.seeds, options.unrelated = names[:2], [0], 4
    cases = [harness.Case('synthetic', _synthetic(name, seed)) for seed in options.seeds for name in names]
    if not options.quick:
        cases += [harness.Case('real', _real(name, name)) for name in real_names()]
        cases += [harness.Case('real, other window', _real(*both)) for both in cross_pairs(real_names())]
    cases = cases[: options.pairs or None] + unrelated_cases(names, options.unrelated)
    rows = harness.run_all('verdict', cases, options)
    tables.report('verdict', 'The verdict', summary(rows), options.results)


def _synthetic(name: str, seed: int):
    return lambda: database_c_pair(meshes.load(name), seed)


def _real(source: str, target: str):
    def make() -> Pair:
        one, other = real_pair(source), real_pair(target)
        name = f'{source}|{target}'
        return Pair(name, one.source, other.target, one.T_target_source, one.clean_source, 'real')

    return make


def unrelated_cases(names: list[str], count: int) -> list[harness.Case]:
    """Return ``count`` cases: real windows without overlap, then objects and windows mixed, then objects."""
    windows = {name: real_pair(name) for name in real_names()}
    apart = [
        (one, other)
        for one, other in itertools.permutations(windows, 2)
        if max(overlaps(windows[one], windows[other].target, 0.08)) <= MAX_OVERLAP
    ]
    mixed = [both for name in windows for both in itertools.product((name,), names[:3])]
    mixed = [pair for both in mixed for pair in (both, both[::-1])][: count // 4]
    cases = [_unrelated('real windows apart', *both, 0) for both in apart[:count]]
    cases += [_unrelated('object and window', *both, 0) for both in mixed[: count - len(cases)]]
    for seed in itertools.count():
        for both in itertools.permutations(names, 2):
            if len(cases) >= count:
                return cases
            cases.append(_unrelated('different objects', *both, seed))
    return cases


def _unrelated(setting: str, source: str, target: str, seed: int) -> harness.Case:
    """Pair two clouds; objects are told from windows by name, and the source is moved any way."""

    def make() -> Pair:
        one, other = (
            real_pair(name) if name in real_names() else database_c_pair(meshes.load(name), seed + 100)
            for name in (source, target)
        )
        name = f'{source}|{target}-{seed}'
        rng = np.random.default_rng([seed, *name.encode()])
        pair = unrelated(moved(one, rng), other)
        return Pair(name, pair.source, pair.target, None, pair.clean_source, pair.kind)

    return harness.Case(f'unrelated: {setting}', make)


def summary(rows: list[harness.Row]) -> str:
    """Return, per method: the counts per setting, precision and recall, and what accepted wrongly looks like."""
    parts = [
        'Right: RMSE/r < 0.05 (synthetic), the rule of Database B (real). Precision: right among the accepted of the '
        'related pairs, and of all pairs; recall: accepted among the right. Brackets: 95 % interval.'
    ]
    for method, runs in tables.grouped(rows, 'method').items():
        lines = [_line(setting, group) for setting, group in tables.grouped(runs, 'setting').items()]
        header = ('setting', 'pairs', 'right', 'accepted', 'accepted but wrong', 'right but rejected', 'wall s')
        related = [row for row in runs if not str(row['setting']).startswith('unrelated')]
        others = [row for row in runs if str(row['setting']).startswith('unrelated')]
        parts += [f'`{method}`:', tables.table(header, lines)]
        parts.append(
            f'- Precision on related pairs: {_share(_accepted(related), "right_loose")}; on all: '
            f'{_share(_accepted(runs), "right_loose")}.\n'
            f'- Recall: {_share([row for row in related if int(row["right_loose"])], "accepted")}.\n'
            f'- Unrelated pairs accepted: {_share(others, "accepted")}.'
        )
        wrong = [row for row in _accepted(runs) if not int(row['right_loose'])]
        parts += [f'- accepted but wrong: {row["pair"]} ({row["reason"]})' for row in wrong]
    return '\n\n'.join(parts)


def _accepted(rows: list[harness.Row]) -> list[harness.Row]:
    return [row for row in rows if int(row['accepted'])]


def _share(rows: list[harness.Row], key: str) -> str:
    hits = sum(int(row[key]) for row in rows)
    low, high = metrics.wilson(hits, len(rows))
    rate = f'{100 * hits / len(rows):.1f} %' if rows else '-'
    return f'{hits} of {len(rows)}, {rate} ({100 * low:.1f}-{100 * high:.1f})'


def _line(setting: str, rows: list[harness.Row]) -> tuple:
    right = [row for row in rows if int(row['right_loose'])]
    accepted = _accepted(rows)
    return (
        setting,
        len(rows),
        len(right),
        len(accepted),
        sum(not int(row['right_loose']) for row in accepted),
        sum(not int(row['accepted']) for row in right),
        f'{tables.median(tables.numbers(rows, "wall")):.2f}',
    )


if __name__ == '__main__':
    main()
