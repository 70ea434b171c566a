"""Database C, synthetic cross-source pairs by the paper's recipe (Sec. IV-A), beside the peers."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import harness, meshes, tables
from benchmarks.datasets import database_c_pair

METHODS = ('csgm', 'fgr+sicp', 'ransac+sicp', 'ransac-scale+sicp', 'kiss+sicp', 'teaser+sicp')
ALL = (
    *METHODS,
    'csgm-graph',
    'csgm-local',
    'fgr',
    'kiss',
    'ransac',
    'ransac-scale',
    'gicp',
    'icp',
    'cpd',
    'jrmpc',
)


def main() -> None:
    parser = harness.parser(__doc__, METHODS)
    parser.add_argument('--all', action='store_true', help='every method, the slow and hopeless ones too')
    options = parser.parse_args()
    if options.all:
        options.methods = list(ALL)
    names = harness.mesh_names(options.meshes)
    if options.quick:
        names, options.seeds = names[:2], options.seeds[:1]
    cases = [
        harness.Case('scanned' if name in meshes.scanned_names() else 'sculpture', _maker(name, seed))
        for seed in options.seeds
        for name in names
    ]
    rows = harness.run_all('database_c', cases[: options.pairs or None], options)
    tables.report('database_c', 'Database C', summary(rows, options.seeds), options.results)


def _maker(name: str, seed: int):
    return lambda: database_c_pair(meshes.load(name), seed)


def summary(rows: list[harness.Row], seeds: list[int]) -> str:
    """Return the tables: all pairs, and per kind of mesh where there are several."""
    used = list(dict.fromkeys(str(row['pair']).rpartition('-')[0] for row in rows))
    parts = [f'Meshes: {", ".join(used)}; seeds {", ".join(map(str, seeds))}.', tables.method_table(rows)]
    groups = tables.grouped(rows, 'setting')
    if len(groups) > 1:
        for setting, runs in groups.items():
            parts += [f'Only the {setting} meshes:', tables.method_table(runs)]
    ours = [row for row in rows if row['method'] == 'csgm']
    if ours:
        parts.append(tables.matched_nodes(ours))
        missed = [f'{row["pair"]} (RMSE/r {float(row["rmse"]):.3f})' for row in ours if not int(row['right_tight'])]
        parts.append(f'Pairs that `csgm` does not solve within 0.02: {", ".join(missed) or "none"}.')
    return '\n\n'.join(parts)


if __name__ == '__main__':
    main()
