"""Native readers in a process of their own: what a damaged file does to them ends that process only."""

from __future__ import annotations

import os
import resource
import signal
import warnings
from collections.abc import Callable
from pathlib import Path


def done_apart(work: Callable[[], None], memory: int, seconds: int = 0) -> bool:
    """Do ``work`` in a forked process, which hands over by shared memory; True when it came to its end.

    Parameters
    ----------
    work : callable
        Imports nothing; what it needs has to be imported before.
    memory : int
        Bytes that it may take beyond what this process has.
    seconds : int, optional
        CPU time that it may take; 0 for any.
    """
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')  # of forking beside threads: the child calls the reader alone
        child = os.fork()
    if child == 0:
        status = 1
        try:
            silence = os.open(os.devnull, os.O_WRONLY)
            for stream in (1, 2):  # what native code prints
                os.dup2(silence, stream)
            _limit(memory, seconds)
            work()
            status = 0
        finally:
            os._exit(status)
    try:
        return os.waitpid(child, 0)[1] == 0
    except BaseException:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        raise


def _limit(memory: int, seconds: int) -> None:
    """Let this process have ``memory`` bytes beyond what it has, and leave no core file."""
    pages = int(Path('/proc/self/statm').read_text().split()[0])
    wanted = {resource.RLIMIT_AS: pages * resource.getpagesize() + memory, resource.RLIMIT_CORE: 0}
    if seconds:
        wanted[resource.RLIMIT_CPU] = seconds
    for kind, most in wanted.items():
        hard = resource.getrlimit(kind)[1]
        resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))
