"""The demonstration: the real node in its own process registers clouds that another process publishes over DDS."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from csgm_ros.errors import CsgmError, InputError
from csgm_ros.io import files, resources
from csgm_ros.io import results as report
from csgm_ros.io.transforms import matrix_text
from csgm_ros.types import Similarity

ACCEPTED, FAILED, REJECTED = 0, 1, 3
# What counts as right on the synthetic pair, whose truth is exact.
LIMITS = {'rotation_deg': 2.0, 'scale_percent': 2.0, 'mean_displacement': 0.05}
PATIENCE = 30.0  # seconds for a cloud to be heard


class DemoError(CsgmError):
    """A process of the demonstration ended, or the node refused."""


@dataclass(frozen=True, eq=False)
class Pair:
    """What the demonstration registers; the truth is None for files of the user."""

    source: files.CloudFile
    target: files.CloudFile
    shape: tuple[int, ...]
    truth: Similarity | None


def run(source: str | None, target: str | None, output: str, seed: int = 0) -> int:
    """Run the demonstration and return its exit code.

    Parameters
    ----------
    source, target : str or None
        Files; both, or neither for the synthetic pair.
    output : str
        Folder for the fused cloud, the picture and the log of the node; made when missing.
    seed : int
        Of the synthetic scene and of the registration.

    Raises
    ------
    InputError, DemoError
        For files that cannot be used; when a process ends early, with the last lines of its log.
    """
    say = Narrator()
    pair = _pair(source, target, seed, say)
    folder = output_folder(output)
    isolate()
    with tempfile.TemporaryDirectory() as scratch:
        clouds = _published(pair, Path(scratch) / 'pair.npz')
        commands = {
            'node': ['csgm_ros.ros.node', '--ros-args', '-p', f'seed:={seed}'],
            'sensors': ['csgm_ros.ros.client.sensors', str(clouds)],
        }
        with processes(commands, folder) as pids:
            say(f'node is process {pids["node"]}, the sensors are process {pids["sensors"]}; {_domain()}')
            answer, published = _drive(say)
    if published is None:
        print(f'\n{answer}\nNothing was published on ~/transform, as the result is not good enough.')
        return REJECTED
    return _conclude(pair, published, folder, say)


def _pair(source: str | None, target: str | None, seed: int, say: Narrator) -> Pair:
    if bool(source) != bool(target):
        raise InputError('demo needs both --source and --target, or neither')
    if source and target:
        say(f'reading {source} and {target}')
        clouds = files.read_cloud(source), files.read_cloud(target)
        return Pair(*clouds, clouds[1].points.shape, None)
    from csgm_ros.demo.simulation import simulate

    say('simulating a room, seen by a Kinect and rebuilt by structure from motion')
    made = simulate(seed)
    seen = np.isfinite(made.target).all(axis=2)
    say(f'Kinect: {made.target.shape[1]} x {made.target.shape[0]} pixels, {seen.sum()} with depth, metres')
    say(f'SfM: {len(made.source)} points, unit and pose of its own')
    target_cloud = files.CloudFile(made.target.reshape(-1, 3).astype(float), made.target_colors.reshape(-1, 3))
    return Pair(files.CloudFile(made.source, made.source_colors), target_cloud, made.target.shape, made.truth)


def _published(pair: Pair, path: Path) -> Path:
    """Write what the sensors publish; an organised target stays organised."""
    arrays = {'source': pair.source.points, 'target': pair.target.points.reshape(pair.shape)}
    for name, cloud in (('source', pair.source), ('target', pair.target)):
        if cloud.colors is not None:
            colors = (255 * cloud.colors).round().astype(np.uint8)
            arrays[f'{name}_colors'] = colors.reshape(arrays[name].shape)
    np.savez(path, **arrays)  # type: ignore[arg-type]  # the stub takes any name for allow_pickle
    return path


def _drive(say: Narrator):
    """Take the node from unconfigured to a result; return its answer, and what it published or None."""
    from csgm_ros.ros.client.connection import Client
    from csgm_ros.ros.client.results import fetch

    with Client() as client:
        activate(client, say)
        say('active; waiting for both clouds')
        end = time.monotonic() + PATIENCE
        while not all(int(client.status().values[name]['received']) for name in ('source', 'target')):
            if time.monotonic() > end:
                raise DemoError(f'the node heard no clouds within {PATIENCE:g} s; does a firewall block UDP here?')
        say('both clouds heard; calling ~/register')
        answer = client.register()
        say(f'the node answers: {answer.message}')
        return answer.message, fetch() if answer.success else None


def _conclude(pair: Pair, published, folder: Path, say: Narrator) -> int:
    """Print the result, write the files, and compare with the truth where it is known."""
    from csgm_ros.visual.pictures import before_after

    transform = published.transform
    fused = published.fused
    colors = None if fused.colors is None else fused.colors / 255
    files.write_cloud(folder / 'fused.ply', fused.points, colors)
    caption = f'scale {transform.scale:.5g}'
    wrong = []
    if pair.truth is not None:
        found = report.errors(transform, pair.truth, pair.source.points)
        wrong = [name for name, limit in LIMITS.items() if not found[name] <= limit]
        caption += (
            f' (truth {pair.truth.scale:.5g})   error: rotation {found["rotation_deg"]:.2f} deg, '
            f'scale {found["scale_percent"]:.2f} %, mean displacement {1000 * found["mean_displacement"]:.1f} mm'
        )
    before_after(folder / 'before_after.png', pair.source, pair.target, transform, caption)
    print(f'\nT_target_source, x_target = s R x_source + t, {published.child_frame_id} in {published.frame_id}:')
    print(matrix_text(transform.matrix))
    print(caption)
    print(f'written: {folder}/fused.ply, {folder}/before_after.png, {folder}/node.log')
    say('done')
    if wrong:
        print(f'csgm: accepted, but wrong against the known truth: {", ".join(wrong)}', file=sys.stderr)
        return FAILED
    return ACCEPTED


def output_folder(output: str) -> Path:
    """Return the folder to write to, made where it is missing."""
    folder = Path(output)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f'{folder}: cannot be made ({error.strerror}); choose another folder') from None
    return folder


def activate(client, say: Narrator) -> None:
    """Take the node from unconfigured to active."""
    say('configuring the node; the first time it compiles its kernels, which may take a minute')
    for step in (client.configure, client.activate):
        answer = step()
        if not answer.success:
            raise DemoError(f'the node refused: {answer.message}; its log tells why')


def isolate() -> None:
    """Keep this process and its children apart from any other ROS system."""
    os.environ['ROS_DOMAIN_ID'] = str(_free_domain())
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    os.environ.pop('ROS_LOCALHOST_ONLY', None)
    os.environ.setdefault('FASTRTPS_DEFAULT_PROFILES_FILE', str(resources.config_file('fastdds.xml')))


def _free_domain() -> int:
    """Return a ROS domain without a participant: the first one binds UDP port 7410 + 250 * domain (DDSI-RTPS 9.6)."""
    start = os.getpid()
    for domain in (20 + (start + step) % 80 for step in range(80)):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(('', 7410 + 250 * domain))
            except OSError:
                continue
            return domain
    raise DemoError('every ROS domain of this machine is in use')


def _domain() -> str:
    return f'ROS domain {os.environ["ROS_DOMAIN_ID"]}, this machine only'


@contextmanager
def processes(commands: dict[str, list[str]], folder: Path):
    """Run modules in processes of their own, each with a log; raise DemoError as soon as one of them ends."""
    running: dict[str, subprocess.Popen] = {}

    def on_child(*_):
        for name, process in running.items():
            if process.poll() is not None:
                log = folder / f'{name}.log'
                last = (log.read_text(errors='replace').strip().splitlines() or ['nothing'])[-1]
                raise DemoError(f'the {name} process ended with code {process.returncode}; {log} ends with: {last}')

    previous = signal.signal(signal.SIGCHLD, on_child)
    try:
        for name, command in commands.items():
            with (folder / f'{name}.log').open('wb') as log:
                # A session of its own: Ctrl-C reaches this process alone, which then stops the others in order.
                running[name] = subprocess.Popen(
                    [sys.executable, '-m', *command], stdout=log, stderr=log, start_new_session=True
                )
        yield {name: process.pid for name, process in running.items()}
    finally:
        signal.signal(signal.SIGCHLD, previous)
        for process in running.values():
            process.terminate()
        for process in running.values():
            try:
                process.wait(5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


class Narrator:
    """Prints what happens, and when."""

    def __init__(self):
        self._start = time.monotonic()

    def __call__(self, text: str) -> None:
        """Print one line."""
        print(f'[{time.monotonic() - self._start:5.1f} s] {text}', flush=True)
