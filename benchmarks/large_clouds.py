"""Clouds larger than memory: CPU seconds and peak memory of reading and thinning them, from a million points on.

``python benchmarks/large_clouds.py FOLDER``; a file of 10^8 points takes 1.2 GB (.npy) and 3 GB (.las) in FOLDER.
Every file is read in a process of its own, so that the peak is that of the file.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

BLOCK = 1_000_000
MOST = 1_000_000


def surfaces(rng: np.random.Generator) -> np.ndarray:
    """Return a block of points on random boxes and planes, 2 units across."""
    corners, sides = rng.uniform(-1, 1, (30, 3)), rng.uniform(0.05, 0.8, (30, 3))
    which, axis = rng.integers(0, 30, BLOCK), rng.integers(0, 3, BLOCK)
    within = rng.random((BLOCK, 3))
    within[np.arange(BLOCK), axis] = rng.integers(0, 2, BLOCK)
    return corners[which] + sides[which] * within


def write(path: Path, count: int) -> None:
    """Write so many points, block by block, with noise of 2 mm on each."""
    rng = np.random.default_rng(0)
    base = surfaces(rng)
    blocks = (base + rng.normal(scale=0.002, size=base.shape) for _ in range(count // BLOCK))
    if path.suffix == '.npy':
        array = np.lib.format.open_memmap(path, 'w+', np.float32, (count, 3))
        for number, block in enumerate(blocks):
            array[number * BLOCK : (number + 1) * BLOCK] = block
        return
    import laspy

    header = laspy.LasHeader(version='1.4', point_format=6)
    header.scales, header.offsets = [1e-4] * 3, [0.0] * 3
    with laspy.open(path, 'w', header=header) as file:
        for block in blocks:
            record = laspy.ScaleAwarePointRecord.zeros(BLOCK, header=header)
            record['X'], record['Y'], record['Z'] = np.rint(block / 1e-4).astype(np.int32).T
            file.write_points(record)


def read(path: Path, threads: int) -> None:
    """Read and thin one file and print what it took."""
    from csgm_ros.cloud.thin import thinned
    from csgm_ros.io.files import read_points

    thinned([np.random.default_rng(0).random((1000, 3))], 100)  # compiled
    wall, cpu = time.perf_counter(), time.process_time()
    points = read_points(path, MOST, threads)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f'| {path.name} | {threads} | {len(points)} | {cpu:.2f} | {wall:.2f} | {peak:.2f} |', flush=True)


def register(count: int, threads: int) -> None:
    """Register a cloud of so many points that is in memory, with one as large and with one of 100,000 points."""
    from csgm_ros import Similarity, profile
    from csgm_ros import register as registered
    from csgm_ros.config import replaced

    rng = np.random.default_rng(0)
    base, config = surfaces(rng), replaced(profile(), {'threads': threads})
    truth = Similarity(2.0, np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([5.0, 3.0, 1.0]))

    def cloud(points: int) -> np.ndarray:
        chosen = base[rng.integers(len(base), size=points)]
        return (chosen + rng.normal(scale=0.002, size=chosen.shape)).astype(np.float32)

    few = cloud(100_000)
    registered(few, truth.apply(few), config)  # every library loaded
    source = cloud(count)
    print('| source | target | accepted | CPU s | wall s |\n| --- | --- | --- | --- | --- |')
    for points in (few, cloud(count)):
        target = truth.apply(points).astype(np.float32)
        wall, cpu = time.perf_counter(), time.process_time()
        result = registered(source, target, config)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        print(f'| {count} | {len(target)} | {result.accepted} | {cpu:.2f} | {wall:.2f} |', flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('folder', type=Path)
    parser.add_argument('--points', type=float, nargs='+', default=[1e6, 1e7, 1e8])
    parser.add_argument('--kinds', nargs='+', default=['.npy', '.las'])
    parser.add_argument('--threads', type=int, default=1)
    parser.add_argument('--register', type=float, help='so many points that are in memory, instead')
    parser.add_argument('--read', type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.register:
        register(int(options.register), options.threads)
        return
    if options.read:
        read(options.read, options.threads)
        return
    print('| file | threads | voxels | CPU s | wall s | peak GB |\n| --- | --- | --- | --- | --- | --- |', flush=True)
    for count in map(int, options.points):
        for kind in options.kinds:
            path = options.folder / f'{count}{kind}'
            write(path, count)
            words = [str(options.folder), '--threads', str(options.threads), '--read', str(path)]
            subprocess.run([sys.executable, __file__, *words], check=True)
            path.unlink()


if __name__ == '__main__':
    main()
