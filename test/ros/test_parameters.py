"""ROS parameters: the whole configuration, described, checked as a whole, used by the next registration."""

import math

import pytest

pytest.importorskip('rclpy')

import rclpy
from rclpy.parameter import Parameter
from ros_helpers.process import NodeProcess

from csgm_ros.config import Config, NodeConfig, flatten, parameter_fields, profile
from csgm_ros.errors import ConfigError
from csgm_ros.ros.parameters import READ_ONLY, Parameters

pytestmark = pytest.mark.ros


@pytest.fixture
def declared():
    """Return a function that declares the parameters on a fresh node, with start-up overrides."""
    context = rclpy.Context()
    rclpy.init(context=context)
    nodes = []

    def declare(**overrides):
        chosen = [Parameter(name, value=value) for name, value in overrides.items()]
        nodes.append(rclpy.create_node(f'declared_{len(nodes)}', context=context, parameter_overrides=chosen))
        return nodes[-1], Parameters(nodes[-1])

    yield declare
    for node in nodes:
        node.destroy_node()
    context.try_shutdown()


@pytest.mark.parametrize('name', ['robust', 'paper'])
def test_parameters_are_the_configuration(declared, name):
    node, parameters = declared(profile=name)
    assert parameters.config == profile(name)
    assert parameters.node_config == NodeConfig()
    for part in (profile(name), NodeConfig()):
        fields = parameter_fields(type(part))
        for key, value in flatten(part).items():
            assert node.get_parameter(key).value == value or list(node.get_parameter(key).value) == value
            described = node.describe_parameter(key)
            assert fields[key].metadata['description'] in described.description
            assert fields[key].metadata['unit'] in described.description
            assert described.read_only == (key in READ_ONLY)


def test_every_range_is_enforced_by_ros_itself(declared):
    node, parameters = declared()
    before = parameters.config
    for name, spec in {**parameter_fields(Config), **parameter_fields(NodeConfig)}.items():
        for bound, beyond in (('low', -1), ('high', 1)):
            value = spec.metadata[bound]
            current = node.get_parameter(name).value
            if value is None or isinstance(current, (bool, str)):
                continue
            wrong = math.nextafter(2 * value + beyond, math.inf) if isinstance(current, float) else value + beyond
            wrong = value + beyond * max(1.0, abs(value)) if isinstance(current, float) else wrong
            wrong = [value + beyond] if not isinstance(current, (int, float)) else wrong
            result = node.set_parameters_atomically([Parameter(name, value=wrong)])
            assert not result.successful, name
            assert result.reason
    assert parameters.config == before


def test_live_change_is_used(declared):
    node, parameters = declared()
    assert node.set_parameters([Parameter('icp.iterations', value=7)])[0].successful
    assert parameters.config.icp.iterations == 7
    assert node.set_parameters([Parameter('icp.max_correspondence_distances', value=[0.3, 0.1])])[0].successful
    assert parameters.config.icp.max_correspondence_distances == (0.3, 0.1)
    assert node.set_parameters([Parameter('seed', value=4)])[0].successful
    assert parameters.node_config.seed == 4


@pytest.mark.parametrize(
    ('name', 'value', 'complaint'),
    [
        ('profile', 'paper', 'read-only'),
        ('icp.max_correspondence_distances', [], 'non-empty'),
        ('icp.max_correspondence_distances', [0.1, 7.0], 'must lie in'),
        ('icp.iterations', 'many', 'type'),
        ('trigger', 'sometimes', 'one of'),
        ('scale.scale_max', float('nan'), ''),
    ],
)
def test_wrong_value_is_refused_with_a_reason(declared, name, value, complaint):
    node, parameters = declared()
    before = parameters.config, parameters.node_config
    kind = Parameter.Type.DOUBLE_ARRAY if isinstance(value, list) else None
    result = node.set_parameters([Parameter(name, kind, value)])[0]
    assert not result.successful
    assert complaint in result.reason
    assert (parameters.config, parameters.node_config) == before


def test_values_are_checked_as_a_whole(declared):
    node, parameters = declared()
    both = [Parameter('scale.scale_min', value=2.0), Parameter('scale.scale_max', value=3.0)]
    assert node.set_parameters_atomically(both).successful
    assert (parameters.config.scale.scale_min, parameters.config.scale.scale_max) == (2.0, 3.0)
    crossed = node.set_parameters([Parameter('scale.scale_min', value=4.0)])[0]
    assert not crossed.successful
    assert 'below scale_max' in crossed.reason
    with pytest.raises(ConfigError, match='below scale_max'):
        declared(**{'scale.scale_min': 4.0, 'scale.scale_max': 3.0})


def test_whole_number_is_taken_for_a_float(active):
    assert active.set_parameters({'scale.scale_max': 10}).success
    assert active.get_parameters(['scale.scale_max']) == {'scale.scale_max': 10.0}
    refused = active.set_parameters({'scale.scale_max': 10.0, 'icp.iterations': -1})
    assert not refused.success
    assert 'icp.iterations' in refused.message


@pytest.mark.parametrize(
    ('override', 'complaint'),
    [
        ('icp.iterations:=-1', 'icp.iterations'),
        ('icp.iterations:=soon', 'icp.iterations'),
        ('profile:=best', 'profile'),
        ('qos_overrides./source.subscription.reliability:=perfect', 'best_effort'),
    ],
)
def test_unusable_start_is_refused_in_one_line(override, complaint):
    process = NodeProcess('-p', override)
    try:
        assert process.wait(60.0) == 2
        assert 'cannot start' in process.log
        assert complaint in process.log
        assert 'Traceback' not in process.log
    finally:
        process.kill()
