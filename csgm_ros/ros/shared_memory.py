"""Fast DDS's segments in /dev/shm: those of processes that were killed are removed, and none of ours is left.

Fast DDS removes a segment with its participant. A process that is killed, or ends inside a computation, never gets
there, and nothing else removes what it leaves: 35 MB with the shipped profile. Each segment lies beside an empty
file that its process holds locked for as long as it lives. Ports have fixed names, which the next process of the
same domain takes over; they don't add up and are left alone.
"""

from __future__ import annotations

import fcntl
import os
import time
from pathlib import Path

FOLDER = Path('/dev/shm')
LOCKS = 'fastrtps_' + '[0-9a-f]' * 16 + '_el'
YOUNG = 1.0  # seconds for which a lock may not be taken yet by the process that makes it


def remove_stale(folder: Path = FOLDER) -> int:
    """Remove the segments of this user's processes that live no more; return how many."""
    return sum(map(_removed, folder.glob(LOCKS)))


def _removed(lock: Path) -> bool:
    try:
        found = lock.stat()
        if found.st_uid != os.getuid() or time.time() - found.st_mtime < YOUNG:
            return False
        with lock.open('rb') as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            _unlink(lock)
            return True
    except OSError:  # it is held, or somebody else removes it just now
        return False


def remove_own(folder: Path = FOLDER) -> None:
    """Remove the segments that this process still holds; for its very end, when nothing uses them any more."""
    for entry in Path('/proc/self/fd').iterdir():
        try:
            path = Path(os.readlink(entry))
        except OSError:
            continue
        if path.parent == folder and path.match(LOCKS):
            _unlink(path)


def _unlink(lock: Path) -> None:
    (lock.parent / lock.name.removesuffix('_el')).unlink(missing_ok=True)
    lock.unlink(missing_ok=True)
