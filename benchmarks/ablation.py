"""Ablation: what each deviation from the paper is worth, alone and together, on Database C.

Three groups: where the hypotheses come from; the ``robust`` profile with one deviation taken back to the paper's
choice; the ``paper`` profile with one deviation added. The parameters of each come from the profiles themselves,
so that a deviation which is added later takes part without a change here.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import harness, meshes, tables
from benchmarks.datasets import database_c_pair
from csgm_ros.config import Config, flatten, profile, replaced

SOURCE = 'hypotheses.sources'


def main() -> None:
    parser = harness.parser(__doc__.splitlines()[0], ['csgm'])
    parser.set_defaults(seeds=[0])
    parser.add_argument('--variants', nargs='+', default=None, help='names of the variants to run; default: all')
    parser.add_argument('--separation', type=float, default=60.0, help='angle between the views, degrees (%(default)s)')
    options = parser.parse_args()
    configs = variants(harness.parsed_changes(options.set))
    if options.variants:
        configs = {name: configs[name] for name in options.variants}
    names = harness.mesh_names(options.meshes)[: 1 if options.quick else None]
    cases = [harness.Case('all', _maker(name, seed, options.separation)) for seed in options.seeds for name in names]
    rows = harness.run_all('ablation', cases[: options.pairs or None], options, configs)
    tables.report('ablation', 'Ablation', summary(rows), options.results)


def _maker(name: str, seed: int, separation: float):
    return lambda: database_c_pair(meshes.load(name), seed, separation_deg=separation)


def variants(changes: dict[str, object]) -> dict[str, Config]:
    """Return every configuration by name, each with ``changes`` on top."""
    robust, paper = profile('robust'), profile('paper')
    choices = {'both': ('graph', 'local'), 'graph': ('graph',), 'local': ('local',)}
    result = {f'robust, {name}': replaced(robust, {SOURCE: chosen}) for name, chosen in choices.items()}
    graph = result['robust, graph']
    ours, theirs = flatten(graph), flatten(paper)
    for name in deviations():
        result[f'graph, {name} = {theirs[name]} (paper)'] = replaced(graph, {name: theirs[name]})
    result['paper'] = paper
    for name in deviations():
        result[f'paper, {name} = {ours[name]}'] = replaced(paper, {name: ours[name]})
    return {name: replaced(config, changes) for name, config in result.items()}


def deviations() -> list[str]:
    """Return the parameters in which the two profiles differ, apart from the profile's name.

    The paper's one RANSAC transform is one of them; its opposite is the search from the graph alone, because
    local features are no part of the paper.
    """
    robust, paper = flatten(profile('robust')), flatten(profile('paper'))
    return [name for name in robust if robust[name] != paper[name] and name != 'profile']


def summary(rows: list[harness.Row]) -> str:
    """Return the table in the order of the variants; a match is right within a tenth of the radius."""
    header = (
        'variant',
        'pairs',
        'right matches / matches',
        'RMSE/r < 0.05',
        '< 0.02',
        'RMSE/r median',
        'wall s',
        'accepted / wrong / missed',
    )
    lines = [
        (
            name,
            len(runs),
            f'{sum(tables.numbers(runs, "matches_right")):.0f} / {sum(tables.numbers(runs, "matches")):.0f}',
            tables.percent(runs, 'right_loose'),
            tables.percent(runs, 'right_tight'),
            f'{tables.median(tables.numbers(runs, "rmse")):.3f}',
            f'{tables.median(tables.numbers(runs, "wall")):.2f}',
            tables.verdict_counts(runs),
        )
        for name, runs in tables.grouped(rows, 'method').items()
    ]
    note = 'A match is right when the truth brings its two nodes within a tenth of the radius of each other.'
    return f'{note}\n\n{tables.table(header, lines)}'


if __name__ == '__main__':
    main()
