"""Graph matching beside the original code and RRWM on the same instances, and how its time grows with the nodes."""

from __future__ import annotations

import argparse
import csv
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import plots, tables
from csgm_ros.cloud.threads import blas_threads
from csgm_ros.config import MatchingConfig, profile
from csgm_ros.matching.match import match_graphs, score

SIZES = (25, 50, 75, 100, 150, 200, 300, 400)
VARIANTS = {
    'csgm': MatchingConfig(),
    'csgm, path only': MatchingConfig(search_effort=0.0),
    'csgm, paper': profile('paper').matching,
}
GROUPS = (
    ('House, 30 and 30 nodes', lambda name: name.startswith('h') and name.endswith('30_30')),
    ('House, 30 and 25', lambda name: name.startswith('h')),
    ('Hotel', lambda name: name.startswith('t')),
    ('synthetic, undirected', lambda name: name.startswith('u')),
    ('synthetic, hard', lambda name: name in ('s14', 's15', 's16', 's17')),
    ('synthetic, signed affinities', lambda name: name == 's13'),
    ('synthetic, directed', lambda name: name.startswith('s')),
)
FIRST_CALL = """
import time, numpy as np
begin = time.perf_counter(), time.process_time()
from csgm_ros.matching.match import match_graphs
imported = time.perf_counter(), time.process_time()
edges = np.array([[0, 1], [1, 2], [2, 3], [3, 0]])
match_graphs(np.eye(4), np.ones((4, 4)), edges, edges)
called = time.perf_counter(), time.process_time()
print(*(imported[k] - begin[k] for k in (0, 1)), *(called[k] - imported[k] for k in (0, 1)))
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--sizes', nargs='+', type=int, default=list(SIZES), help='nodes to grow through (%(default)s)')
    parser.add_argument('--quick', action='store_true', help='one instance a group and two sizes: only to see it work')
    parser.add_argument('--csv', type=Path, default=tables.RESULTS / 'matching.csv', help='%(default)s')
    parser.add_argument('--plot', type=Path, help='also draw time over nodes into this PNG file')
    parser.add_argument('--results', type=Path, default=tables.RESULTS, help='folder of the table (%(default)s)')
    options = parser.parse_args()
    rows = [beside_the_original(path) for path in instances(options.quick)]
    growth = [grown(nodes) for nodes in (options.sizes[:2] if options.quick else options.sizes)]
    if rows:
        options.csv.parent.mkdir(parents=True, exist_ok=True)
        with options.csv.open('w', newline='') as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
    if options.plot:
        lines = {name: [(line['nodes'], line[f'{name}, CPU ms']) for line in growth] for name in VARIANTS}
        plots.curves(options.plot, lines, 'nodes of either graph', 'CPU ms')
    tables.report('matching', 'Graph matching beside the original FGM and RRWM', body(rows, growth), options.results)


def instances(quick: bool) -> list[Path]:
    """Return the stored instances; none without ``CSGM_SHARED``."""
    if 'CSGM_SHARED' not in os.environ:
        print('CSGM_SHARED is not set: no comparison with the original')
        return []
    if rrwm() is None:
        print('pygmtools is not installed: no comparison with RRWM in this run')
    paths = sorted((Path(os.environ['CSGM_SHARED']) / 'reference' / 'fgm').glob('*.npz'))
    if not quick:
        return paths
    return [next(path for path in paths if group_of(path.stem) == name) for name, _ in GROUPS]


def group_of(name: str) -> str:
    return next(group for group, belongs in GROUPS if belongs(name))


def rrwm() -> Callable | None:
    """Return RRWM as a function of our arguments that gives the seconds of its solver and an assignment, or None."""
    try:
        import pygmtools
    except ImportError:
        return None

    def run(node, edge, edges_1, edges_2):
        affinity = pairwise(node, edge, edges_1, edges_2)
        with blas_threads(1):  # without this it takes several times the CPU time, and none the less
            start = time.process_time()
            soft = pygmtools.rrwm(affinity, *node.shape, backend='numpy')
            hard = pygmtools.hungarian(soft, backend='numpy')
            return time.process_time() - start, np.asarray(hard)

    return run


def pairwise(node: np.ndarray, edge: np.ndarray, edges_1: np.ndarray, edges_2: np.ndarray) -> np.ndarray:
    """Return the symmetric n1 n2 x n1 n2 matrix that the other methods need, X read column by column."""
    n1, n2 = node.shape
    matrix = np.zeros((n1 * n2, n1 * n2))
    starts = edges_1[:, :1] + n1 * edges_2[:, 0]
    ends = edges_1[:, 1:] + n1 * edges_2[:, 1]
    np.add.at(matrix, (starts, ends), edge / 2)
    np.add.at(matrix, (ends, starts), edge / 2)
    matrix[np.diag_indices(n1 * n2)] += node.T.ravel()
    return matrix


def cpu_seconds(work: Callable[[], object]) -> float:
    """Return the median CPU time of three calls."""
    seconds = []
    for _ in range(3):
        start = time.process_time()
        work()
        seconds.append(time.process_time() - start)
    return statistics.median(seconds)


def beside_the_original(path: Path) -> dict:
    """Solve one stored instance with every variant and with RRWM."""
    stored = np.load(path)
    graphs = stored['Kp'], stored['Kq'], stored['eg1'], stored['eg2']
    truth, objective = stored['XT'] > 0, float(stored['J_FGMD'])
    row = {
        'instance': path.stem,
        'group': group_of(path.stem),
        'J FGM-D': objective,
        'accuracy FGM-D': float(stored['acc_FGMD']),
        'CPU s FGM-D': float(stored['cpu_FGMD']),
    }
    for name, config in VARIANTS.items():
        found = match_graphs(*graphs, config=config)
        row[f'J {name}'] = found.objective / objective
        row[f'accuracy {name}'] = found.assignment[truth].mean()
        row[f'CPU s {name}'] = cpu_seconds(lambda config=config: match_graphs(*graphs, config=config))
    other = rrwm()
    if other is not None:
        # RRWM is made for affinities that are not negative, hence the group of its own for signed ones
        runs = [other(*graphs) for _ in range(3)]
        assignment = runs[0][1]
        row['J RRWM'] = score(assignment, *graphs) / objective
        row['accuracy RRWM'] = assignment[truth].mean()
        row['CPU s RRWM'] = statistics.median(seconds for seconds, _ in runs)
    return row


def structure_graphs(rng: np.random.Generator, nodes: int) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Return two graphs like those of two clouds, and the truth: four fifths of the nodes in common, all noisy.

    Points on a bumpy sphere; edges to the six nearest in both directions; affinities of length and angles.
    """
    common = nodes * 4 // 5
    directions = rng.normal(size=(2 * nodes - common, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    places = directions * (1 + 0.2 * np.sin(5 * directions[:, :1]) * np.cos(4 * directions[:, 1:2]))
    order = rng.permutation(nodes)
    chosen = np.arange(nodes), np.concatenate([np.arange(common), np.arange(nodes, 2 * nodes - common)])[order]
    edges, described = [], []
    for indices in chosen:
        points = places[indices] + 0.02 * rng.normal(size=(nodes, 3))
        distances = np.linalg.norm(points[:, None] - points, axis=2)
        nearest = np.argsort(distances, axis=1, kind='stable')[:, 1:7]
        ahead = np.column_stack([np.repeat(np.arange(nodes), 6), nearest.ravel()])
        pairs = np.unique(np.concatenate([ahead, ahead[:, ::-1]]), axis=0)
        along = points[pairs[:, 1]] - points[pairs[:, 0]]
        length = np.linalg.norm(along, axis=1, keepdims=True)
        ends = (np.sum(along / length * directions[indices][pairs[:, k]], axis=1, keepdims=True) for k in (0, 1))
        edges.append(pairs)
        described.append(np.column_stack([length / length.mean(), *ends]))
    difference = np.sum((described[0][:, None] - described[1]) ** 2, axis=2)
    closeness = np.linalg.norm(places[chosen[0]][:, None] - places[chosen[1]], axis=2) + rng.random((nodes, nodes))
    truth = np.zeros((nodes, nodes), bool)
    truth[chosen[1][chosen[1] < nodes], np.flatnonzero(chosen[1] < nodes)] = True
    return (np.exp(-(closeness**2)), np.exp(-difference / 0.18), *edges), truth


def grown(nodes: int) -> dict:
    """Match two graphs of one size with every variant."""
    graphs, truth = structure_graphs(np.random.default_rng(nodes), nodes)
    line = {'nodes': nodes, 'edges': len(graphs[2])}
    for name, config in VARIANTS.items():
        if name == 'csgm, paper' and nodes > 200:
            line[f'{name}, CPU ms'] = float('nan')
            continue
        start = time.process_time()
        found = match_graphs(*graphs, config=config)
        line[f'{name}, CPU ms'] = round(1e3 * (time.process_time() - start), 1)
        line[f'{name}, right'] = f'{100 * found.assignment[truth].mean():.0f} %'
    return line


def body(rows: list[dict], growth: list[dict]) -> str:
    parts = []
    if rows:
        parts.append(
            'Objective J relative to the original FGM-D (mean, smallest), share of the true pairs, CPU milliseconds '
            '(median; solver alone for RRWM, one thread), and how many times less CPU time than FGM-D took when its '
            'results were made (Octave, one thread) and than RRWM takes in this run.'
        )
        parts += [comparison(name, rows) for name in VARIANTS]
    columns = list(dict.fromkeys(key for line in growth for key in line))
    parts.append('Time over the size; graphs of six neighbours in both directions, four fifths of the nodes in common.')
    parts.append(tables.table(columns, [[line.get(column, '-') for column in columns] for line in growth]))
    parts.append(first_calls())
    return '\n\n'.join(parts)


def comparison(name: str, rows: list[dict]) -> str:
    """Return the table of one variant, a line a group."""
    lines = []
    for group, members in [*tables.grouped(rows, 'group').items(), ('all', rows)]:
        values = {
            key: np.array([row[key] for row in members]) for key in members[0] if key not in ('instance', 'group')
        }
        own = values[f'CPU s {name}']
        line = [group, len(members), f'{values[f"J {name}"].mean():.4f}', f'{values[f"J {name}"].min():.4f}']
        line += [f'{values[f"accuracy {name}"].mean():.2f}', f'{values["accuracy FGM-D"].mean():.2f}']
        line += [f'{1e3 * np.median(own):.1f}', f'{np.median(values["CPU s FGM-D"] / own):.0f}']
        if 'J RRWM' in values:
            line += [f'{values["J RRWM"].mean():.3f}', f'{values["accuracy RRWM"].mean():.2f}']
            line += [f'{1e3 * np.median(values["CPU s RRWM"]):.0f}', f'{np.median(values["CPU s RRWM"] / own):.1f}']
        lines.append(line)
    header = [name, 'instances', 'J', 'smallest', 'right', 'FGM-D right', 'CPU ms', 'FGM-D / CPU']
    header += ['RRWM J', 'RRWM right', 'RRWM CPU ms', 'RRWM / CPU'] if 'J RRWM' in rows[0] else []
    return tables.table(header, lines)


def first_calls() -> str:
    """Measure import and first call in processes of their own, without and with a cache of compiled code."""
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, 'NUMBA_CACHE_DIR': cache, 'PYTHONPATH': str(tables.FOLDER.parent)}
        command = [sys.executable, '-c', FIRST_CALL]
        cold, warm = (
            [float(word) for word in subprocess.check_output(command, env=environment, text=True).split()]
            for _ in range(2)
        )
    return (
        f'Import {warm[0]:.1f} s wall ({warm[1]:.1f} s CPU); the first call ever, which compiles, {cold[2]:.0f} s '
        f'({cold[3]:.0f} s CPU); the first call of a process after that {warm[2]:.2f} s ({warm[3]:.2f} s CPU).'
    )


if __name__ == '__main__':
    main()
