"""Waiting for something to become true; never for time to pass."""

import time


def until(condition, what, timeout=20.0):
    """Return the first true value of ``condition()``; fail with ``what`` when there is none in time."""
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        if value := condition():
            return value
        time.sleep(0.005)
    raise AssertionError(f'{what}: not within {timeout} s')
