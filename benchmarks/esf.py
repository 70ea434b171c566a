"""ESF beside PCL's of the same supervoxels, and what the descriptors of a whole cloud cost."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
from scipy.spatial.distance import cdist

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import pcl, tables
from csgm_ros.structure.descriptors import context, esf_of_groups, members_of
from csgm_ros.structure.fpfh import fpfh
from csgm_ros.structure.supervoxels import segment

SAMPLES = 20000
FIRST = """
import numpy as np
from csgm_ros.structure.descriptors import context
#
points = np.random.default_rng(0).uniform(0, 1, (500, 3))
context(points, points, points[:4], 0.5, np.random.default_rng(0), 100)
"""


def main() -> None:
    options = pcl.options(__doc__, 'esf').parse_args()
    runs = [pcl.load(*run) for run in (pcl.RUNS[:1] if options.quick else pcl.RUNS)]
    rows = [beside_pcl(run) for run in runs]
    pcl.write_csv(options.csv, rows)
    tables.report('esf', 'ESF beside PCL 1.13', body(rows, [of_a_cloud(run) for run in runs]), options.results)


def beside_pcl(run: pcl.Run) -> dict:
    """Describe PCL's own supervoxels; two runs of PCL differ by chance, and so may we from PCL."""
    labels, described = run.labels, run.stored['esf_label'] - 1
    groups = members_of(labels, labels.max() + 1)
    own = esf_of_groups(run.points, *groups, np.random.default_rng(0), SAMPLES, threads=1)[described]
    cpu, walls = {}, {}
    for threads in (1, 2):
        wall, start = time.perf_counter(), time.process_time()
        esf_of_groups(run.points, *groups, np.random.default_rng(0), SAMPLES, threads=threads)
        cpu[threads] = (time.process_time() - start) / (labels.max() + 1) * 1e3
        walls[threads] = time.perf_counter() - wall
    theirs = run.times['esf_cpu_total'] / run.times['esf_runs'] / run.times['esf_clusters'] * 1e3
    distance = cdist(own, run.stored['esf'])
    return {
        'run': run.name,
        'shapes': len(own),
        'CPU ms a shape': round(cpu[1], 2),
        'PCL CPU ms': round(theirs, 2),
        'CPU / PCL': round(cpu[1] / theirs, 2),
        'wall s, 1 thread': round(walls[1], 2),
        'wall s, 2 threads': round(walls[2], 2),
        'L2 to PCL': round(float(distance.diagonal().mean()), 4),
        'PCL to PCL': round(float(run.stored['esf_within_mean']), 4),
        'largest L2': round(float(distance.diagonal().max()), 4),
        'L2 between shapes': round(float(run.stored['esf_between_mean']), 4),
        'nearest of PCL is itself': round(float((distance.argmin(1) == np.arange(len(own))).mean()), 3),
        'PCL nearest is itself': round(float(run.stored['esf_rerun_top1']), 3),
    }


def of_a_cloud(run: pcl.Run) -> dict:
    """Describe the surroundings of a cloud's supervoxels with the sizes and samples of the robust profile."""
    points = run.points
    radius = float(np.linalg.norm(points - points.mean(0), axis=1).max())
    cut = segment(points, 0.03 * radius, 0.2 * radius)
    surface = cut.voxel_points, cut.voxel_normals
    ball = 1.5 * 0.2 * radius
    both = pcl.cpu_seconds(lambda: context(*surface, cut.centroids, ball, np.random.default_rng(0), 4000), 3)
    histograms = pcl.cpu_seconds(lambda: fpfh(*surface, ball, cut.centroids), 3)
    return {
        'cloud': run.name.split()[0],
        'points': len(points),
        'voxels': len(cut.voxel_points),
        'nodes': len(cut),
        'segment CPU s': round(pcl.cpu_seconds(lambda: segment(points, 0.03 * radius, 0.2 * radius), 3), 4),
        'FPFH CPU s': round(histograms, 4),
        'ESF CPU s': round(both - histograms, 4),
        'both CPU s': round(both, 4),
    }


def body(rows: list[dict], clouds: list[dict]) -> str:
    """Return the tables."""
    clouds = list({row['cloud']: row for row in clouds}.values())
    return '\n\n'.join(
        (
            f'{SAMPLES} samples a shape. PCL was measured once, on another day: its CPU seconds and descriptors are '
            'stored. The distance of PCL to PCL is that of two of its runs with different seeds.',
            tables.table(list(rows[0]), [row.values() for row in rows]),
            'With the sizes of the robust profile (voxels of 3 %, seeds of 20 % of the radius, balls of 1.5 seed '
            'sizes, 4000 samples):',
            tables.table(list(clouds[0]), [row.values() for row in clouds]),
            'The first call of a process:',
            tables.table(('numba cache', 'import CPU s', 'first call', 'second call'), pcl.first_call(FIRST)),
        )
    )


if __name__ == '__main__':
    main()
