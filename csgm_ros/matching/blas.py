"""One thread for linear algebra on matrices of a few hundred rows.

NumPy's OpenBLAS uses every core from some 80 rows on. For matrices as small as ours that gains nothing; its workers
then spin for tens of milliseconds, which costs more CPU time than the work itself, and the last bits of the result
depend on their number.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import threading
from collections.abc import Callable, Iterator

import numpy as np

NAMES = ('scipy_openblas_{}_num_threads64_', 'scipy_openblas_{}_num_threads', 'openblas_{}_num_threads')

_lock = threading.Lock()
_users = 0
_before = 1


@functools.cache
def _switches() -> tuple[Callable[[], int], Callable[[int], None]] | None:
    """Return OpenBLAS's getter and setter; None when NumPy came with another library, which is left alone."""
    try:
        library = ctypes.CDLL(np.linalg._umath_linalg.__file__)
    except (AttributeError, OSError):
        return None
    for name in NAMES:
        if hasattr(library, name.format('set')) and hasattr(library, name.format('get')):
            return getattr(library, name.format('get')), getattr(library, name.format('set'))
    return None


@contextlib.contextmanager
def single_thread() -> Iterator[None]:
    """Limit NumPy's linear algebra to one thread inside the block; may be entered from several threads at once."""
    global _users, _before
    switches = _switches()
    if switches is None:
        yield
        return
    get_threads, set_threads = switches
    with _lock:
        if _users == 0:
            _before = get_threads()
            set_threads(1)
        _users += 1
    try:
        yield
    finally:
        with _lock:
            _users -= 1
            if _users == 0:
                set_threads(_before)
