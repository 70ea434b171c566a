"""What the C library does with freed memory: glibc keeps it, in a pool for almost every thread, until told not to."""

from __future__ import annotations

import ctypes
import functools

POOLS = 2  # that all threads share; as many as eight a core fill up one after the other
M_ARENA_MAX = -8


def share_pools() -> None:
    """Let threads that are started from now on share their pools."""
    limit = _of_c_library('mallopt')
    if limit is not None:
        limit(M_ARENA_MAX, POOLS)


def give_back() -> None:
    """Return to the system what is free."""
    trim = _of_c_library('malloc_trim')
    if trim is not None:
        trim(0)


@functools.cache
def _of_c_library(name: str):
    return getattr(ctypes.CDLL(None), name, None)  # other libraries than glibc do so by themselves, or cannot
