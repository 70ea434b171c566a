"""The configuration as a YAML file that the command line and the ROS node both read."""

from __future__ import annotations

import dataclasses
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import yaml

from csgm_ros.config import Config, NodeConfig, configured, flatten, parameter_fields, profile, replaced
from csgm_ros.errors import ConfigError

WIDTH = 116
MAX_FILE = 1 << 20  # bytes
NODE = 'csgm'
ROS_KEY = 'ros__parameters'
WILDCARDS = {'**': '(/[^/]+)*', '*': '/[^/]+'}
ROS_PARAMETERS = ('use_sim_time', 'qos_overrides', 'start_type_description_service')  # every node's own
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
        A ROS parameter file, of which the parts count whose names fit the node, a later one more: `csgm`, in the
        namespace where the file has it, `/**` and other wildcards; or a mapping of names that may be nested
        (`icp: {iterations: 5}`) or dotted (`icp.iterations: 5`). The node's own parameters are checked and left out,
        and so is what is ROS's (`use_sim_time`, `qos_overrides`). None reads nothing.
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
    return replaced(config, {name.strip(): parsed(value, f'--set {text}')})


def _values(path: str | Path) -> dict[str, Any]:
    """Return ``{'stage.name': value}`` of what a file says to the node `csgm`, without what is ROS's own."""
    try:
        with Path(path).open('rb') as file:
            data = file.read(MAX_FILE + 1)
        text = data.decode('utf-8-sig')
    except (OSError, ValueError):
        raise ConfigError(f'{path}: cannot be read; check the path and its permissions') from None
    if len(data) > MAX_FILE:
        raise ConfigError(f'{path}: is larger than {MAX_FILE} bytes, which no parameter file is')
    values = parsed(text, str(path))
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise ConfigError(f'{path}: holds no parameters; see `csgm config` for the form')
    nodes = list(_nodes(values))
    if not nodes:
        return _known(dict(_dotted(values, '')))
    names = [name for name, _ in nodes]
    ours = _own_name(names, path)
    chosen: dict[str, Any] = {}
    for name, part in nodes:  # as they stand in the file, so that a later one counts more
        if _fits(name, ours):
            if not isinstance(part, dict):
                raise ConfigError(f'{path}: {name} holds no parameters; see `csgm config` for the form')
            chosen |= dict(_dotted(part, ''))
    if not any(_fits(name, ours) for name in names):
        raise ConfigError(f'{path}: holds nothing for {ours}, only for {", ".join(names)[:200]}; name it {NODE} or /**')
    for name, value in chosen.items():
        if isinstance(value, list) and len({type(item) for item in value}) > 1:
            raise ConfigError(
                f'{path}: {name} mixes types, which ROS refuses; write 1.0 for 1 where others have a point'
            )
    return _known(chosen)


def _nodes(values: dict, space: str = '') -> Iterator[tuple[str, Any]]:
    """Yield the name, with namespaces and wildcards, and the `ros__parameters` of each node of a file."""
    for name, part in values.items():
        if isinstance(part, dict):
            whole = f'{space}/{str(name).strip("/")}'
            if ROS_KEY in part:
                yield whole, part[ROS_KEY]
            yield from _nodes({key: value for key, value in part.items() if key != ROS_KEY}, whole)


def _own_name(names: list[str], path: str | Path) -> str:
    """Return the name of our node: the one that the file gives it, without a namespace where there are several."""
    plain = f'/{NODE}'
    named = {name for name in names if name.endswith(plain) and '*' not in name} or {plain}
    if len(named) > 1 and plain not in named:
        raise ConfigError(f'{path}: holds the parameters of {" and ".join(sorted(named))}; keep one of them')
    return plain if plain in named else named.pop()


def _fits(name: str, ours: str) -> bool:
    """Tell whether a name with wildcards means our node: `*` stands for one part, `**` for any number of them."""
    parts = (WILDCARDS.get(part, f'/{re.escape(part)}') for part in name.strip('/').split('/'))
    return re.fullmatch(''.join(parts), ours) is not None


def _known(values: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if name.split('.')[0] not in ROS_PARAMETERS}


def _dotted(values: dict, prefix: str):
    for name, value in values.items():
        if isinstance(value, dict) and value:
            yield from _dotted(value, f'{prefix}{name}.')
        else:
            yield f'{prefix}{name}', value


class _Loader(yaml.SafeLoader):
    """YAML as ROS reads it: numbers such as 1e-3 are numbers, quoted text stays text, aliases are refused."""

    yaml_implicit_resolvers: ClassVar[dict] = {}

    def compose_node(self, parent, index):
        if self.check_event(yaml.AliasEvent):
            event = self.get_event()
            raise yaml.composer.ComposerError(None, None, 'aliases are not read', event.start_mark)
        return super().compose_node(parent, index)


for tag, pattern, first in (
    ('bool', r'(?:[yY]|yes|Yes|YES|true|True|TRUE|on|On|ON|[nN]|no|No|NO|false|False|FALSE|off|Off|OFF)', 'yYnNtTfFoO'),
    ('int', r'[-+]?(?:0[xX][0-9a-fA-F]+|0[0-7]*|[1-9][0-9]*)', '-+0123456789'),
    (
        'float',
        r'[-+]?(?:[0-9]+\.[0-9]*|\.[0-9]+|[0-9]+(?=[eE]))(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)',
        '-+.0123456789',
    ),
    ('null', r'(?:~|null|Null|NULL|)', ['~', 'n', 'N', '']),
):
    _Loader.add_implicit_resolver(f'tag:yaml.org,2002:{tag}', re.compile(f'(?:{pattern})\\Z'), list(first))


def _construct_bool(loader: _Loader, node) -> bool:
    return loader.construct_scalar(node).lower() in ('y', 'yes', 'true', 'on')


_Loader.add_constructor('tag:yaml.org,2002:bool', _construct_bool)


def parsed(text: str, where: str) -> Any:
    """Parse YAML.

    Raises
    ------
    ConfigError
        One line with ``where`` and, where it is known, the line of the text.
    """
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        place = getattr(error, 'problem_mark', None)
        line = f' (line {place.line + 1})' if place else ''
        why = f': {error.problem}' if 'aliases' in str(getattr(error, 'problem', '')) else ''
        raise ConfigError(f'{where}: is not valid YAML{line}{why}') from None
    except (ValueError, TypeError, RecursionError, OverflowError):  # 0x of nothing, keys that are lists, endless depth
        raise ConfigError(f'{where}: is not valid YAML') from None


def _section(config: Any, indent: str) -> list[str]:
    lines = []
    fields = parameter_fields(type(config))
    for spec in dataclasses.fields(config):
        value = getattr(config, spec.name)
        if dataclasses.is_dataclass(value):
            summary = (type(value).__doc__ or '').strip().splitlines()[0]
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
