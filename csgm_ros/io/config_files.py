"""The configuration as a YAML file that the command line and the ROS node both read."""

from __future__ import annotations

import dataclasses
import textwrap
from pathlib import Path
from typing import Any

import yaml

from csgm_ros.config import Config, NodeConfig, configured, flatten, parameter_fields, profile, replaced
from csgm_ros.errors import ConfigError

WIDTH = 116
HEADER = """\
Every parameter of csgm_ros, with its default in profile {profile}: made by `csgm config --profile {profile}`.
The node reads it (--ros-args --params-file), and so does the command line (--config); a file may hold only some.\
"""
NODE_HEADER = 'What only the ROS node reads.'


def config_yaml(config: Config, node_config: NodeConfig | None = None) -> str:
    """Return the commented YAML of a configuration, in the form of a ROS parameter file.

    Parameters
    ----------
    config : Config
    node_config : NodeConfig, optional
        The node's own part; its defaults when not given.
    """
    lines = [*_comment(HEADER.format(profile=config.profile), ''), '/**:', '  ros__parameters:']
    lines += _section(config, '    ')
    lines += ['', *_comment(NODE_HEADER, '    '), *_section(node_config or NodeConfig(), '    ')]
    return '\n'.join(lines) + '\n'


def read_config(path: str | Path | None, profile_name: str | None = None) -> Config:
    """Read a YAML file on top of a profile.

    Parameters
    ----------
    path : str, Path or None
        A ROS parameter file, or a mapping of names that may be nested (`icp: {iterations: 5}`) or dotted
        (`icp.iterations: 5`). The node's own parameters are checked and left out. None reads nothing.
    profile_name : str, optional
        Profile below the file's values; else the file's own `profile`, else robust.

    Raises
    ------
    ConfigError
        For a file that cannot be read, an unknown name, or a value of the wrong type or range.
    """
    if path is None:
        return profile(profile_name or 'robust')
    values = _values(path)
    own = values.get('profile')
    if profile_name and own and own != profile_name:
        raise ConfigError(f'{path}: is for profile {own}, but --profile says {profile_name}; drop one of them')
    node_names = flatten(NodeConfig())
    try:
        replaced(NodeConfig(), {name: value for name, value in values.items() if name in node_names})
        return configured({name: value for name, value in values.items() if name not in node_names}, profile_name)
    except ConfigError as error:
        raise ConfigError(f'{path}: {error}') from None


def assignment(config: Config, text: str) -> Config:
    """Apply one ``name=value`` of the command line.

    Raises
    ------
    ConfigError
        For a text without `=`, an unknown name or a value out of its type or range.
    """
    name, equals, value = text.partition('=')
    if not equals:
        raise ConfigError(f'--set {text}: needs the form name=value, such as icp.iterations=10')
    return replaced(config, {name.strip(): _parsed(value, f'--set {text}')})


def _values(path: str | Path) -> dict[str, Any]:
    """Return ``{'stage.name': value}`` of a file."""
    try:
        text = Path(path).read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError):
        raise ConfigError(f'{path}: cannot be read; check the path and its permissions') from None
    values = _parsed(text, str(path))
    if values is None:
        return {}
    if isinstance(values, dict) and any(
        isinstance(part, dict) and 'ros__parameters' in part for part in values.values()
    ):
        if len(values) != 1:
            raise ConfigError(f'{path}: holds the parameters of several nodes; keep one of them')
        values = next(iter(values.values()))['ros__parameters'] or {}
    if not isinstance(values, dict):
        raise ConfigError(f'{path}: holds no parameters; see `csgm config` for the form')
    return dict(_dotted(values, ''))


def _dotted(values: dict, prefix: str):
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _dotted(value, f'{prefix}{name}.')
        else:
            yield f'{prefix}{name}', value


def _parsed(text: str, where: str) -> Any:
    """Parse YAML; numbers such as 1e-3, text to YAML 1.1 without a dot, become numbers."""
    try:
        return _numbers(yaml.safe_load(text))
    except yaml.YAMLError as error:
        place = getattr(error, 'problem_mark', None)
        line = f' (line {place.line + 1})' if place else ''
        raise ConfigError(f'{where}: is not valid YAML{line}') from None


def _numbers(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _numbers(part) for name, part in value.items()}
    if isinstance(value, list):
        return [_numbers(part) for part in value]
    if isinstance(value, str) and value[:1] in '-+.0123456789' and value:
        try:
            return float(value)
        except ValueError:
            return value
    return value


def _section(config: Any, indent: str) -> list[str]:
    lines = []
    fields = parameter_fields(type(config))
    for spec in dataclasses.fields(config):
        value = getattr(config, spec.name)
        if dataclasses.is_dataclass(value):
            summary = type(value).__doc__.strip().splitlines()[0]
            lines += ['', *_comment(summary, indent), f'{indent}{spec.name}:', *_section(value, indent + '  ')]
        else:
            lines += [*_comment(described(fields[spec.name]), indent), f'{indent}{spec.name}: {scalar(value)}']
    return lines


def described(spec: dataclasses.Field) -> str:
    """Return description, unit and bounds of one value in a line."""
    unit, low, high = (spec.metadata[key] for key in ('unit', 'low', 'high'))
    text = spec.metadata['description'] + (f' [{unit}]' if unit else '')
    if low is not None and high is not None:
        return f'{text}; {low:g} to {high:g}'
    if low is not None:
        return f'{text}; at least {low:g}'
    return f'{text}; at most {high:g}' if high is not None else text


def _comment(text: str, indent: str) -> list[str]:
    lines = [wrapped for line in text.splitlines() for wrapped in textwrap.wrap(line, WIDTH - len(indent))]
    return [f'{indent}# {line}' for line in lines]


def scalar(value: Any) -> str:
    """Return one value as YAML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (tuple, list)):
        return f'[{", ".join(scalar(item) for item in value)}]'
    if isinstance(value, float):
        text = repr(value)
        return text if '.' in text or 'e' not in text else text.replace('e', '.0e')
    if isinstance(value, str):
        return value if value.replace('_', '').isalnum() else f"'{value}'"
    return str(value)
