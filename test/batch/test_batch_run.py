"""Real local clusters, whose workers, scheduler and client are killed in the middle."""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from scenes import random_similarity, room

pytest.importorskip('distributed')
pytest.importorskip('pyarrow')
import cloudpickle
from distributed import WorkerPlugin

from csgm_ros import register
from csgm_ros.batch.pairs import from_table
from csgm_ros.batch.results import Results, read
from csgm_ros.batch.run import cluster, run
from csgm_ros.config import profile, replaced
from csgm_ros.io.files import read_cloud

ROOT = Path(__file__).parents[2]
# small enough that a pair takes a fraction of a second
QUICK = {
    'matching.alpha_steps': 5,
    'matching.search_effort': 0.0,
    'descriptors.esf_samples': 300,
    'supervoxels.seed_size': 0.3,
    'hypotheses.trials': 20000,
    'hypotheses.limit': 300,
    'verification.refined': 10,
    'verification.finalists': 2,
    'verification.fine_voxel_size': 0.03,
}
cloudpickle.register_pickle_by_value(sys.modules[__name__])


class Deadly(WorkerPlugin):
    """Kills the worker that reads a file named deadly.npy; comes back with every new worker."""

    def setup(self, worker):
        import csgm_ros.io.files as files

        real = files.read_points

        def reading(path, *arguments):
            if str(path).endswith('deadly.npy'):
                os.kill(os.getpid(), signal.SIGKILL)
            return real(path, *arguments)

        files.read_points = reading


@pytest.fixture(scope='module')
def table(tmp_path_factory):
    """Five pairs of one scene in units of their own, and one whose source is missing."""
    folder = tmp_path_factory.mktemp('scans')
    rng = np.random.default_rng(0)
    lines = ['source,target,id']
    for number in range(5):
        np.save(folder / f'{number}.npy', random_similarity(rng).apply(room(number, density=300)))
        lines.append(f'{number}.npy,{(number + 1) % 5}.npy,p{number}')
    path = folder / 'pairs.csv'
    path.write_text('\n'.join([*lines, 'none.npy,0.npy,missing', '']))
    return path


@pytest.fixture(scope='module')
def client():
    with cluster(None, 2, threads=1, retries=1) as (client, _):
        yield client


def test_rows_are_the_bits_of_plain_calls_and_bad_pairs_stop_nothing(table, client, tmp_path):
    client.register_plugin(Deadly())
    config = replaced(profile(), QUICK)
    path = table.with_name('deadly.csv')
    path.write_text('\n'.join([*table.read_text().splitlines()[:4], 'deadly.npy,0.npy,deadly', 'none.npy,0.npy,none']))
    pairs = from_table(path, config)
    with Results(tmp_path) as results:
        counts = run(pairs, results, client, retries=1)
        assert counts['failed'] == 2
        assert counts['accepted'] + counts['rejected'] == 3
        assert run(pairs, results, client)['earlier'] == 5
    rows = {row['id']: row for row in read(tmp_path)}
    assert 'killed its worker 2 times' in rows['deadly']['reason']
    assert 'none.npy: no such file; check the path' in rows['none']['reason']
    for pair in pairs[:3]:
        row = rows[pair.id]
        expected = register(read_cloud(pair.source).points, read_cloud(pair.target).points, config)
        assert row['T_target_source'] == expected.T_target_source.ravel().tolist()
        assert (row['accepted'], row['reason']) == (expected.accepted, expected.reason)
        assert row['margin'] == expected.verdict.margin


def command(*arguments):
    settings = [word for name, value in QUICK.items() for word in ('--set', f'{name}={value}')]
    return [sys.executable, '-m', 'csgm_ros.cli.main', 'batch', *map(str, arguments), *settings]


def start(words, **options):
    environment = {**os.environ, 'PYTHONPATH': str(ROOT), 'OMP_NUM_THREADS': '1'}
    return subprocess.Popen(
        words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **options
    )


def wait_for(condition, seconds=100):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, 'waited in vain'
        time.sleep(0.02)


def finished(folder):
    journal = folder / '_journal.jsonl'
    return journal.read_bytes().count(b'\n') if journal.exists() else 0


def members(group):
    """Processes of a process group that still run."""
    found = subprocess.run(['ps', '-o', 'stat=', '-g', str(group)], capture_output=True, text=True).stdout
    return [state for state in found.split() if not state.startswith('Z')]


def test_a_client_killed_in_the_middle_leaves_no_process_and_is_resumed(table, tmp_path):
    running = start(command(table, '-o', tmp_path, '--workers', 2), start_new_session=True)
    wait_for(lambda: finished(tmp_path) >= 2)
    running.kill()
    running.wait()
    first = {row['id']: row['finished'] for row in read(tmp_path)}
    wait_for(lambda: not members(running.pid), 30)
    resumed = start(command(table, '-o', tmp_path, '--workers', 1))
    said, _ = resumed.communicate(timeout=200)
    assert resumed.returncode == 0, said
    assert f'{len(first)} done earlier' in said
    rows = read(tmp_path)
    assert sorted(row['id'] for row in rows) == ['missing', *(f'p{number}' for number in range(5))]
    assert first.items() <= {row['id']: row['finished'] for row in rows}.items()


def test_a_scheduler_killed_in_the_middle_ends_the_run_in_one_line_and_is_resumed(table, tmp_path):
    with socket.socket() as probe:
        probe.bind(('127.0.0.1', 0))
        address = f'tcp://127.0.0.1:{probe.getsockname()[1]}'
    dask = (
        [sys.executable, '-m', 'distributed.cli.dask_scheduler'],
        [sys.executable, '-m', 'distributed.cli.dask_worker'],
    )
    scheduler_words = [*dask[0], '--host', '127.0.0.1', '--port', address.rpartition(':')[2], '--no-dashboard']
    worker_words = [*dask[1], address, '--nthreads', '1', '--death-timeout', '60', '--no-dashboard']
    started = [start(scheduler_words), start(worker_words)]
    try:
        running = start(command(table, '-o', tmp_path, '--scheduler', address))
        wait_for(lambda: finished(tmp_path) >= 2)
        started[0].kill()
        said, _ = running.communicate(timeout=100)
        assert running.returncode == 2, said
        assert 'the scheduler is lost; what is done is kept: start it and run again' in said
        assert 'Traceback' not in said
        before = len(read(tmp_path))
        assert before < 6
        started += [start(scheduler_words), start(worker_words)]  # workers end with their scheduler
        resumed = start(command(table, '-o', tmp_path, '--scheduler', address))
        said, _ = resumed.communicate(timeout=200)
        assert resumed.returncode == 0, said
        assert f'{before} done earlier' in said
        rows = read(tmp_path)
        assert len(rows) == len({row['id'] for row in rows}) == 6
    finally:
        for process in started:
            process.kill()
            process.wait()
