"""Summaries of runs as Markdown tables, and the sections of ``RESULTS.md``."""

from __future__ import annotations

import importlib.metadata
import math
import os
import platform
import shlex
import statistics
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from benchmarks.harness import FOLDER, RESULTS, Row

REFERENCE = 'fgr+sicp'
"""The peer that wall times are divided by."""


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


def matched_nodes(rows: Sequence[Row]) -> str:
    """Say how many of the pairs that graph matching found without the transform were right."""
    found, possible, right = (sum(numbers(rows, f'matches{what}')) for what in ('', '_possible', '_right'))
    if not found:
        return 'Graph matching found no pairs.'
    return (
        f'Of the {found:.0f} pairs of nodes that graph matching found without the transform {right / found:.0%} are '
        f'right, {right / max(possible, 1):.0%} of those whose node has a counterpart.'
    )


def machine() -> str:
    """Return one line on the machine and the versions."""
    model = platform.processor() or platform.machine()
    cpu_info = Path('/proc/cpuinfo')
    if cpu_info.exists():
        names = [line.partition(':')[2].strip() for line in cpu_info.read_text().splitlines() if 'model name' in line]
        model = names[0] if names else model
    versions = []
    for package in (
        'numpy',
        'scipy',
        'numba',
        'open3d-cpu',
        'kiss-matcher',
        'small-gicp',
        'pycpd',
        'jrmpc',
        'cmeel-teaser-plusplus',
    ):
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


def report(name: str, title: str, body: str, folder: Path) -> None:
    """Print a section and write it to ``NAME.md``; then put all sections together in ``RESULTS.md``."""
    arguments = shlex.join(argument for argument in sys.argv[1:] if argument != '--resume')
    command = f'python benchmarks/{Path(sys.argv[0]).name} {arguments}'.strip()
    section = f'## {title}\n\n`{command}` at {revision()}.\n{machine()}.\n\n{body}\n'
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f'{name}.md').write_text(section)
    print(section)
    if folder == RESULTS:
        collect()


ORDER = (
    'database_c',
    'database_b',
    'same_source',
    'stress',
    'places',
    'part_in_whole',
    'verdict',
    'ablation',
    'profile_stages',
    'matching',
    'supervoxels',
    'esf',
    'report',
)


def collect() -> None:
    """Put the sections at hand together in ``RESULTS.md``; those that no file of ``results/`` holds stay below."""
    intro = (
        '# Results\n\nMade by the commands below; every run is a line of the CSV file of the same name in `results/`. '
        'Methods, protocols and columns: `README.md`.\n\n'
    )
    made = [(RESULTS / f'{name}.md').read_text() for name in ORDER if (RESULTS / f'{name}.md').exists()]
    titles, file = {text.partition('\n')[0] for text in made}, FOLDER / 'RESULTS.md'
    there = ['## ' + part.strip() + '\n' for part in file.read_text().split('\n## ')[1:]] if file.exists() else []
    kept = [text for text in there if text.partition('\n')[0] not in titles]
    file.write_text(intro + '\n'.join([*made, *kept]))
