"""What PCL 1.13 made of two clouds, stored in ``$CSGM_SHARED/reference/pcl``, and what its two benchmarks share."""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.harness import RESULTS
from benchmarks.meshes import shared_folder

RUNS = [(model, nodes) for model in ('bunny', 'cloud_bin_0') for nodes in (50, 150, 400)]
"""Model and nominal number of supervoxels."""


@dataclass(frozen=True, eq=False)
class Run:
    """One stored run of PCL: its input, its answers (``stored``, see the reference page) and its ``times``."""

    name: str
    points: np.ndarray
    stored: dict[str, np.ndarray]
    times: dict[str, float]

    @property
    def labels(self) -> np.ndarray:
        """Supervoxel of each point, -1 for none."""
        return self.stored['point_label'].astype(np.int64) - 1


def load(model: str, nodes: int) -> Run:
    """Read one stored run."""
    if not shared_folder():
        raise SystemExit('CSGM_SHARED must name the folder of the reference data')
    folder = shared_folder() / 'reference' / 'pcl'
    points = np.load(folder / f'{model}_points.npz')['points'].astype(np.float64)
    stored = dict(np.load(folder / f'{model}_{nodes}.npz'))
    return Run(f'{model} {nodes}', points, stored, json.loads(str(stored['times'])))


def cpu_seconds(call: Callable[[], object], repeats: int = 5) -> float:
    """Return the median CPU time of a call that has run before."""
    taken = []
    for _ in range(repeats):
        start = time.process_time()
        call()
        taken.append(time.process_time() - start)
    return float(np.median(taken))


def first_call(statement: str) -> list[tuple[str, str, str, str]]:
    """Return (numba's cache, CPU seconds to import, of the first call, of the second) of fresh processes.

    ``statement`` holds imports, then a line ``#``, then the call.
    """
    imports, _, call = statement.partition('#')
    script = f'from time import process_time as now; a = now()\n{imports}\nb = now()\n{call}\nc = now()\n{call}\n'
    script += 'd = now(); print(f"{b - a:.2f} {c - b:.2f} {d - c:.4f}")'
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {'NUMBA_CACHE_DIR': cache}
        command = [sys.executable, '-c', script]
        folder = Path(__file__).resolve().parents[1]
        found = []
        for state in ('empty', 'filled'):
            said = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, check=True)
            found.append((state, *said.stdout.split()))
    return found


def options(description: str, name: str) -> argparse.ArgumentParser:
    """Return the options that both benchmarks have."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument('--quick', action='store_true', help='the smallest run alone, to see that it works')
    parser.add_argument('--csv', type=Path, default=RESULTS / f'{name}.csv', help='%(default)s')
    parser.add_argument('--results', type=Path, default=RESULTS, help='folder for the Markdown tables')
    return parser


def write_csv(path: Path, rows: Sequence[dict]) -> None:
    """Write rows, whose first one names the columns."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open('w', newline='') as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
