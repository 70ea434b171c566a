"""What inputs without an answer cost beside pairs that register, and by how much time budgets are overrun; CPU seconds.

``python benchmarks/bounds.py``; one thread, so that CPU seconds are the wall seconds of an idle machine.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from csgm_ros import progress, register
from csgm_ros.config import profile, replaced
from csgm_ros.io.files import read_points
from csgm_ros.registration import warm_up

ONE = replaced(profile(), {'threads': 1})
BUDGETS = (0.1, 0.2, 0.4, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 8.0)
POINTS = 20_000


def real_pairs() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the pairs of an SfM and a Kinect cloud by name."""
    folder = Path(os.environ['CSGM_SHARED']) / 'data/kinect_sfm'
    most = ONE.preprocess.max_points
    return {
        place.name: (read_points(place / 'sfm.ply', most), read_points(place / 'kinect.ply', most))
        for place in sorted(folder.iterdir())
    }


def shape(name: str, count: int, seed: int) -> np.ndarray:
    """Return a cloud in which there is nothing to register."""
    rng = np.random.default_rng([count, seed])
    if name == 'blob':
        return rng.normal(size=(count, 3))
    if name == 'volume':
        return rng.uniform(-1.0, 1.0, (count, 3))
    return np.column_stack(
        [rng.uniform(0.0, 2.0, count), rng.uniform(0.0, 1.3, count), rng.normal(scale=0.05, size=count)]
    )


def timed(clouds: tuple[np.ndarray, np.ndarray], budget: float = 0.0):
    """Return the CPU seconds of a registration, and its result."""
    start = time.process_time()
    result = register(*clouds, replaced(ONE, {'time_budget': budget}))
    return time.process_time() - start, result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--quick', action='store_true', help='two pairs, smaller clouds')
    options = parser.parse_args()
    warm_up()
    pairs = dict(list(real_pairs().items())[: 2 if options.quick else None])
    timed(next(iter(pairs.values())))  # every library loaded
    found = {name: timed(clouds) for name, clouds in pairs.items()}
    median = float(np.median([seconds for seconds, _ in found.values()]))
    print('| input | points | accepted | CPU s | of the median pair |\n|---|---|---|---|---|')
    print(f'| {len(found)} real pairs, median | | {sum(r.accepted for _, r in found.values())} | {median:.2f} | 1 |')
    hopeless = {
        f'{name} {count}': (shape(name, count, 0), shape(name, count, 1))
        for name in ('blob', 'volume', 'plane')
        for count in ((2000,) if options.quick else (4000, POINTS))
    }
    for name, clouds in hopeless.items():
        seconds, result = timed(clouds)
        print(
            f'| noisy {name} | {len(clouds[0])} | {int(result.accepted)} | {seconds:.2f} | {seconds / median:.1f} |',
            flush=True,
        )
    progress.time.perf_counter = time.process_time  # type: ignore[attr-defined]  # the budget in the same seconds
    print('\n| input | budgets | overrun, median s | largest s |\n|---|---|---|---|')
    for name, clouds in {**dict(list(pairs.items())[1:4]), **hopeless}.items():
        over = np.array([timed(clouds, budget)[0] - budget for budget in BUDGETS])
        over = over[over > 0.0]
        if len(over):
            print(f'| {name} | {len(over)} | {np.median(over):.2f} | {over.max():.2f} |', flush=True)


if __name__ == '__main__':
    main()
