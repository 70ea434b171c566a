"""Errors that csgm_ros raises on purpose: each message names the input and the remedy."""

from collections.abc import Iterator
from contextlib import contextmanager


class CsgmError(Exception):
    """Base of every error raised on purpose."""


class InputError(CsgmError, ValueError):
    """A cloud, file, message or option that cannot be used as it is."""


class DegenerateCloudError(InputError):
    """A cloud without the geometry that registration needs (too few points, all in one place or on one line)."""


class ConfigError(CsgmError, ValueError):
    """A configuration value of the wrong name, type or range."""


class Cancelled(CsgmError):
    """The caller asked a running registration to stop."""


@contextmanager
def naming(name: str) -> Iterator[None]:
    """Put the name of an input before every InputError raised inside."""
    try:
        yield
    except InputError as error:
        raise type(error)(f'{name}: {error}') from None
