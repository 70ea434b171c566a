"""Supervoxels beside PCL's on the same clouds, and how time and memory grow with the points."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import pcl, tables
from benchmarks.partitions import adjusted_rand, undersegmentation
from csgm_ros.structure.supervoxels import segment

SIZES = (10**4, 10**5, 10**6, 10**7)
FIRST = """
import numpy as np
from csgm_ros.structure.supervoxels import segment
#
segment(np.random.default_rng(0).uniform(0, 1, (20000, 3)) * [1, 1, 0.01], 0.03, 0.2)
"""


def main() -> None:
    parser = pcl.options(__doc__, 'supervoxels')
    parser.add_argument(
        '--points', nargs='+', type=int, default=list(SIZES), help='sizes to grow through (%(default)s)'
    )
    parser.add_argument('--one', type=int, help='measure one size, print it as JSON')
    options = parser.parse_args()
    if options.one:
        print(json.dumps(grown(options.one)))
        return
    runs = pcl.RUNS[:1] if options.quick else pcl.RUNS
    rows = [beside_pcl(pcl.load(*run)) for run in runs]
    growth = [in_a_process(points) for points in (options.points[:2] if options.quick else options.points)]
    pcl.write_csv(options.csv, rows)
    tables.report('supervoxels', 'Supervoxels beside PCL 1.13', body(rows, growth), options.results)


def beside_pcl(run: pcl.Run) -> dict:
    """Cut one cloud and compare with what PCL made of it; its refinement's distance from itself is the yardstick."""
    stored = run.stored
    sizes = float(stored['voxel_res']), float(stored['seed_res'])
    cut = segment(run.points, *sizes)
    cpu = pcl.cpu_seconds(lambda: segment(run.points, *sizes))
    refining = pcl.cpu_seconds(lambda: segment(run.points, *sizes, refinements=3), 3)
    reached = (run.labels >= 0) & (cut.labels >= 0)
    ours, theirs = cut.labels[reached], run.labels[reached]
    refined = stored['voxel_label'], stored['voxel_label_refined3']
    return {
        'run': run.name,
        'CPU s': round(cpu, 3),
        'PCL CPU s': round(run.times['cpu_total'], 3),
        'CPU / PCL': round(cpu / run.times['cpu_total'], 2),
        'CPU s, refined 3 times': round(refining, 3),
        'supervoxels': len(cut),
        'PCL supervoxels': len(stored['sv_label']),
        'degree': round(2 * len(cut.adjacency) / len(cut), 2),
        'PCL degree': round(2 * len(stored['sv_adjacency']) / len(stored['sv_label']), 2),
        'voxels each': f'{cut.sizes.mean():.0f} +- {cut.sizes.std():.0f}',
        'PCL voxels each': f'{stored["sv_nvoxels"].mean():.0f} +- {stored["sv_nvoxels"].std():.0f}',
        'unreached %': round(100 * float((cut.labels < 0).mean()), 2),
        'PCL unreached %': round(100 * float((run.labels < 0).mean()), 2),
        'ARI with PCL': round(adjusted_rand(ours, theirs), 3),
        'ARI PCL refined with PCL': round(adjusted_rand(*refined), 3),
        'outside': round(undersegmentation(ours, theirs), 3),
        'outside PCL refined': round(undersegmentation(*refined), 3),
    }


def wavy(count: int) -> np.ndarray:
    """Return points on a wavy square of side 1."""
    points = np.random.default_rng(0).random((count, 3))
    points[:, 2] = 0.05 * np.sin(12 * points[:, 0]) * np.cos(9 * points[:, 1])
    return points


def grown(count: int) -> dict:
    """Cut a cloud with about eight points a voxel, in this process alone, and return what it took."""
    segment(wavy(20000), 0.03, 0.2)
    points, voxel = wavy(count), (10 / count) ** 0.5
    before = memory('VmRSS')
    Path('/proc/self/clear_refs').write_text('5')
    wall, cpu = time.perf_counter(), time.process_time()
    cut = segment(points, voxel, 8 * voxel)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    peak = memory('VmHWM')
    return {
        'points': count,
        'voxels': len(cut.voxel_points),
        'supervoxels': len(cut),
        'CPU s': round(cpu, 3),
        'CPU us a point': round(cpu / count * 1e6, 2),
        'wall s': round(wall, 3),
        'MiB before': round(before),
        'MiB peak': round(peak),
        'bytes more a point': round((peak - before) * 2**20 / count),
    }


def memory(field: str) -> float:
    """Return a memory figure of this process in MiB, by its name in the kernel's status file (Linux)."""
    lines = Path('/proc/self/status').read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(field))


def in_a_process(count: int) -> dict:
    """Return :func:`grown` of a process of its own, so that the peak is its own."""
    command = [sys.executable, __file__, '--one', str(count)]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def body(rows: list[dict], growth: list[dict]) -> str:
    """Return the tables."""
    return '\n\n'.join(
        (
            'PCL was measured once, on another day: its CPU seconds and labels are stored. ARI: adjusted Rand index of '
            "the points' labels; outside: share of points outside the PCL supervoxel that most of their supervoxel "
            "lies in. The yardstick is three rounds of PCL's own refinement against PCL without.",
            tables.table(list(rows[0]), [row.values() for row in rows]),
            'Growth, at about eight points a voxel and 60 voxels a supervoxel; memory of the whole process, points '
            'included:',
            tables.table(list(growth[0]), [row.values() for row in growth]),
            'The first call of a process:',
            tables.table(('numba cache', 'import CPU s', 'first call', 'second call'), pcl.first_call(FIRST)),
        )
    )


if __name__ == '__main__':
    main()
