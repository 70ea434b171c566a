"""Seconds per stage and peak memory, and how both grow with the points and with the nodes of the graph.

Each size runs in a process of its own, so that the peak memory is its own; the first, unmeasured run there
compiles and loads everything.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import harness, meshes, tables
from benchmarks.datasets import Pair, database_c_pair

SIZES = (10**4, 10**5, 10**6, 10**7)
SEED_SIZES = (0.3, 0.2, 0.15, 0.1, 0.07)
"""Supervoxel radii: the smaller, the more nodes."""


def main() -> None:
    parser = harness.parser(__doc__.splitlines()[0], ['csgm'])
    parser.add_argument('--points', nargs='+', type=int, default=list(SIZES), help='points of the target (%(default)s)')
    parser.add_argument('--seed-sizes', nargs='+', type=float, default=list(SEED_SIZES), help='(%(default)s)')
    parser.add_argument('--one', nargs=2, metavar=('POINTS', 'SEED_SIZE'), help='measure one size, print it as JSON')
    options = parser.parse_args()
    mesh = (options.meshes or ['blob0'])[0]
    if options.one:
        print(json.dumps(measure(mesh, int(options.one[0]), float(options.one[1]), options)))
        return
    points = options.points[:2] if options.quick else options.points
    seed_sizes = options.seed_sizes[:2] if options.quick else options.seed_sizes
    by_points = [_in_a_process(mesh, count, 0.0, options) for count in points]
    by_nodes = [_in_a_process(mesh, 30000, size, options) for size in seed_sizes]
    body = (
        f'Mesh {mesh}, Database C pairs thinned or resampled on the surface to so many target points; the source has '
        f'the share that the recipe leaves it. Seconds of wall time; memory of the whole process, '
        f'both clouds included (Linux).\n\n'
        f'{_table(by_points)}\n\nThe same pair (30,000 points), hypotheses from the graph, smaller supervoxels:\n\n'
        f'{_table(by_nodes)}'
    )
    tables.report('profile_stages', 'Seconds per stage, memory, growth', body, options.results)


def _in_a_process(mesh: str, points: int, seed_size: float, options) -> dict:
    print(f'{points} points, seed size {seed_size or "default"}', file=sys.stderr, flush=True)
    command = [sys.executable, __file__, '--meshes', mesh, '--one', str(points), str(seed_size)]
    command += ['--set', *options.set] if options.set else []
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        message = result.stderr.strip().splitlines()[-1] if result.stderr.strip() else f'signal {-result.returncode}'
        return {'points': points, 'failed': message}
    return json.loads(result.stdout.splitlines()[-1])


def pair_of_size(mesh: str, points: int) -> Pair:
    """Return a Database C pair whose target has so many points, drawn uniformly on the surface of the mesh."""
    one = meshes.load(mesh)
    rng = np.random.default_rng(0)
    corners = one.vertices[one.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    # the recipe's first view keeps about half of the points
    chosen = rng.choice(len(area), 2 * points, p=area / area.sum())
    weights = rng.dirichlet((1, 1, 1), len(chosen))
    surface = sum(weights[:, [k]] * one.vertices[one.triangles[chosen, k]] for k in range(3))
    return database_c_pair(meshes.Mesh(mesh, surface, np.empty((0, 3), np.int64)), 0)


def measure(mesh: str, points: int, seed_size: float, options) -> dict:
    """Register once and return what it took."""
    import csgm_ros

    method = 'csgm-graph' if seed_size else 'csgm'
    changes = harness.parsed_changes(options.set) | ({'supervoxels.seed_size': seed_size} if seed_size else {})
    config = harness.product_config(method, changes)
    warm = database_c_pair(meshes.sculpture('blob', 0, resolution=32), 0)
    csgm_ros.register(warm.source, warm.target, config)
    pair = pair_of_size(mesh, points)
    before = _memory('VmRSS')
    Path('/proc/self/clear_refs').write_text('5')  # making the pair took memory too: forget that peak
    wall, cpu = time.perf_counter(), time.process_time()
    result = csgm_ros.register(pair.source, pair.target, config)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    graphs = [graph for graph in (result.source_graph, result.target_graph) if graph is not None]
    return {
        'points': len(pair.target),
        'source points': len(pair.source),
        'nodes': ' + '.join(str(len(graph.nodes)) for graph in graphs) or '-',
        **{stage: round(seconds, 3) for stage, seconds in result.timings.items()},
        'wall': round(wall, 2),
        'CPU': round(cpu, 2),
        'MiB before': before,
        'MiB peak': _memory('VmHWM'),
        'accepted': result.accepted,
    }


def _memory(field: str) -> int:
    """Return a memory figure of this process in MiB, by its name in the kernel's status file (Linux)."""
    lines = Path('/proc/self/status').read_text().splitlines()
    return next(int(line.split()[1]) // 1024 for line in lines if line.startswith(field))


def _table(lines: list[dict]) -> str:
    columns = list(dict.fromkeys(name for line in lines for name in line))
    return tables.table(columns, [[line.get(name, '') for name in columns] for line in lines])


if __name__ == '__main__':
    main()
