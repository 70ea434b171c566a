"""Many registrations on Dask distributed: paths go out, rows come back, and what is done stays done."""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import itertools
import logging
import multiprocessing
import os
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from csgm_ros.batch.pairs import Pair
from csgm_ros.batch.results import Results
from csgm_ros.batch.work import failed, register_pair
from csgm_ros.errors import InputError

OUTSTANDING = 1000  # pairs that the scheduler knows at least at a time, else two a worker: a few megabytes
BYTES_A_WORKER = 1.5e9  # a registration of two clouds of some million points
GONE = OSError, asyncio.CancelledError, concurrent.futures.CancelledError
LOST = 'the scheduler is lost; what is done is kept: start it and run again'


def run(
    pairs: Sequence[Pair],
    results: Results,
    client,
    *,
    threads: int = 1,
    retries: int = 2,
    pages: str = '',
    stream=None,
) -> dict:
    """Register the pairs that have no row yet, each of them once.

    Parameters
    ----------
    pairs : sequence of Pair
    results : Results
        Takes a row as soon as its pair is done.
    client : distributed.Client
    threads : int, optional
        Threads a registration.
    retries : int, optional
        How often a pair that raises what is no :class:`csgm_ros.errors.CsgmError` is tried again. One that kills its
        worker is tried again as often as the scheduler allows (`distributed.scheduler.allowed-failures`).
    pages : str, optional
        Folder, as the workers see it, for a page of each pair; default: none is written.
    stream : file, optional
        For progress; default: stderr.

    Returns
    -------
    dict
        How many pairs were `accepted`, `rejected`, `failed` now, and `earlier`.

    Raises
    ------
    InputError
        When the scheduler is lost or the disk is full; what is done is kept.
    """
    from distributed import as_completed

    left = [pair for pair in pairs if pair.key not in results.keys]
    counts = {'accepted': 0, 'rejected': 0, 'failed': 0, 'earlier': len(pairs) - len(left)}
    with _Progress(len(pairs), len(pairs) - len(left), stream or sys.stderr) as progress, _lost_at_interrupt(results):
        waiting = enumerate(left)
        going: dict[str, Pair] = {}
        with asking(client):
            queue = as_completed(loop=client.loop)
            batches = queue.batches()

        def submit() -> None:
            with asking(client):
                most = max(OUTSTANDING, 2 * sum(client.nthreads().values()))
                for number, pair in itertools.islice(waiting, max(0, most - len(going))):
                    how = {'key': f'register-{pair.key}', 'priority': -number, 'retries': retries}  # in their order
                    future = client.submit(register_pair, pair, threads, pages, **how)
                    going[future.key] = pair
                    queue.add(future)

        submit()
        while going:
            rows = []  # those done since the last look share one wait for the disk
            with asking(client):
                for future in next(batches):
                    if future.status == 'lost':  # done, and gone with its worker before it was fetched: it runs again
                        queue.add(future)
                    else:
                        rows.append(_row(future, going.pop(future.key)))
            results.append(*rows)
            for row in rows:
                counts['failed' if row['failed'] else 'accepted' if row['accepted'] else 'rejected'] += 1
                progress(counts)
            submit()
    results.commit()
    return counts


@contextlib.contextmanager
def asking(client) -> Iterator[None]:
    """Say in one line whatever a call to a scheduler raises that is gone: Dask has many words for it.

    Raises
    ------
    InputError
        In their place.
    """
    try:
        yield
    except (Exception, asyncio.CancelledError) as error:
        if client.status == 'running' and not isinstance(error, GONE):
            raise  # no matter of the connection
        raise InputError(LOST) from error


def _row(future, pair: Pair) -> dict:
    """Return what a worker sent, or a row that says why it sent none."""
    from distributed import KilledWorker

    if future.status == 'cancelled':
        raise InputError(LOST)
    error = future.exception()
    if error is None:
        return future.result()
    if isinstance(error, KilledWorker):
        return failed(pair, f'killed its worker {_deaths(error)} times (out of memory, or a crash in native code)')
    return failed(pair, ' '.join(f'{type(error).__name__}: {error}'.split())[:500])


def _deaths(error) -> int:
    return getattr(error, 'allowed_failures', 0) + 1


@contextlib.contextmanager
def _lost_at_interrupt(results: Results) -> Iterator[None]:
    """Bring the journal into the data set when the run is interrupted; a killed run's is read by the next."""
    try:
        yield
    except KeyboardInterrupt:
        results.commit()
        raise


@contextlib.contextmanager
def cluster(address: str | None, workers: int = 0, *, threads: int = 0, retries: int = 2) -> Iterator[tuple]:
    """Connect to a Dask cluster, or start one on this machine for as long as the context lasts.

    Parameters
    ----------
    address : str or None
        Of a scheduler, or the path of its scheduler file; None starts a local cluster.
    workers : int, optional
        Of the local cluster; 0: one a core, as far as memory reaches.
    threads : int, optional
        Threads a registration; 0: the cores shared among the local workers, 1 on an existing cluster.
    retries : int, optional
        Worker deaths that the local scheduler forgives a pair.

    Yields
    ------
    (distributed.Client, int)
        And the threads a registration.

    Raises
    ------
    InputError
        When no scheduler answers there, or none can be started here.
    """
    import dask
    from distributed import Client, LocalCluster

    for name in ('distributed.client', 'distributed.scheduler', 'distributed.nanny', 'distributed.core'):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # a death is told once, by its pair or by us
    if address is not None:
        try:
            where = {'scheduler_file': address} if Path(address).is_file() else {'address': address}
            client = Client(**where, set_as_default=False)
        except (OSError, ValueError, TypeError, KeyError, ImportError) as error:
            raise InputError(f'--scheduler {address}: no answer ({error}); start it or check the address') from None
        with _closing(client):
            yield client, threads or 1
        return
    cores = len(os.sched_getaffinity(0))
    workers = workers or max(1, min(cores, int(_memory() // BYTES_A_WORKER)))
    threads = threads or max(1, cores // workers)
    before = set(multiprocessing.active_children())
    numbers = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS', 'NUMBA_NUM_THREADS')
    settings = {
        'distributed.scheduler.allowed-failures': retries,
        # a worker holds the pair that it works on and no other: only that one is blamed for its death
        'distributed.scheduler.worker-saturation': 1.0,
        # what watches tasks of milliseconds costs a fifth of ours
        'distributed.worker.profile.enabled': False,
        'distributed.admin.system-monitor.interval': '10s',
        'distributed.scheduler.work-stealing': False,
    }
    with dask.config.set(settings):
        try:
            local = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                host='127.0.0.1',
                dashboard_address='127.0.0.1:0',
                env={name: str(threads) for name in numbers},
                silence_logs=logging.CRITICAL,
            )
        except (OSError, RuntimeError) as error:
            raise InputError(
                f'{workers} workers could not be started here ({error}); take fewer by --workers'
            ) from None
        try:
            with _closing(Client(local, set_as_default=False)) as client:
                yield client, threads
        finally:
            # the workers hold nothing that is not on the disk: on a busy machine they do not end in time by themselves
            with contextlib.suppress(TimeoutError):
                local.close(timeout=10)
            for process in set(multiprocessing.active_children()) - before:
                process.kill()


@contextlib.contextmanager
def _closing(client) -> Iterator:
    """Close a client whose scheduler may be gone, which is said elsewhere."""
    try:
        yield client
    finally:
        with contextlib.suppress(*GONE, RuntimeError, AssertionError):
            client.close(timeout=10)


def _memory() -> int:
    return os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES')


class _Progress:
    """How many pairs are done and how long the rest will take: a bar on a terminal, else a line now and then."""

    EVERY = 10.0  # seconds between two lines

    def __init__(self, total: int, done: int, stream):
        self._total, self._first, self._stream = total, done, stream
        self._since = self._said = time.monotonic()
        self._bar = None

    def __enter__(self) -> _Progress:
        if self._stream.isatty():
            from tqdm import tqdm

            self._bar = tqdm(total=self._total, initial=self._first, unit='pair', file=self._stream, smoothing=0.05)
        return self

    def __exit__(self, *_):
        if self._bar is not None:
            self._bar.close()

    def __call__(self, counts: dict[str, int]) -> None:
        said = ', '.join(f'{counts[kind]} {kind}' for kind in ('accepted', 'rejected', 'failed'))
        if self._bar is not None:
            self._bar.set_postfix_str(said, refresh=False)
            self._bar.update()
            return
        now, done = time.monotonic(), sum(counts.values())
        if now - self._said < self.EVERY and done < self._total:
            return
        self._said = now
        left = (now - self._since) / (done - self._first) * (self._total - done)
        text = f'{int(left // 3600)}:{int(left // 60 % 60):02d}:{int(left % 60):02d} left'
        print(f'csgm: {done}/{self._total} pairs ({said}); {text}', file=self._stream, flush=True)
