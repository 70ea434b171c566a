"""Damage inputs by the thousand: each is read or refused in one line, never a crash, a hang or made-up data.

    python -m fuzz.fuzz cloud.ply --count 20000 --seed 0      (in test/; a kind of file, bag.mcap, bag.sqlite3, yaml)

Each kind runs in a process of its own with bounded memory; the input that it died of is kept.
"""

import argparse
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

from csgm_ros.errors import CsgmError
from csgm_ros.io import bags
from csgm_ros.io.config_files import read_config
from csgm_ros.io.files import read_cloud
from fuzz import corpus
from fuzz.mutate import mutated

SAMPLED = ('stl', 'obj', 'glb', 'gltf', 'off')  # meshes, whose points are not those of the file
MEMORY = 6 << 30  # bytes of address space
SLOW = 5.0  # seconds of CPU that no input of a few kB may take
HANGS = 60  # seconds
BAGS = ('bag.mcap', 'bag.sqlite3')


class Finding(BaseException):
    """What no input may do."""


def check(kind: str, path: Path, size: int) -> str:
    """Read one input; return ``read`` or ``refused``, or raise Finding."""
    start = time.process_time()
    signal.signal(signal.SIGALRM, _too_long)
    signal.alarm(HANGS)
    try:
        said = _read(kind, path, size)
    except CsgmError as error:
        text = str(error)
        if '\n' in text or len(text) > 1000 or str(path) not in text:
            raise Finding(f'no one-line error that names the input: {text[:300]!r}') from None
        said = 'refused'
    except Exception as error:
        raise Finding(f'{type(error).__name__}: {error}') from error
    finally:
        signal.alarm(0)
    if time.process_time() - start > SLOW:
        raise Finding(f'took {time.process_time() - start:.1f} s')
    return said


def _too_long(*_):
    raise Finding(f'hangs: no answer within {HANGS} s')


def _read(kind: str, path: Path, size: int) -> str:
    if kind == 'yaml':
        read_config(path)
        return 'read'
    if kind in BAGS:
        bags.read_clouds(path, '/source', '/target')
        return 'read'
    cloud = read_cloud(path)
    points = cloud.points
    if points.ndim != 2 or points.shape[1] != 3 or not len(points) or points.dtype != float:
        raise Finding(f'points of shape {points.shape}')
    # the shortest point in a file: three digits with a space after each, or a byte each; deflate makes 1032 of 1
    counted = kind not in corpus.CAMERAS and kind.rsplit('.')[-1] not in SAMPLED
    if counted and len(points) * 3 > size * (1032 if kind.endswith(('z', 'png')) else 1):
        raise Finding(f'{len(points)} points of {size} bytes')
    for part, low in ((cloud.colors, 0.0), (cloud.normals, -np.inf)):
        if part is not None and (part.shape != points.shape or (part < low).any()):
            raise Finding(f'colours or normals of shape {part.shape}')
    if cloud.colors is not None and (cloud.colors > 1.0).any():
        raise Finding('colours above 1')
    return 'read'


def inputs(kind: str, count: int, seed: int, folder: Path):
    """Yield (path, bytes in all) of each damaged input, which is written over the one before."""
    rng = np.random.default_rng(seed)
    if kind in BAGS:
        parts, at = corpus.bag(folder, kind.partition('.')[2]), folder / 'damaged'
        at.mkdir()
        for _ in range(count):
            victim = list(parts)[int(rng.integers(len(parts)))]
            for name, data in parts.items():
                (at / name).write_bytes(mutated(data, list(parts.values()), rng) if name == victim else data)
            alone = rng.random() < 0.3
            yield (next(at / name for name in parts if name != 'metadata.yaml') if alone else at), 0
        return
    name = 'damaged.yaml' if kind == 'yaml' else kind
    seeds = corpus.parameter_files() if kind == 'yaml' else corpus.files()[kind]
    path = folder / 'damaged' / name
    path.parent.mkdir()
    if kind == 'depth.png':
        path.with_name('camera.json').write_bytes(corpus.CAMERAS['camera.json'])
    if kind in corpus.CAMERAS:
        path.with_name('depth.png').write_bytes(corpus.depth_images()[0])
    for _ in range(count):
        data = mutated(seeds[int(rng.integers(len(seeds)))], seeds, rng)
        data = corpus.sealed(kind, data) if rng.random() < 0.7 else data
        path.write_bytes(data)
        yield (path.with_name('depth.png') if kind in corpus.CAMERAS else path), len(data)


def run(kind: str, count: int, seed: int, folder: Path, *, stop: bool = True) -> Counter:
    """Try ``count`` damaged inputs of a kind; raise Finding, or count it and keep the input where ``stop`` is false."""
    said = Counter()
    for number, (path, size) in enumerate(inputs(kind, count, seed, folder)):
        try:
            said[check(kind, path, size)] += 1
        except Finding as finding:
            if stop:
                raise
            said['FOUND'] += 1
            kept = folder / f'found_{number}_{path.name}'
            if path.is_file():
                kept.write_bytes(path.read_bytes())
            else:
                import shutil

                shutil.copytree(path, kept)
            print(f'{kind} {number}: {finding}; kept as {kept}', flush=True)
    return said


def main() -> int:
    """Run the kinds that the command line names, each in a process of its own; return the number of findings."""
    parser = argparse.ArgumentParser()
    parser.add_argument('kinds', nargs='*', default=[])
    parser.add_argument('--count', type=int, default=20000)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--here', help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.here:
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        said = run(options.kinds[0], options.count, options.seed, Path(options.here), stop=False)
        print(f'{options.kinds[0]:14} {dict(said)}', flush=True)
        return min(said['FOUND'], 100)
    found = 0
    for kind in options.kinds or [*corpus.files(), *BAGS, 'yaml']:
        folder = tempfile.mkdtemp(prefix='fuzz_')
        arguments = [kind, '--count', str(options.count), '--seed', str(options.seed), '--here', folder]
        start = time.monotonic()
        done = subprocess.run([sys.executable, '-m', 'fuzz.fuzz', *arguments])
        print(f'{kind:14} {time.monotonic() - start:.0f} s', flush=True)
        if done.returncode < 0:
            print(f'{kind:14} DIED of signal {-done.returncode}; its input is in {folder}/damaged', flush=True)
        found += done.returncode != 0
    return found


if __name__ == '__main__':
    sys.exit(main())
