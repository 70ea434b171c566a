"""Start and stop the node again and again, by every signal in turn, and count what is left of it in /dev/shm.

python -m ros_helpers.restarts --count 100      (in test/)
"""

import argparse
import os
import signal
import sys
import time
from pathlib import Path

from csgm_ros.ros.shared_memory import FOLDER
from ros_helpers.process import NodeProcess

SIGNALS = signal.SIGTERM, signal.SIGKILL, signal.SIGINT
YOUNG = 1.1  # seconds: a younger segment may be of a process that just starts, and is left alone


def held(process) -> set[str]:
    """Return the names of the locks of its segments that a process holds."""
    names = set()
    for entry in Path(f'/proc/{process.pid}/fd').iterdir():
        if entry.is_symlink() and 'fastrtps_' in os.readlink(entry) and 'port' not in os.readlink(entry):
            names.add(Path(os.readlink(entry)).name)
    return names


def megabytes(names: set[str]) -> float:
    """Return what is there of segments, by the names of their locks."""
    paths = [FOLDER / name.removesuffix('_el') for name in names]
    return sum(path.stat().st_size for path in paths if path.exists()) / 2**20


def restarts(count: int) -> list[tuple[signal.Signals, int, float, float, float]]:
    """Start and stop the node; return signal, exit code and MB in use, after the stop and after the next start.

    Only what this node has made is counted, whatever else runs beside.
    """
    found, names = [], set()
    for number in range(count + 1):
        process = NodeProcess('-r', '__ns:=/restarts')
        try:
            process.wait_log('transports')
            if found:
                found[-1] = (*found[-1][:4], megabytes(names))
            if number == count:
                break
            names = held(process)
            used, sent = megabytes(names), SIGNALS[number % 3]
            time.sleep(YOUNG)
            process.signal(sent)
            found.append((sent, process.wait(), used, megabytes(names), 0.0))
        finally:
            process.kill()
    return found


def main() -> int:
    """Print a line for each signal; return 1 where something was left."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--count', type=int, default=100)
    found = restarts(parser.parse_args().count)
    for sent in SIGNALS:
        own = [row for row in found if row[0] == sent]
        codes = sorted({code for _, code, *_ in own})
        used, left, later = (max(row[column] for row in own) for column in (2, 3, 4))
        print(f'{sent.name}: {len(own)} times, exit codes {codes}; at most {used:.1f} MB in use, ', end='')
        print(f'{left:.1f} MB after the stop, {later:.1f} MB after the next start')
    return int(any(later for *_, later in found))


if __name__ == '__main__':
    sys.exit(main())
