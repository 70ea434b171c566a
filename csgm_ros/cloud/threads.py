"""How many threads NumPy's linear algebra uses: one, on matrices of a few hundred rows.

NumPy's BLAS uses every core from some 80 rows on. For matrices as small as ours that gains nothing; its workers then
spin for tens of milliseconds, which costs more CPU time than the work itself, and the last bits of the result depend
on their number.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager


class Limit:
    """A limit of BLAS's threads in the whole process; may be entered from several threads at once, the last restores.

    Owns the count of those inside and what was set before.
    """

    def __init__(self):
        self._lock = threading.Lock()
        self._inside = 0
        self._limits = ExitStack()
        # only the thread that set a limit may lift it, and the last to leave need not be the first that came
        self._owner = ThreadPoolExecutor(1, 'blas-limit')

    @contextmanager
    def __call__(self, threads: int) -> Iterator[None]:
        """Limit the threads inside a ``with``. Where several are inside, the first one's limit holds."""
        with self._lock:
            self._inside += 1
            if self._inside == 1:
                self._owner.submit(self._set, threads).result()
        try:
            yield
        finally:
            with self._lock:
                self._inside -= 1
                if self._inside == 0:
                    self._owner.submit(self._limits.close).result()

    def _set(self, threads: int) -> None:
        from threadpoolctl import ThreadpoolController

        # a new controller each time: a library that is loaded later is not known to an earlier one
        self._limits.enter_context(ThreadpoolController().limit(limits=threads, user_api='blas'))


blas_threads = Limit()
