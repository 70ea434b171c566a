"""The real node under load for minutes: clouds that never stop, registrations, and clients that disturb it.

Two sensors of 300,000 points at 10 Hz that die and come back, which see one scene, so that their clouds register;
three clients that change parameters, deactivate, clean up, cancel and register at random. Every few seconds the process
is measured; all the time somebody listens to what it says of itself and to the transforms that it gives out, whose
truth is known.
"""

import argparse
import contextlib
import os
import random
import re
import sys
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from std_msgs.msg import Float64MultiArray

from csgm_ros.errors import CsgmError
from csgm_ros.ros.client.connection import Client
from csgm_ros.types import Similarity
from ros_helpers.clouds import displacement, easy_pair
from ros_helpers.peer import LATCHED, RELIABLE, Peer
from ros_helpers.process import NodeProcess, Process

SPACE = f'/soak_{os.getpid()}'  # a node that an interrupted run left over takes no part
PERIOD = 3.0  # seconds between two measurements
ANSWER = 60.0  # seconds within which every operation has to be answered
MEMORY = 0.05  # growth of the resident memory after warm-up
MOST_MEMORY = 1500.0  # MB resident at any time
HANDLES = 6  # threads or descriptors that come and go with the sensors and the pool of a running registration
AGE = 5.0  # seconds between the arrival of a message and its handling, on 2 cores that others use too
OFF = 0.03  # of the target's radius, by which a transform that is given out as right may be off
SHARED = Path('/dev/shm')


@dataclass
class Figures:
    """What was measured.

    Attributes
    ----------
    rows : list of tuple
        Seconds since the start, resident MB, threads, file descriptors, MB in /dev/shm.
    counts : dict
        Operations by name: (answered with success, answered with a reason).
    reasons : dict of str to collections.Counter
        How what was refused begins, by operation.
    slowest : dict
        Longest answer of each operation, seconds.
    unanswered : list of str
        Operations without an answer.
    clouds : int
        Messages that the node took.
    age : float
        Longest time of a message from its arrival to its callback, seconds.
    errors : list of float
        How far each transform that was given out is off, of the target's radius.
    tracebacks : int
        In the log of the node.
    """

    rows: list = field(default_factory=list)
    counts: dict = field(default_factory=dict)
    reasons: dict = field(default_factory=dict)
    slowest: dict = field(default_factory=dict)
    unanswered: list = field(default_factory=list)
    clouds: int = 0
    age: float = float('inf')
    errors: list = field(default_factory=list)
    tracebacks: int = 0

    def table(self) -> str:
        """Return the figures as text: ten moments, and the operations."""
        chosen = self.rows[:: max(1, len(self.rows) // 10)]
        lines = ['| s | resident MB | threads | descriptors | /dev/shm MB |', '|---|---|---|---|---|']
        lines += ['| {:.0f} | {:.0f} | {} | {} | {:.1f} |'.format(*row) for row in chosen]
        lines += ['', '| operation | done | refused with a reason | slowest answer s |', '|---|---|---|---|']
        lines += [
            f'| {name} | {done} | {refused} | {self.slowest[name]:.2f} |'
            for name, (done, refused) in sorted(self.counts.items())
        ]
        lines.append('')
        for name, reasons in sorted(self.reasons.items()):
            lines.append(f'{name}: ' + ', '.join(f'{reason} {count}' for reason, count in reasons.most_common()))
        memory, *others = self.growth()
        worst = f'{100 * max(self.errors):.2f} % of the radius' if self.errors else 'nothing'
        lines += [
            f'growth: {100 * memory:.1f} % of memory, {others} of the other columns',
            f'{self.clouds} clouds taken, the oldest {self.age:.2f} s after it came',
            f'{len(self.errors)} transforms given out, off by {worst} at most',
        ]
        return '\n'.join([*lines, f'unanswered: {self.unanswered or "none"}'])

    def growth(self) -> tuple[float, int, int, float]:
        """Return how much memory (share), threads, descriptors and MB in /dev/shm grew from the 2nd to the 4th quarter.

        Maxima are compared: in between the node may be inactive.
        """
        quarter = max(1, len(self.rows) // 4)
        parts = self.rows[quarter : 2 * quarter], self.rows[-quarter:]
        early, late = (np.array(part)[:, 1:].max(axis=0) for part in parts)
        return (
            float(late[0] / early[0] - 1),
            int(late[1] - early[1]),
            int(late[2] - early[2]),
            float(late[3] - early[3]),
        )

    def complaints(self, most: float = MEMORY) -> list[str]:
        """Return what is beyond the bounds; ``most`` is the growth of memory, without a bound while it warms up."""
        memory, threads, descriptors, shared = self.growth()
        found = [f'unanswered: {each}' for each in self.unanswered]
        found += [] if self.counts.get('register', (0, 0))[0] else ['no registration was accepted']
        found += [] if self.errors else ['no transform was heard']
        found += [f'a transform is {100 * max(self.errors):.1f} % off'] if max(self.errors, default=0.0) > OFF else []
        found += [f'{self.tracebacks} tracebacks in the log'] if self.tracebacks else []
        found += [f'memory grew by {100 * memory:.1f} %'] if memory > most else []
        largest = max(row[1] for row in self.rows)
        found += [f'{largest:.0f} MB resident'] if largest > MOST_MEMORY else []
        found += [f'{threads} more threads'] if threads > HANDLES else []
        found += [f'{descriptors} more descriptors'] if descriptors > HANDLES else []
        found += [f'{shared:.1f} MB more in /dev/shm'] if shared > 1.0 else []
        found += [f'a message waited {self.age:.1f} s'] if self.age > AGE else []
        return found


class Disturber(threading.Thread):
    """One client that does something at random, again and again."""

    def __init__(self, number: int, figures: Figures, lock: threading.Lock, stop: threading.Event, pause: float):
        super().__init__(daemon=True)
        self._rng, self._pause = random.Random(number), pause
        self._figures, self._lock, self._stop_asked = figures, lock, stop

    def run(self):
        try:
            self._disturb()
        except Exception as error:  # or it would be missed by nobody
            with self._lock:
                self._figures.unanswered.append(f'a client ended: {type(error).__name__}: {error}')

    def _disturb(self):
        with Client(f'{SPACE}/csgm', ANSWER) as client:
            operations = {
                'register': lambda: client.register(timeout=ANSWER),
                'cancel': client.cancel,
                'set_parameters': lambda: client.set_parameters(self._settings()),
                'refused parameters': lambda: client.set_parameters({'icp.iterations': -1}),
                'deactivate': client.deactivate,
                'deactivate, cleanup': lambda: [client.deactivate(), client.cleanup()][-1],
                'cleanup': client.cleanup,
                'configure': lambda: client.configure(timeout=ANSWER),
                'activate': client.activate,
                'state': client.state,
            }
            weights = [12, 1, 6, 2, 1, 1, 1, 8, 12, 4]  # so that most registrations come to their end
            while not self._stop_asked.wait(self._pause * self._rng.random()):
                (name,) = self._rng.choices(list(operations), weights)
                self._do(name, operations[name])

    def _settings(self) -> dict:
        return {'seed': self._rng.randrange(100), 'target_window': self._rng.randint(1, 3)}

    def _do(self, name, operation):
        started = time.monotonic()
        try:
            answer = operation()
        except CsgmError as error:
            with self._lock:
                self._figures.unanswered.append(f'{name}: {error}')
            return
        seconds = time.monotonic() - started
        with self._lock:
            done, refused = self._figures.counts.get(name, (0, 0))
            success = getattr(answer, 'success', True)
            if not success:
                reasons = self._figures.reasons.setdefault(name, Counter())
                reasons[re.sub(r'\d\S*', 'N', re.split('[;,(]', answer.message)[0]).strip()] += 1
            self._figures.counts[name] = (done + success, refused + (not success))
            self._figures.slowest[name] = max(seconds, self._figures.slowest.get(name, 0.0))


class Listener:
    """Hears what the node says of itself, ten times a second, and every transform that it gives out."""

    def __init__(self, figures: Figures):
        self._figures, self._last, self.heard = figures, {}, time.monotonic()
        self._source, target, self._truth = easy_pair()
        self._radius = np.linalg.norm(target - target.mean(0), axis=1).max()
        self._peer = Peer()
        self._peer.node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, RELIABLE)
        self._peer.node.create_subscription(Float64MultiArray, f'{SPACE}/csgm/similarity', self._on_transform, LATCHED)

    def close(self):
        self._peer.close()

    def _on_diagnostics(self, message):
        for side in ('source', 'target'):
            for status in message.status:
                if status.name == f'{SPACE[1:]}.csgm: {side}':
                    self._on_input(side, {pair.key: pair.value for pair in status.values})

    def _on_input(self, side, values):
        """Counts and delays begin anew with each activation."""
        figures, received, delay = self._figures, int(values['received']), float(values['longest delay ms']) / 1e3
        before = self._last.get(side, 0)
        figures.clouds += received - before if received >= before else received
        figures.age = delay if figures.age == float('inf') else max(figures.age, delay)
        self._last[side], self.heard = received, time.monotonic()

    def _on_transform(self, message):
        found = Similarity.from_matrix(np.reshape(message.data, (4, 4)))
        self._figures.errors.append(displacement(found, self._truth, self._source) / self._radius)


def sensor(side: str, points: int, rate: float):
    size = '--points', str(points), '--rate', str(rate)
    return Process('-m', 'ros_helpers.send_clouds', f'{SPACE}/{side}', '--side', side, *size, '--reliable')


def shared_megabytes(pid: int) -> float:
    """Return what a process holds of /dev/shm: the segments that lie beside its locks."""
    total = 0
    for entry in Path(f'/proc/{pid}/fd').iterdir():
        with contextlib.suppress(OSError):
            path = Path(os.readlink(entry))
            if path.parent == SHARED and path.name.endswith('_el'):
                total += path.with_name(path.name.removesuffix('_el')).stat().st_size
    return total / 2**20


def soak(seconds: float, *, points: int = 300_000, rate: float = 10.0, pause: float = 3.0, rebirth: float = 20.0):
    """Run the node for so long; return the figures.

    Parameters
    ----------
    seconds : float
    points, rate : int, float
        Size and frequency of the clouds on either input.
    pause : float
        Longest pause between two operations of a client, seconds.
    rebirth : float
        Seconds after which a sensor is killed and started again.
    """
    figures, lock, stop = Figures(), threading.Lock(), threading.Event()
    node = NodeProcess('-r', f'__ns:={SPACE}', '-p', 'autostart:=true', '-p', 'time_budget:=20.0')
    sensors = []
    listener = Listener(figures)
    try:
        node.wait_log('active: source', 600.0)  # its kernels may have to be compiled
        sensors = [sensor(side, points, rate) for side in ('source', 'target')]
        clients = [Disturber(number, figures, lock, stop, pause) for number in range(3)]
        for each in clients:
            each.start()
        watch(seconds, node, listener, sensors, figures, rebirth, (points, rate))
        stop.set()
        for each in clients:
            each.join(2 * ANSWER)
            if each.is_alive():
                figures.unanswered.append('a client waits for ever')
        left_alone(figures)
        figures.tracebacks = node.log.count('Traceback')
        node.close()
        return figures
    finally:
        stop.set()
        listener.close()
        for each in sensors:
            each.kill()
        if node.popen.poll() is None:
            node.kill()


def left_alone(figures):
    """Register undisturbed: whatever was done to the node, and however seldom it came to an end, it works as ever."""
    with Client(f'{SPACE}/csgm', ANSWER) as client:
        client.configure(timeout=ANSWER)
        client.activate()
        end = time.monotonic() + ANSWER
        while not (answer := client.register(timeout=ANSWER)).success and time.monotonic() < end:
            time.sleep(1.0)  # a sensor may just have been killed
    done, refused = figures.counts.get('register', (0, 0))
    figures.counts['register'] = (done + answer.success, refused + (not answer.success))
    while answer.success and not figures.errors and time.monotonic() < end:
        time.sleep(0.1)


def watch(seconds, node, listener, sensors, figures, rebirth, size):
    """Measure, and let the sensors die and come back in turn, one orderly and one by SIGKILL."""
    started = born = time.monotonic()
    turn = 0
    while (now := time.monotonic()) - started < seconds:
        assert node.popen.poll() is None, node.log
        if now - listener.heard > ANSWER:
            figures.unanswered.append(f'silent on /diagnostics for {now - listener.heard:.0f} s')
        figures.rows.append(
            (now - started, node.resident_mb(), node.threads(), node.descriptors(), shared_megabytes(node.pid))
        )
        if now - born > rebirth:
            born, which = now, turn % 2
            sensors[which].kill() if turn % 4 < 2 else sensors[which].end()
            sensors[which] = sensor(('source', 'target')[which], *size)
            turn += 1
        time.sleep(max(0.0, now + PERIOD - time.monotonic()))


def main():
    """Soak for so many minutes, print the table, and return 1 where something grew or stayed unanswered."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--minutes', type=float, default=20.0)
    parser.add_argument('--points', type=int, default=300_000)
    options = parser.parse_args()
    figures = soak(60 * options.minutes, points=options.points)
    print(figures.table())
    complaints = figures.complaints()
    print('\n'.join(complaints) or 'nothing grew, everything was answered')
    return bool(complaints)


if __name__ == '__main__':
    sys.exit(main())
