"""As much of launch and launch_ros as the launch files use: same names, same keywords, and what would be run.

For machines that have no launch. Anything that the real classes do not take is an error here too.
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).parents[2]


class Context:
    """What has been set so far, and what would be started."""

    def __init__(self, settings):
        self.settings = dict(settings)
        self.environment = {}
        self.declared = {}
        self.started = []

    def text(self, value):
        """Resolve a string, a substitution or a list of them."""
        if isinstance(value, (list, tuple)):
            return ''.join(self.text(part) for part in value)
        return value.perform(self) if hasattr(value, 'perform') else str(value)


class LaunchConfiguration:
    def __init__(self, variable_name, *, default=None):
        self.name, self.default = variable_name, default

    def perform(self, context):
        if self.name in context.settings:
            return context.settings[self.name]
        if self.default is None:
            raise LookupError(f'launch configuration {self.name!r} does not exist')
        return context.text(self.default)


class EnvironmentVariable:
    def __init__(self, name, *, default_value=None):
        self.name, self.default = name, default_value

    def perform(self, context):
        return context.environment.get(self.name) or context.text(self.default)


class PathJoinSubstitution:
    def __init__(self, substitutions):
        self.parts = substitutions

    def perform(self, context):
        return str(Path(*[context.text(part) for part in self.parts]))


class FindPackageShare:
    def __init__(self, package):
        assert package == 'csgm_ros'

    def perform(self, context):
        return str(context.share)


class IfCondition:
    def __init__(self, predicate_expression):
        self.expression = predicate_expression

    def holds(self, context):
        value = context.text(self.expression).lower()
        assert value in ('true', '1', 'false', '0')
        return value in ('true', '1')


class ParameterValue:
    def __init__(self, value, *, value_type=None):
        self.value, self.type = value, value_type

    def perform(self, context):
        return context.text(self.value)


class DeclareLaunchArgument:
    def __init__(self, name, *, default_value=None, description=None, choices=None, condition=None):
        self.name, self.default, self.description, self.choices = name, default_value, description, choices

    def visit(self, context):
        if self.name not in context.settings:
            assert self.default is not None, f'argument {self.name!r} is required'
            context.settings[self.name] = context.text(self.default)
        value = context.settings[self.name]
        assert self.choices is None or value in self.choices, f'{self.name} must be one of {self.choices}'
        context.declared[self.name] = self.description


class SetEnvironmentVariable:
    def __init__(self, name, value, *, condition=None):
        self.name, self.value = name, value

    def visit(self, context):
        context.environment[self.name] = context.text(self.value)


class ExecuteProcess:
    def __init__(self, *, cmd, output='log', condition=None):
        self.command = cmd

    def visit(self, context):
        context.started.append([context.text(part) for part in self.command])


@dataclass(kw_only=True)
class Node:
    package: str
    executable: str
    name: object = None
    namespace: object = None
    parameters: list = field(default_factory=list)
    remappings: list = field(default_factory=list)
    arguments: list = field(default_factory=list)
    output: str = 'log'
    condition: IfCondition = None

    def visit(self, context):
        if self.condition is not None and not self.condition.holds(context):
            return
        command = [f'{self.package}/{self.executable}', *(context.text(part) for part in self.arguments), '--ros-args']
        if self.name is not None:
            command += ['-r', f'__node:={context.text(self.name)}']
        space = context.text(self.namespace or '')
        if space:
            command += ['-r', f'__ns:=/{space.strip("/")}']
        for each in self.parameters:
            if isinstance(each, dict):
                for name, value in each.items():
                    command += ['-p', f'{name}:={context.text(value)}']
            else:
                command += ['--params-file', context.text(each)]
        for origin, goal in self.remappings:
            command += ['-r', f'{context.text(origin)}:={context.text(goal)}']
        context.started.append(command)


@dataclass(kw_only=True)
class LifecycleNode(Node):
    name: object
    namespace: object


class OpaqueFunction:
    def __init__(self, *, function, args=None, kwargs=None, condition=None):
        self.function = function

    def visit(self, context):
        for entity in self.function(context):
            entity.visit(context)


class PythonLaunchDescriptionSource:
    def __init__(self, launch_file_path):
        self.path = launch_file_path


class IncludeLaunchDescription:
    def __init__(self, launch_description_source, *, launch_arguments=None, condition=None):
        self.source, self.arguments = launch_description_source, launch_arguments or ()

    def visit(self, context):
        for name, value in self.arguments:
            context.settings[name] = context.text(value)
        load(context.text(self.source.path)).visit(context)


class LaunchDescription:
    def __init__(self, initial_entities=None, *, deprecated_reason=None):
        self.entities = initial_entities or []

    def visit(self, context):
        for entity in self.entities:
            entity.visit(context)


MODULES = {
    'launch': [LaunchDescription, Context],
    'launch.actions': [
        DeclareLaunchArgument,
        SetEnvironmentVariable,
        ExecuteProcess,
        IncludeLaunchDescription,
        OpaqueFunction,
    ],
    'launch.conditions': [IfCondition],
    'launch.launch_description_sources': [PythonLaunchDescriptionSource],
    'launch.substitutions': [EnvironmentVariable, LaunchConfiguration, PathJoinSubstitution],
    'launch_ros': [],
    'launch_ros.actions': [LifecycleNode, Node],
    'launch_ros.parameter_descriptions': [ParameterValue],
    'launch_ros.substitutions': [FindPackageShare],
}


def modules():
    """Return the stand-ins by module name, for ``sys.modules``."""
    made = {}
    for name, contents in MODULES.items():
        made[name] = ModuleType(name)
        for each in contents:
            setattr(made[name], 'LaunchContext' if each is Context else each.__name__, each)
    return made


def load(path):
    """Run a launch file and return its description."""
    assert all(name in sys.modules for name in MODULES)
    scope = {'__name__': 'launch_file', '__file__': str(path)}
    exec(compile(Path(path).read_text(), str(path), 'exec'), scope)
    return scope['generate_launch_description']()


def run(path, share, **settings):
    """Return the context after a launch file has been visited with these arguments."""
    context = Context(settings)
    context.share = share
    load(path).visit(context)
    return context
