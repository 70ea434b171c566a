"""The demonstration: two processes over DDS, a result near the truth, and a clear end when a process dies."""

import os
import re
import signal
import subprocess
import sys

import numpy as np
import pytest

from csgm_ros.demo.simulation import simulate, write_pair
from csgm_ros.io.files import read_cloud

pytestmark = [pytest.mark.ros, pytest.mark.slow]
COMMAND = [sys.executable, '-u', '-m', 'csgm_ros.cli.main', 'demo']


@pytest.fixture(autouse=True, scope='module')
def _ros():
    pytest.importorskip('rclpy')


def ended(pid):
    """True when there is no such process, or only its remains."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    with open(f'/proc/{pid}/stat') as file:
        return file.read().rsplit(')', 1)[1].split()[0] == 'Z'


def test_the_demo_registers_the_synthetic_pair(tmp_path):
    run = subprocess.run([*COMMAND, '--output', str(tmp_path)], capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
    rows = [line.split() for line in run.stdout.splitlines() if re.fullmatch(r'( +-?\d+\.\d+){4}', line)]
    matrix = np.array(rows, float)
    made = simulate(0)
    moved = made.source @ matrix[:3, :3].T + matrix[:3, 3]
    assert np.linalg.norm(moved - made.truth.apply(made.source), axis=1).mean() < 0.05
    fused = read_cloud(tmp_path / 'fused.ply')
    assert len(fused.points) == len(made.source) + np.isfinite(made.target).all(axis=2).sum()
    assert (tmp_path / 'before_after.png').read_bytes().startswith(b'\x89PNG')
    for pid in re.findall(r'process (\d+)', run.stdout):
        assert ended(int(pid))


@pytest.mark.parametrize('name', ['node', 'sensors'])
def test_the_demo_says_which_process_died_and_stops_the_other(tmp_path, name):
    run = subprocess.Popen(
        [*COMMAND, '--output', str(tmp_path)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    pids = {}
    for line in run.stdout:
        if found := re.search(r'node is process (\d+), the sensors are process (\d+)', line):
            pids = {'node': int(found[1]), 'sensors': int(found[2])}
            break
    os.kill(pids[name], signal.SIGKILL)
    _, said = run.communicate()
    assert run.returncode == 1
    assert f'the {name} process ended with code -9' in said
    assert 'Traceback' not in said
    assert all(ended(pid) for pid in pids.values())


def test_the_demo_takes_real_files(tmp_path):
    write_pair(tmp_path / 'pair', 1)
    files = ['--source', str(tmp_path / 'pair' / 'sfm.ply'), '--target', str(tmp_path / 'pair' / 'kinect.ply')]
    run = subprocess.run([*COMMAND, *files, '--output', str(tmp_path / 'out')], capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
    assert 'truth' not in run.stdout
    assert (tmp_path / 'out' / 'fused.ply').is_file()
