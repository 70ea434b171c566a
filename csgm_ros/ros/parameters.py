"""The whole configuration as ROS parameters: declared once, checked as a whole, used by the next registration."""

from __future__ import annotations

import sys
from dataclasses import Field
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from csgm_ros import config as configuration
from csgm_ros.config import Config, NodeConfig
from csgm_ros.errors import ConfigError
from csgm_ros.io.transforms import read_result
from csgm_ros.types import Prior

READ_ONLY = ('profile', 'mode', 'autostart', 'diagnostics_period')
INT64 = 2**63 - 1
SCALARS = (bool, int, float, str)


def descriptor(name: str, spec: Field, value: Any) -> ParameterDescriptor:
    """Return type, description, unit and range of one value as ROS tools show them."""
    unit, low, high, choices = (spec.metadata[key] for key in ('unit', 'low', 'high', 'choices'))
    described = ParameterDescriptor(
        name=name,
        type=Parameter.Type.from_parameter_value(value).value,
        description=spec.metadata['description'] + (f' [{unit}]' if unit else ''),
        read_only=name in READ_ONLY,
    )
    if choices:
        described.additional_constraints = 'one of: ' + ', '.join(choices)
    if low is None and high is None:
        return described
    if isinstance(value, list):
        described.additional_constraints = f'not empty, each within [{low}, {high}]'
    elif isinstance(value, int):
        described.integer_range = [
            IntegerRange(from_value=-INT64 if low is None else low, to_value=INT64 if high is None else high)
        ]
    else:
        lower, upper = (
            bound if bound is not None else sign * sys.float_info.max for bound, sign in ((low, -1), (high, 1))
        )
        described.floating_point_range = [FloatingPointRange(from_value=float(lower), to_value=float(upper))]
    return described


class Parameters:
    """Declares every parameter on ``node`` and keeps the two configurations made of them.

    It owns both, and replaces them at once.

    Attributes
    ----------
    current : (Config, NodeConfig)
        What the next registration uses, and what the node itself uses.

    Raises
    ------
    rclpy.exceptions.InvalidParameterException
        A start-up value of the wrong type or out of range; ConfigError for values that contradict each other.
    """

    def __init__(self, node: Node):
        self._node = node
        node._parameter_overrides.update(widened(node))
        self._types: dict[str, int] = {}
        self._declare('profile', configuration.parameter_fields(configuration.Config)['profile'], 'robust')
        self.current = configuration.profile(node.get_parameter('profile').value), NodeConfig()
        for part in self.current:
            fields = configuration.parameter_fields(type(part))
            for name, value in configuration.flatten(part).items():
                if name != 'profile':
                    self._declare(name, fields[name], value)
        self.current = self._parts({name: node.get_parameter(name).value for name in self._types})
        for line in unknown(node):
            node.get_logger().warning(line)
        node.add_pre_set_parameters_callback(self._widen)
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._apply)

    @property
    def config(self) -> Config:
        """What the next registration uses."""
        return self.current[0]

    @property
    def node_config(self) -> NodeConfig:
        """What the node itself uses."""
        return self.current[1]

    @property
    def prior(self) -> Prior | None:
        """Where the transform is expected, None where the parameters do not say.

        Raises
        ------
        InputError
            For a file that holds no transform.
        """
        settings = self.node_config
        if not settings.initial:
            return None
        place, angle, scale = settings.initial_sigma
        return Prior(read_result(settings.initial)[0], (place, angle, scale))

    def _declare(self, name: str, spec: Field, value: Any) -> None:
        described = descriptor(name, spec, value)
        self._types[name] = described.type
        self._node.declare_parameter(name, value, described)

    def _parts(self, values: dict[str, Any]) -> tuple[Config, NodeConfig]:
        own = set(configuration.flatten(self.node_config))
        plain = {name: value if isinstance(value, SCALARS) else list(value) for name, value in values.items()}
        return (
            configuration.replaced(self.config, {name: value for name, value in plain.items() if name not in own}),
            configuration.replaced(self.node_config, {name: value for name, value in plain.items() if name in own}),
        )

    def _ours(self, parameters: list[Parameter]) -> dict[str, Any]:
        return {parameter.name: parameter.value for parameter in parameters if parameter.name in self._types}

    def _widen(self, parameters: list[Parameter]) -> list[Parameter]:
        """Let ``ros2 param set`` write 1 where 1.0 is meant."""
        return [as_double(each, self._types.get(each.name, 0)) for each in parameters]

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            self._parts(self._ours(parameters))
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, parameters: list[Parameter]) -> None:
        self.current = self._parts(self._ours(parameters))


def as_double(parameter: Parameter, kind: int) -> Parameter:
    """Return an integer, or integers, as the type that is declared where that is a double, or doubles."""
    if kind == Parameter.Type.DOUBLE.value and parameter.type_ == Parameter.Type.INTEGER:
        return Parameter(parameter.name, Parameter.Type.DOUBLE, float(parameter.value))
    if kind == Parameter.Type.DOUBLE_ARRAY.value and parameter.type_ == Parameter.Type.INTEGER_ARRAY:
        return Parameter(parameter.name, Parameter.Type.DOUBLE_ARRAY, [float(value) for value in parameter.value])
    return parameter


def widened(node: Node) -> dict[str, Parameter]:
    """Return the start-up values (files, command line) with integers as doubles where those are meant."""
    kinds = {
        name: Parameter.Type.from_parameter_value(value).value
        for part in (Config(), NodeConfig())
        for name, value in configuration.flatten(part).items()
    }
    return {name: as_double(each, kinds.get(name, 0)) for name, each in node._parameter_overrides.items()}


def unknown(node: Node) -> list[str]:
    """Return one line for each start-up value that nobody declared, which ROS leaves out without a word."""
    lines = []
    for name in node._parameter_overrides:
        if not node.has_parameter(name) and not name.startswith('qos_overrides.'):
            try:
                configuration.replaced(Config(), {name: None})
            except ConfigError as error:  # says what it is called, where it is an earlier name
                lines.append(f'a start-up parameter is left out: {error}')
    return lines
