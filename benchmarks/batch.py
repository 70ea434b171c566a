"""What many pairs cost beyond their registrations: plain calls against `csgm batch` on one and two workers.

``python benchmarks/batch.py --pairs 200``; then what a pair sends, receives and writes.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import pickle
import resource
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from csgm_ros.batch.pairs import Pair, from_table
from csgm_ros.batch.results import Results, read
from csgm_ros.batch.run import cluster, run
from csgm_ros.batch.work import register_pair
from csgm_ros.config import profile, replaced

# small enough that what is around a registration shows; a default pair takes five times as long
QUICK = {
    'matching.alpha_steps': 5,
    'matching.search_effort': 0.0,
    'descriptors.esf_samples': 300,
    'supervoxels.seed_size': 0.3,
    'hypotheses.trials': 20000,
    'hypotheses.limit': 300,
    'verification.refined': 10,
    'verification.finalists': 2,
}
CLOUDS = 20


def written_pairs(folder: Path, count: int) -> list[Pair]:
    """Write clouds of the demo's scene and the table of their pairs."""
    from csgm_ros.demo.simulation import simulate

    made = simulate(0)
    rng = np.random.default_rng(0)
    for number in range(CLOUDS):
        for side in ('source', 'target'):
            points = getattr(made, side).reshape(-1, 3)
            np.save(folder / f'{side}{number}.npy', rng.permutation(points[np.isfinite(points).all(1)])[:4000])
    rows = [f'source{k % CLOUDS}.npy,target{(k // CLOUDS) % CLOUDS}.npy,{k}' for k in range(count)]
    (folder / 'pairs.csv').write_text('\n'.join(['source,target,id', *rows, '']))
    return from_table(folder / 'pairs.csv', replaced(profile(), QUICK))


def spent() -> float:
    """CPU seconds of this process and of its children that have ended."""
    return sum(
        used.ru_utime + used.ru_stime
        for used in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


def measured(pairs: list[Pair], workers: int, folder: Path) -> tuple[float, float]:
    """Return wall and CPU seconds of a whole batch, the cluster's start and end included."""
    wall, cpu = time.perf_counter(), spent()
    with Results(folder) as results, cluster(None, workers, threads=1) as (client, threads):
        run(pairs, results, client, threads=threads, stream=open(os.devnull, 'w'))  # noqa: SIM115
    return time.perf_counter() - wall, spent() - cpu


def overhead(pairs: list[Pair], workers: int, folder: Path) -> float:
    """Return the CPU seconds a pair of client, scheduler and workers, of pairs whose files are missing."""
    missing = [dataclasses.replace(pair, source='/none.npy') for pair in pairs]
    empty = measured(missing[:workers], workers, folder / f'none{workers}')[1]
    return (measured(missing, workers, folder / f'missing{workers}')[1] - empty) / (len(pairs) - workers)


def traffic(pairs: list[Pair], folder: Path) -> tuple[Counter, int, float]:
    """Return the messages by name, their bytes, and the CPU seconds here, of pairs whose files are missing.

    The scheduler runs in this process, so that every message is seen here.
    """
    from distributed.batched import BatchedSend
    from distributed.protocol import dumps

    counts: Counter = Counter()
    sizes: Counter = Counter()

    def seen(name: str, message: object) -> None:
        counts[name] += 1
        sizes[name] += sum(memoryview(frame).nbytes for frame in dumps(message))

    def sending(self, *messages):
        for message in messages:
            seen(f'sent {message["op"]}', message)
        return send(self, *messages)

    def received(name, handler):
        def handle(*given, **message):
            seen(f'received {name}', message)
            return handler(*given, **message)

        return handle

    missing = [dataclasses.replace(pair, source='/none.npy') for pair in pairs]
    send, cpu = BatchedSend.send, 0.0
    with Results(folder) as results, cluster(None, 1, threads=1) as (client, threads):
        run(missing[:1], results, client, threads=threads, stream=open(os.devnull, 'w'))  # noqa: SIM115
        scheduler = client.cluster.scheduler
        for handlers in (scheduler.stream_handlers, scheduler.handlers):
            for name in ('task-finished', 'gather'):  # the client's are seen as they are sent
                if name in handlers:
                    handlers[name] = received(name, handlers[name])
        BatchedSend.send = sending
        try:
            cpu = time.process_time()
            run(missing, results, client, threads=threads, stream=open(os.devnull, 'w'))  # noqa: SIM115
            cpu = time.process_time() - cpu
        finally:
            BatchedSend.send = send
    return counts, sum(sizes.values()), cpu


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--pairs', type=int, default=200)
    parser.add_argument('--quick', action='store_true', help='ten pairs')
    options = parser.parse_args()
    count = 10 if options.quick else options.pairs
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        pairs = written_pairs(folder, count)
        register_pair(pairs[0], 1)  # compiled, and every library loaded
        wall, cpu = time.perf_counter(), time.process_time()
        rows = {pair.key: register_pair(pair, 1) for pair in pairs}
        plain = time.perf_counter() - wall, time.process_time() - cpu
        print(f'plain calls   {count} pairs: wall {plain[0]:7.1f} s, CPU {plain[1]:7.1f} s', flush=True)
        found = {}
        for workers in (1, 2):
            empty = measured(pairs[:workers], workers, folder / f'start{workers}')
            whole = measured(pairs, workers, folder / f'results{workers}')
            # the start of the cluster and the first pair of each worker, on which it loads its libraries, apart
            steady = [w - e + workers * p / count for w, e, p in zip(whole, empty, plain, strict=True)]
            names = 'T_target_source', 'reason', 'margin'
            done = read(folder / f'results{workers}')
            same = all(row[name] == rows[row['key']][name] for row in done for name in names)
            found[workers] = whole
            print(
                f'{workers} worker(s)   {count} pairs: wall {whole[0]:7.1f} s, CPU {whole[1]:7.1f} s, of which '
                f'start and end {empty[0]:.1f} s and {empty[1]:.1f} s; CPU over plain calls beyond these '
                f'{steady[1] / plain[1] - 1:+.1%}; same bits: {same}',
                flush=True,
            )
        print(f'speed-up of two workers over one, wall: {found[1][0] / found[2][0]:.2f}; load {os.getloadavg()[0]:.1f}')
        sent = len(pickle.dumps((register_pair, pairs[0], 1)))
        row = len(pickle.dumps(next(iter(rows.values()))))
        start = time.perf_counter()
        with Results(folder / 'writing') as results:
            for row_ in rows.values():
                results.append(row_)
        write = (time.perf_counter() - start) / count
        for workers in (1, 2):
            extra = overhead(pairs, workers, folder)
            print(
                f'{workers} worker(s): all that is not a registration takes {1e3 * extra:.1f} ms of CPU a pair, '
                f'{extra / (plain[1] / count):.1%} of a plain call here',
                flush=True,
            )
        counts, size, cpu = traffic(pairs, folder / 'traffic')
        said = ', '.join(f'{name} {number / (count - 1):.2f}' for name, number in counts.most_common(9))
        print(f'messages a pair: {said}; {size / (count - 1):.0f} bytes; {1e3 * cpu / (count - 1):.2f} ms of CPU')
        print(f'a pair: {sent} bytes out, {row} bytes back, {1e3 * write:.2f} ms to put its row on the disk')


if __name__ == '__main__':
    main()
