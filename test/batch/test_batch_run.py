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
import dask
from distributed import WorkerPlugin

from csgm_ros import register
from csgm_ros.batch.pairs import from_table
from csgm_ros.batch.results import Results, read
from csgm_ros.batch.run import LOST, cluster, run
from csgm_ros.config import profile, replaced
from csgm_ros.errors import InputError
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
def scans(tmp_path_factory):
    """Three clouds of one scene in units of their own."""
    folder = tmp_path_factory.mktemp('scans')
    rng = np.random.default_rng(0)
    for name in ('0', '1', 'held'):
        np.save(folder / f'{name}.npy', random_similarity(rng).apply(room(0, density=300)))
    return folder


def written(path, *lines):
    path.write_text('\n'.join(['source,target,id', *lines, '']))
    return path


@pytest.fixture(scope='module')
def table(scans):
    """Two pairs that are done at once, as their sources are missing, and one that `holding` workers never end."""
    return written(scans / 'pairs.csv', 'none.npy,0.npy,first', 'none.npy,1.npy,second', 'held.npy,0.npy,held')


@pytest.fixture
def holding(tmp_path, monkeypatch):
    """Workers that are started now read held.npy from a disk that never answers."""
    script = tmp_path / 'holding.py'
    script.write_text(
        'import functools, time\n'
        'import csgm_ros.io.files as files\n'
        'def reading(real, path, *arguments):\n'
        "    while str(path).endswith('held.npy'):\n"
        '        time.sleep(0.1)\n'
        '    return real(path, *arguments)\n'
        'files.read_points = functools.partial(reading, files.read_points)\n'  # a worker runs this twice
    )
    monkeypatch.setenv('DASK_DISTRIBUTED__WORKER__PRELOAD', str(script))


@pytest.fixture(scope='module')
def client():
    with cluster(None, 2, threads=1, retries=1) as (client, _):
        yield client


def test_rows_are_the_bits_of_plain_calls_and_bad_pairs_stop_nothing(scans, client, tmp_path):
    client.register_plugin(Deadly())
    config = replaced(profile(), QUICK)
    good = '0.npy,1.npy,p0', '1.npy,0.npy,p1'
    pairs = from_table(written(scans / 'deadly.csv', *good, 'deadly.npy,0.npy,deadly', 'none.npy,0.npy,none'), config)
    with Results(tmp_path) as results:
        counts = run(pairs, results, client, retries=1)
        assert counts['failed'] == 2
        assert counts['accepted'] + counts['rejected'] == 2
        assert run(pairs, results, client)['earlier'] == 4
    rows = {row['id']: row for row in read(tmp_path)}
    assert 'killed its worker 2 times' in rows['deadly']['reason']
    assert 'none.npy: no such file; check the path' in rows['none']['reason']
    for pair in pairs[:2]:
        row = rows[pair.id]
        expected = register(read_cloud(pair.source).points, read_cloud(pair.target).points, config)
        assert row['T_target_source'] == expected.T_target_source.ravel().tolist()
        assert (row['accepted'], row['reason']) == (expected.accepted, expected.reason)
        assert row['margin'] == expected.verdict.margin


class Brief(WorkerPlugin):
    """Kills its worker as soon as that has done its second pair, once."""

    def __init__(self, mark):
        self.mark = mark

    def setup(self, worker):
        self.done, self.loop = 0, worker.loop

    def transition(self, key, start, finish, **_):
        self.done += finish == 'memory'
        if self.done == 2 and not self.mark.exists():
            self.loop.call_later(0.3, self.end)  # the client has heard by then

    def end(self):
        self.mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)


class Slow(Results):
    """A disk that has taken the first row only when the worker is dead."""

    def append(self, *rows):
        super().append(*rows)
        wait_for((self.folder / 'dead').exists)
        time.sleep(0.3)


def test_a_row_that_dies_with_its_worker_before_it_is_fetched_is_made_again(table, tmp_path):
    pairs = from_table(table, replaced(profile(), QUICK))[:2]
    with cluster(None, 1, threads=1) as (client, _), Slow(tmp_path) as results:
        client.register_plugin(Brief(results.folder / 'dead'))
        assert run(pairs, results, client)['failed'] == 2
    assert [row['id'] for row in read(tmp_path)] == ['first', 'second']


def command(*arguments):
    settings = [word for name, value in QUICK.items() for word in ('--set', f'{name}={value}')]
    return [sys.executable, '-m', 'csgm_ros.cli.main', 'batch', *map(str, arguments), *settings]


def start(words, **options):
    environment = {**os.environ, 'PYTHONPATH': str(ROOT), 'OMP_NUM_THREADS': '1'}
    return subprocess.Popen(
        words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **options
    )


def wait_for(condition, seconds=60):
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


def resumed(table, folder, *arguments):
    """Run again, now that held.npy can be read; nothing is lost, nothing done twice."""
    first = {row['id']: row['finished'] for row in read(folder)}
    assert set(first) == {'first', 'second'}
    running = start(command(table, '-o', folder, *arguments))
    said, _ = running.communicate(timeout=200)
    assert running.returncode == 0, said
    assert '2 done earlier' in said
    rows = read(folder)
    assert [row['id'] for row in rows] == ['first', 'held', 'second']
    assert first.items() <= {row['id']: row['finished'] for row in rows}.items()
    assert not rows[1]['failed']


def test_a_client_killed_in_the_middle_leaves_no_process_and_is_resumed(table, tmp_path, holding, monkeypatch):
    running = start(command(table, '-o', tmp_path, '--workers', 1), start_new_session=True)
    wait_for(lambda: finished(tmp_path) >= 2)
    running.kill()
    running.wait()
    wait_for(lambda: not members(running.pid), 30)
    monkeypatch.undo()
    resumed(table, tmp_path, '--workers', 1, '--reports')
    (held,) = [row for row in read(tmp_path) if row['id'] == 'held']
    assert [page.stem for page in (tmp_path / 'reports').iterdir()] == [held['key']]


class Cluster:
    """A scheduler of its own, and workers where they are asked for."""

    def __init__(self):
        with socket.socket() as probe:
            probe.bind(('127.0.0.1', 0))
            self.port = probe.getsockname()[1]
        self.address = f'tcp://127.0.0.1:{self.port}'
        self._started = []

    def start(self, *, worker=True):
        local = '--host', '127.0.0.1', '--no-dashboard'
        self.scheduler = start(
            [sys.executable, '-m', 'distributed.cli.dask_scheduler', *local, '--port', str(self.port)]
        )
        self._started.append(self.scheduler)
        wait_for(self._answers)
        if worker:
            words = [self.address, *local, '--nthreads', '1', '--death-timeout', '60']
            self._started.append(start([sys.executable, '-m', 'distributed.cli.dask_worker', *words]))

    def _answers(self):
        with socket.socket() as probe:
            return probe.connect_ex(('127.0.0.1', self.port)) == 0

    def close(self):
        for process in self._started:
            process.kill()
            process.wait()


@pytest.fixture
def own(monkeypatch):
    monkeypatch.setenv('DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT', '4s')  # so long is a lost scheduler looked for
    started = Cluster()
    with dask.config.set({'distributed.comm.timeouts.connect': '4s'}):
        yield started
    started.close()


def test_a_scheduler_killed_in_the_middle_ends_the_run_in_one_line_and_is_resumed(
    table, tmp_path, own, holding, monkeypatch
):
    own.start()
    running = start(command(table, '-o', tmp_path, '--scheduler', own.address))
    wait_for(lambda: finished(tmp_path) >= 2)
    own.scheduler.kill()
    said, _ = running.communicate(timeout=100)
    assert running.returncode == 2, said
    assert LOST in said
    assert 'Traceback' not in said
    monkeypatch.undo()
    own.start()  # workers end with their scheduler
    resumed(table, tmp_path, '--scheduler', own.address)


class Fatal:
    """A client before whose call of one name the scheduler dies; it notices only when it must, or at once."""

    def __init__(self, client, scheduler, name, *, noticed):
        self._client, self._scheduler, self._name, self._noticed = client, scheduler, name, noticed

    def __getattr__(self, name):
        if name == self._name:
            self._scheduler.kill()
            self._scheduler.wait()
            if self._noticed:
                wait_for(lambda: self._client.status != 'running')
        return getattr(self._client, name)


@pytest.mark.parametrize(('call', 'noticed'), [('nthreads', False), ('submit', False), ('submit', True)])
def test_a_scheduler_lost_at_any_call_ends_the_run_in_one_line(table, tmp_path, own, call, noticed):
    own.start(worker=False)
    pairs = from_table(table, profile())
    with Results(tmp_path) as results, cluster(own.address) as (client, _):
        fatal = Fatal(client, own.scheduler, call, noticed=noticed)
        with pytest.raises(InputError, match=LOST):
            run(pairs, results, fatal)


def test_a_scheduler_that_is_not_there_or_is_gone_at_the_end_is_no_traceback(own):
    own.start(worker=False)
    with cluster(own.address):
        own.scheduler.kill()
        own.scheduler.wait()
    with pytest.raises(InputError, match='no answer'), cluster(own.address):
        pass
