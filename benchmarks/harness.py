"""What every benchmark command shares: run methods over pairs, keep each run in a CSV, summarise as Markdown."""

from __future__ import annotations

import argparse
import csv
import importlib.metadata
import math
import os
import platform
import shlex
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks import meshes, metrics, peers
from benchmarks.datasets import Pair

FOLDER = Path(__file__).resolve().parent
RESULTS = FOLDER / 'results'
REFERENCE = 'fgr+sicp'
"""The peer that wall times are divided by."""

OURS: dict[str, dict[str, object]] = {
    'csgm': {},
    'csgm-graph': {'hypotheses.sources': 'graph'},
    'csgm-local': {'hypotheses.sources': 'local'},
}
"""Names of the product's own variants, as changes of the ``robust`` profile; ``csgm-paper`` is the ``paper`` one."""

Row = dict[str, object]


@dataclass(frozen=True, eq=False)
class Case:
    """One pair to run, and the setting that it stands for in a table (such as a view separation)."""

    setting: str
    make: Callable[[], Pair]
    rigid: bool = False


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
    return replaced(config, {**changes, **({'scale.estimate_scale': False} if rigid else {})})


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


def run(method: str, pair: Pair, seed: int, *, rigid: bool = False, config=None) -> Row:
    """Run one method on one pair and return everything measured, whatever happens.

    A method that raises counts as one that found nothing: its errors are infinite and ``reason`` says why.
    """
    row: Row = {'accepted': '', 'reason': '', 'fitness_source': '', 'fitness_target': '', 'margin': ''}
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
        else:
            estimate = peers.register(method, pair.source, pair.target, seed, rigid=rigid)
    except Exception as error:  # a peer may raise anything, and one failure must not end a long run
        row['reason'] = f'{type(error).__name__}: {error}'.splitlines()[0][:200]
        row['accepted'] = 0 if config is not None else ''
    row |= {'wall': time.perf_counter() - wall, 'cpu': time.process_time() - cpu}
    row |= metrics.errors(estimate, pair)
    row |= {f'right_{name}': int(metrics.right(estimate, pair, bound)) for name, bound in BOUNDS.items()}
    row['right_3dcsr'] = int(pair.T_target_source is not None and threedcsr(row))
    return row


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
            row |= run(method, pair, 0, rigid=case.rigid, config=config)
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


def numbers(rows: Iterable[Row], key: str) -> list[float]:
    """Return one column of some runs as numbers."""
    return [float(row[key]) for row in rows if row[key] not in ('', None)]


def median(values: Sequence[float]) -> float:
    """Return the median, NaN of nothing."""
    return statistics.median(values) if values else math.nan


def percent(rows: Sequence[Row], key: str) -> str:
    """Return the share of runs whose 0/1 column is 1, as ``93 %``; a dash for none."""
    values = numbers(rows, key)
    return f'{100 * sum(values) / len(values):.0f} %' if values else '-'


def grouped(rows: Iterable[Row], key: str) -> dict[str, list[Row]]:
    """Group runs by a column, in order of appearance."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(str(row[key]), []).append(row)
    return groups


def verdict_counts(rows: Sequence[Row], right: str = 'right_loose') -> str:
    """Return ``accepted / wrong among them / right among the rejected``, a dash for methods without a verdict."""
    judged = [row for row in rows if row['accepted'] not in ('', None)]
    if not judged:
        return '-'
    accepted = [row for row in judged if int(row['accepted'])]
    wrong = sum(not int(row[right]) for row in accepted)
    missed = sum(int(row[right]) for row in judged if not int(row['accepted']))
    return f'{len(accepted)} / {wrong} / {missed}'


def table(header: Sequence[str], lines: Iterable[Sequence[object]]) -> str:
    """Return a Markdown table."""
    texts = [[str(cell) for cell in line] for line in (header, ['---'] * len(header), *lines)]
    return '\n'.join('| ' + ' | '.join(line) + ' |' for line in texts)


def method_table(rows: Sequence[Row]) -> str:
    """Return the main table: one line a method, best first, wall time beside the reference peer's."""
    groups = grouped(rows, 'method')
    reference = median(numbers(groups.get(REFERENCE, []), 'wall'))
    lines = []
    for method, runs in groups.items():
        wall = median(numbers(runs, 'wall'))
        lines.append(
            (
                method,
                len(runs),
                percent(runs, 'right_loose'),
                percent(runs, 'right_tight'),
                f'{median(numbers(runs, "rmse")):.4f}',
                f'{median(numbers(runs, "rotation")):.2f}',
                f'{100 * median(numbers(runs, "scale")):.1f}',
                f'{wall:.2f}',
                f'{median(numbers(runs, "cpu")):.2f}',
                '-' if math.isnan(reference) else f'{wall / reference:.2f}',
                verdict_counts(runs),
            )
        )
    lines.sort(key=lambda line: -sum(int(str(line[column]).split()[0]) for column in (2, 3)))
    header = (
        'method',
        'runs',
        'RMSE/r < 0.05',
        '< 0.02',
        'RMSE/r median',
        'rotation, deg',
        'scale, %',
        'wall s',
        'CPU s',
        f'wall / {REFERENCE}',
        'accepted / wrong / missed',
    )
    return table(header, lines)


def machine() -> str:
    """Return one line on the machine and the versions."""
    model = platform.processor() or platform.machine()
    cpu_info = Path('/proc/cpuinfo')
    if cpu_info.exists():
        names = [line.partition(':')[2].strip() for line in cpu_info.read_text().splitlines() if 'model name' in line]
        model = names[0] if names else model
    versions = []
    for package in ('numpy', 'scipy', 'numba', 'open3d-cpu', 'kiss-matcher', 'small-gicp', 'probreg', 'jrmpc'):
        try:
            versions.append(f'{package} {importlib.metadata.version(package)}')
        except importlib.metadata.PackageNotFoundError:
            continue
    load = f'load average {os.getloadavg()[0]:.1f} at the end'
    return f'{model}, {os.cpu_count()} cores, {load}; Python {platform.python_version()}, {", ".join(versions)}'


def revision() -> str:
    """Return the short commit that was measured, with a plus where ``csgm_ros`` has changes not committed."""
    git = ['git', '-C', str(FOLDER)]
    head = subprocess.run([*git, 'rev-parse', '--short', 'HEAD'], capture_output=True, text=True, check=False)
    changed = subprocess.run([*git, 'diff', '--quiet', 'HEAD', '--', '../csgm_ros'], check=False).returncode
    return (head.stdout.strip() or 'unknown') + ('+' if changed else '')


def report(name: str, title: str, body: str, options: argparse.Namespace) -> None:
    """Print a section and write it to ``NAME.md``; then put all sections together in ``RESULTS.md``."""
    arguments = shlex.join(argument for argument in sys.argv[1:] if argument != '--resume')
    command = f'python benchmarks/{Path(sys.argv[0]).name} {arguments}'.strip()
    section = f'## {title}\n\n`{command}` at {revision()}.\n{machine()}.\n\n{body}\n'
    options.results.mkdir(parents=True, exist_ok=True)
    (options.results / f'{name}.md').write_text(section)
    print(section)
    if options.results == RESULTS:
        collect()


ORDER = ('database_c', 'database_b', 'same_source', 'stress', 'verdict', 'ablation', 'profile_stages')


def collect() -> None:
    """Put the sections at hand together in ``RESULTS.md``."""
    intro = (
        '# Results\n\nMade by the commands below; every run is a line of the CSV file of the same name in `results/`. '
        'Methods, protocols and columns: `README.md`.\n\n'
    )
    found = [RESULTS / f'{name}.md' for name in ORDER if (RESULTS / f'{name}.md').exists()]
    (FOLDER / 'RESULTS.md').write_text(intro + '\n'.join(path.read_text() for path in found))
