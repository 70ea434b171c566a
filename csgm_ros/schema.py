"""Dataclasses that know the unit, bounds and description of each of their values, and check them."""

from __future__ import annotations

import dataclasses
import math
import typing
from dataclasses import field
from importlib import import_module
from typing import Any

from csgm_ros.errors import ConfigError


def param(default, description, *, unit='', low=None, high=None, choices=None):
    """Declare one value with all that a user or a ParameterDescriptor needs to know of it."""
    metadata = {'description': description, 'unit': unit, 'low': low, 'high': high, 'choices': choices}
    return field(default=default, metadata=metadata)


class Checked:
    """Mixin: a frozen dataclass whose values are checked against their metadata on construction."""

    def __post_init__(self):
        hints = typing.get_type_hints(type(self))
        for spec in dataclasses.fields(self):
            value = getattr(self, spec.name)
            if not dataclasses.is_dataclass(hints[spec.name]):
                object.__setattr__(self, spec.name, checked_value(spec, hints[spec.name], value))


def checked_value(spec: dataclasses.Field, kind: Any, value: Any) -> Any:
    """Return ``value`` as ``kind``, or raise ConfigError saying what is allowed."""
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if typing.get_origin(kind) is tuple:
        if not isinstance(value, (list, tuple)) or not value:
            default: Any = spec.default
            example = ', '.join(map(str, default))
            raise ConfigError(f'{spec.name} must be a non-empty list such as [{example}], not {value!r}')
        return tuple(checked_value(spec, typing.get_args(kind)[0], item) for item in value)
    if type(value) is not kind:
        raise ConfigError(f'{spec.name} must be {kind.__name__}, not {value!r}')
    low, high, choices = (spec.metadata.get(key) for key in ('low', 'high', 'choices'))
    if choices and value not in choices:
        raise ConfigError(f'{spec.name} must be one of {", ".join(choices)}, not {value!r}')
    if kind is float and math.isnan(value):
        raise ConfigError(f'{spec.name} must be a number, not NaN')
    if (low is not None and value < low) or (high is not None and value > high):
        raise ConfigError(f'{spec.name} must lie in [{low}, {high}], not {value!r}')
    return value


def implementation(address: str) -> Any:
    """Import what a table of the configuration names as ``module:attribute``, on first use."""
    module, _, name = address.partition(':')
    return getattr(import_module(module), name)


def part_types(config_type: Any) -> dict[str, Any]:
    """Return ``{'stage': dataclass}`` of the parts of a configuration."""
    hints = typing.get_type_hints(config_type)
    return {name: kind for name, kind in hints.items() if dataclasses.is_dataclass(kind)}


def flatten(config: Any, prefix: str = '') -> dict[str, Any]:
    """Return ``{'stage.name': value}`` of a configuration, in order."""
    flat = {}
    for spec in dataclasses.fields(config):
        value = getattr(config, spec.name)
        if dataclasses.is_dataclass(value):
            flat.update(flatten(value, f'{prefix}{spec.name}.'))
        else:
            flat[prefix + spec.name] = list(value) if isinstance(value, tuple) else value
    return flat


def parameter_fields(config_type: Any, prefix: str = '') -> dict[str, dataclasses.Field]:
    """Return ``{'stage.name': dataclass field}``: the metadata beside :func:`flatten`'s values."""
    hints, found = typing.get_type_hints(config_type), {}
    for spec in dataclasses.fields(config_type):
        if dataclasses.is_dataclass(hints[spec.name]):
            found.update(parameter_fields(hints[spec.name], f'{prefix}{spec.name}.'))
        else:
            found[prefix + spec.name] = spec
    return found


def replaced(config: Any, values: dict[str, Any]) -> Any:
    """Return ``config`` with dotted names replaced, checked as a whole.

    Raises
    ------
    ConfigError
        For a name that does not exist or a value out of its type or bounds; the message names it.
    """
    unknown = [name for name in values if name not in flatten(config)]
    if unknown:
        raise ConfigError(f'no parameter {unknown[0]!r}; `csgm config` lists all of them')
    own: dict[str, Any] = {}
    nested: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        head, _, rest = name.partition('.')
        if rest:
            nested.setdefault(head, {})[rest] = value
        else:
            own[head] = value
    for head, part in nested.items():
        try:
            own[head] = replaced(getattr(config, head), part)
        except ConfigError as error:
            raise ConfigError(f'{head}.{error}') from None
    return dataclasses.replace(config, **own)
