"""What every benchmark command shares: its options, and running methods over pairs into a CSV file."""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks import meshes, metrics, peers
from benchmarks.datasets import Pair, apply
from csgm_ros.errors import CsgmError

FOLDER = Path(__file__).resolve().parent
RESULTS = FOLDER / 'results'
OURS: dict[str, dict[str, object]] = {
    'csgm': {},
    'csgm-graph': {'hypotheses.sources': ('graph',)},
    'csgm-matches': {'hypotheses.sources': ('graph',), 'hypotheses.correspondences': 0},
    'csgm-local': {'hypotheses.sources': ('local',)},
    'csgm-scale': {},
}
"""Names of the product's own variants, as changes of the ``robust`` profile; ``csgm-paper`` is the ``paper`` one.

``csgm-scale`` estimates the scale even where a protocol is rigid."""

Row = dict[str, object]


@dataclass(frozen=True, eq=False)
class Case:
    """One pair to run, the setting that it stands for in a table (a view separation, say), and what peers are told."""

    setting: str
    make: Callable[[], Pair]
    rigid: bool = False
    voxel: float = peers.VOXEL


def parser(description: str, methods: Sequence[str]) -> argparse.ArgumentParser:
    """Return the options that every command has; ``methods`` is its default list."""
    result = argparse.ArgumentParser(description=description)
    result.add_argument('--methods', nargs='+', default=list(methods), help='default: %(default)s')
    result.add_argument('--seeds', nargs='+', type=int, default=[0, 1, 2], help='default: %(default)s')
    result.add_argument('--meshes', nargs='+', default=None, help='default: every scanned mesh and five sculptures')
    result.add_argument('--pairs', type=int, default=0, help='stop after so many pairs per setting; 0 for all')
    result.add_argument('--quick', action='store_true', help='a minute or two: fewest pairs, to see that it works')
    result.add_argument('--resume', action='store_true', help='keep the runs in the CSV file, add only missing ones')
    result.add_argument('--results', type=Path, default=RESULTS, help='folder for CSV, Markdown and plots')
    result.add_argument('--set', nargs='+', default=[], metavar='NAME=VALUE', help="change the product's parameters")
    return result


def mesh_names(chosen: Iterable[str] | None) -> list[str]:
    """Return the meshes to use: the chosen ones, or every scanned one and sculptures up to ten."""
    if chosen:
        return list(chosen)
    return [*meshes.scanned_names(), *meshes.SCULPTURES[:5]]


def installed(methods: Sequence[str]) -> list[str]:
    """Return the methods that can run here; say which cannot."""
    have = {*peers.available(), *OURS, 'csgm-paper'}
    for name in methods:
        if name not in have:
            print(f'left out: {name} (not installed)', file=sys.stderr)
    return [name for name in methods if name in have]


def product_config(method: str, changes: dict[str, object], *, rigid: bool = False):
    """Return the product's configuration for one of its variants."""
    from csgm_ros.config import profile, replaced

    config = profile('paper') if method == 'csgm-paper' else replaced(profile(), OURS.get(method, {}))
    return replaced(
        config, {**changes, **({'scale.estimate_scale': False} if rigid and method != 'csgm-scale' else {})}
    )


def parsed_changes(items: Sequence[str]) -> dict[str, object]:
    """Turn ``NAME=VALUE`` items into a dictionary, each value as a Python literal where it is one."""
    import ast

    changes: dict[str, object] = {}
    for item in items:
        name, _, value = item.partition('=')
        try:
            changes[name] = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            changes[name] = value
    return changes


def run(method: str, pair: Pair, seed: int, *, rigid: bool = False, voxel: float = peers.VOXEL, config=None) -> Row:
    """Run one method on one pair and return everything measured, whatever happens.

    A method that raises counts as one that found nothing: its errors are infinite and ``reason`` says why.
    """
    names = ('accepted', 'reason', 'fitness_source', 'fitness_target', 'margin', *MATCHES)
    row: Row = dict.fromkeys(names, '')
    estimate = np.full((4, 4), np.nan)
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        if config is not None:
            import csgm_ros

            result = csgm_ros.register(pair.source, pair.target, config, seed=seed)
            estimate = result.T_target_source
            row |= {
                'accepted': int(result.accepted),
                'reason': result.reason,
                'fitness_source': result.fitness_source,
                'fitness_target': result.fitness_target,
                'margin': result.verdict.margin,
            }
            row |= _matches(result, pair)
        else:
            estimate = peers.register(method, pair.source, pair.target, seed, rigid=rigid, voxel=voxel)
    except Exception as error:  # a peer may raise anything, and one failure must not end a long run
        if config is not None and not isinstance(error, CsgmError):
            raise  # a defect of the product is no result
        row['reason'] = f'{type(error).__name__}: {error}'.splitlines()[0][:200]
        row['accepted'] = 0 if config is not None else ''
    row |= {'wall': time.perf_counter() - wall, 'cpu': time.process_time() - cpu}
    row |= metrics.errors(estimate, pair)
    row |= {f'right_{name}': int(metrics.right(estimate, pair, bound)) for name, bound in BOUNDS.items()}
    row['right_3dcsr'] = int(pair.T_target_source is not None and threedcsr(row))
    return row


def _matches(result, pair: Pair) -> Row:
    """Count the matched nodes, those with a counterpart, and those that were right.

    Right is what the truth brings within a tenth of the target's radius; a counterpart is any node so near.
    """
    if pair.T_target_source is None or result.source_graph is None:
        return {}
    source, target = apply(pair.T_target_source, result.source_graph.nodes), result.target_graph.nodes
    near = np.linalg.norm(source[:, None] - target, axis=2) < 0.1 * metrics.radius(pair.target)
    matches = result.unguided_matches
    counts = len(matches), near.any(1)[matches[:, 0]].sum(), near[tuple(matches.T)].sum()
    return dict(zip(MATCHES, map(int, counts), strict=True))


MATCHES = 'matches', 'matches_possible', 'matches_right'
BOUNDS = {'loose': metrics.LOOSE, 'tight': metrics.TIGHT}


def threedcsr(row: Row) -> bool:
    """Apply the 3DCSR rule to the errors in a row."""
    return float(row['rte']) < 0.3 and float(row['rotation']) < 15.0


def run_all(name: str, cases: Sequence[Case], options: argparse.Namespace, configs=None) -> list[Row]:
    """Run every method on every case, one after the other, and append each run to ``NAME.csv`` at once.

    The methods take turns on each pair, so that a busy machine slows all of them alike. ``configs`` overrides
    the product's configuration by method name; every key is then a method of its own.
    """
    changes = parsed_changes(options.set)
    methods = list(configs) if configs else installed(options.methods)
    path = options.results / f'{name}.csv'
    options.results.mkdir(parents=True, exist_ok=True)
    rows = read_rows(path) if options.resume and path.exists() else []
    done = {(row['setting'], row['pair'], row['method']) for row in rows}
    if not rows and path.exists():
        path.unlink()
    _warm_up(methods if not configs else ['csgm'])
    for number, case in enumerate(cases):
        pair = case.make()
        for method in methods:
            if (case.setting, pair.name, method) in done:
                continue
            ours = bool(configs) or method in OURS or method == 'csgm-paper'
            config = configs[method] if configs else None
            if ours and config is None:
                config = product_config(method, changes, rigid=case.rigid)
            row = {'setting': case.setting, 'pair': pair.name, 'method': method}
            row |= run(method, pair, 0, rigid=case.rigid, voxel=case.voxel, config=config)
            rows.append(row)
            _append(path, row)
        last = rows[-len(methods) :]
        seen = ' '.join(f'{row["method"]}:{"+" if int(row["right_loose"]) else "-"}' for row in last)
        print(f'[{number + 1}/{len(cases)}] {case.setting} {pair.name} {seen}', file=sys.stderr, flush=True)
    return rows


def _warm_up(methods: Sequence[str]) -> None:
    """Load and compile everything first, so that no pair pays for it: every method once, on a tiny problem."""
    from benchmarks.datasets import database_c_pair

    pair = database_c_pair(meshes.sculpture('blob', 0, resolution=32), 0)
    for method in methods:
        config = product_config(method, {}) if method in OURS or method == 'csgm-paper' else None
        run(method, pair, 0, config=config)


def read_rows(path: Path) -> list[Row]:
    """Read the runs of an earlier command."""
    with path.open(newline='') as file:
        return list(csv.DictReader(file))


def _append(path: Path, row: Row) -> None:
    new = not path.exists()
    with path.open('a', newline='') as file:
        writer = csv.DictWriter(file, list(row))
        if new:
            writer.writeheader()
        writer.writerow({key: f'{value:.6g}' if isinstance(value, float) else value for key, value in row.items()})
