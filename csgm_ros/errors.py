"""Errors that csgm_ros raises on purpose: each message names the input and the remedy."""


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
