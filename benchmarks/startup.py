"""What the first result waits for: CPU seconds before the first stage, and of warming up, beside importing Open3D.

Each measurement is a process of its own; the medians are of those, and the caches on the disk are filled before.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
REGISTER = """
import os, sys, time
from csgm_ros.progress import Clock

def enter(clock, stage):
    print(time.process_time(), flush=True)
    os._exit(0)

Clock.enter = enter  # the first stage is where the measurement ends
from csgm_ros.cli.main import main
sys.argv = ['csgm', 'register', *sys.argv[1:]]
main()
"""
WARM_UP = """
import time
import csgm_ros.{module} as module
started = time.process_time()
module.warm_up()
print(time.process_time() - started)
"""
OPEN3D = 'import time, open3d; print(time.process_time())'
MEASURED = (
    ('csgm register of two .npy files, until its first stage', REGISTER),
    ('warming up, mode pair', WARM_UP.format(module='registration')),
    ('warming up, mode tracking, after that', WARM_UP.format(module='tracking.session')),
    ('reference: import open3d', OPEN3D),
)


def measure(code: str, arguments: list[str]) -> float:
    """Return what the last line of a fresh process says."""
    command = [sys.executable, '-c', code, *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def main() -> None:
    """Print the table: medians and least of all processes, which take turns so that a load slows all of them alike."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--runs', type=int, default=9, help='processes for each line (default: %(default)s)')
    parser.add_argument('--quick', action='store_true', help='two processes for each line')
    options = parser.parse_args()
    seconds: dict[str, list[float]] = {name: [] for name, _ in MEASURED}
    with tempfile.TemporaryDirectory() as folder:
        files = [str(Path(folder) / f'{name}.npy') for name in ('source', 'target')]
        for number, file in enumerate(files):
            np.save(file, np.random.default_rng(number).normal(size=(20_000, 3)))
        for run in range(1 + (2 if options.quick else options.runs)):
            for name, code in MEASURED:
                found = measure(code, files)
                if run:  # the first fills the caches
                    seconds[name].append(found)
    reference = statistics.median(seconds[MEASURED[-1][0]])
    print('| CPU seconds of a fresh process | median | least | of the reference |\n|---|---|---|---|')
    for name, found in seconds.items():
        median = statistics.median(found)
        print(f'| {name} | {median:.2f} | {min(found):.2f} | {median / reference:.2f} |')
    print(json.dumps(seconds), file=sys.stderr)


if __name__ == '__main__':
    main()
