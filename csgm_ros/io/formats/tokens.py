"""Numbers between white space: counted before they are read, so that none is lost, glued or made up."""

from __future__ import annotations

import warnings

import numpy as np

from csgm_ros.errors import InputError


class Tokens:
    """The tokens of a text.

    Parameters
    ----------
    text : bytes
        Anything up to a space counts as white space, as control characters have no place in numbers.
    """

    def __init__(self, text: bytes):
        self._text = text
        solid = np.frombuffer(text, np.uint8) > 32
        starts = solid.copy()
        starts[1:] &= ~solid[:-1]
        self.starts = np.flatnonzero(starts)

    def __len__(self) -> int:
        return len(self.starts)

    def word(self, index: int) -> str:
        """Return one token, shortened for a message."""
        return self._slice(index, index + 1)[:40].strip().decode('ascii', 'replace')

    def numbers(self, first: int, last: int) -> np.ndarray:
        """Return the float64 values of tokens ``first`` to ``last - 1``.

        Raises
        ------
        InputError
            When one of them is no number.
        """
        text = self._slice(first, last)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter('error')  # how older numpy says that it met no number
                values = np.fromstring(text, sep=' ') if last > first else np.empty(0)
        except (ValueError, DeprecationWarning):
            values = None
        if values is None or len(values) != last - first:
            raise InputError(f'{self._culprit(text)!r} stands where a number is due; write it again')
        return values

    def _slice(self, first: int, last: int) -> bytes:
        end = self.starts[last] if last < len(self.starts) else len(self._text)
        return self._text[self.starts[first] : end] if first < len(self.starts) else b''

    @staticmethod
    def _culprit(text: bytes) -> str:
        for word in text.split():
            try:
                float(word)
            except ValueError:
                return word[:40].decode('ascii', 'replace')
        return text[:40].decode('ascii', 'replace')
