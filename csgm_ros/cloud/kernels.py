"""How inner loops are compiled, and the random numbers that they draw."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np

PACKAGE = Path(__file__).parents[1]
MARK = b'@kernel'


def kernel(function: Callable | None = None, *, inline: bool = False, fastmath: bool = False) -> Callable:
    """Compile a function on first use, without Python's lock, and keep the result on disk.

    Parameters
    ----------
    inline : bool, optional
        Copy the code into every caller before it is compiled.
    fastmath : bool, optional
        Let sums be reordered, so that they become vector code; still the same bits on one machine.

    Notes
    -----
    Numba renews what it keeps of a function when the function's own file changes, but not when a kernel changes
    that it calls from another file. Here every kernel is renewed when the source of any of them changes.
    """
    if function is None:
        return functools.partial(kernel, inline=inline, fastmath=fastmath)
    compiled = numba.njit(cache=True, nogil=True, fastmath=fastmath, inline='always' if inline else 'never')(function)
    if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]  # set on import, which the stub does not know
        return compiled
    compiled._cache._cache_file._source_stamp = sources_digest()  # type: ignore[attr-defined]  # numba's own
    return compiled


@functools.cache
def sources_digest() -> str:
    """Return a digest of every file of the package that holds a kernel, and of the compiler's version."""
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sorted(PACKAGE.rglob('*.py')):
        text = path.read_bytes()
        if MARK in text:
            digest.update(str(path.relative_to(PACKAGE)).encode() + b'\0' + text)
    return digest.hexdigest()


@kernel
def random_bits(state):
    """Return the next state and 64 random bits (SplitMix64): the same stream on every machine."""
    state += np.uint64(0x9E3779B97F4A7C15)
    bits = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state, bits ^ (bits >> np.uint64(31))
