"""ROS parameters: the whole configuration, described, checked as a whole, used by the next registration."""

import math

import pytest

pytest.importorskip('rclpy')

import rclpy
from rclpy._rclpy_pybind11 import RCLError
from rclpy.parameter import Parameter
from ros_helpers.process import NodeProcess

from csgm_ros.config import Config, NodeConfig, flatten, parameter_fields, profile
from csgm_ros.errors import ConfigError
from csgm_ros.io.config_files import read_config
from csgm_ros.ros.parameters import READ_ONLY, Parameters, unknown

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


WILD = '/**:\n  ros__parameters:\n    '
ICP = 'ros__parameters: {icp.iterations: 6}'
READ = {  # what both read, and the namespace of the node
    **{f'{WILD}{line}\n': '' for line in ('time_budget: 5', 'icp.max_correspondence_distances: [1, 1]', 'seed: 5')},
    **{f'{WILD}icp: {{iterations: {text}}}\n': '' for text in ('0x10', '010', '+5', '-0', '!!int 5', '&a 5')},
    **{f'{WILD}scale: {{scale_max: {text}}}\n': '' for text in ('1e1', '1.5e+1', '5.', '7')},
    **{f'{WILD}scale: {{estimate_scale: {text}}}\n': '' for text in ('no', 'n', 'FALSE', 'off')},
    **{f'{WILD}{text}\n': '' for text in ('profile: paper\n    icp.iterations: 5', 'profile: "paper"')},
    f'{WILD}icp: {{iterations: 5}}\n    icp.iterations: 6\n    use_sim_time: true\n': '',
    f'{WILD}qos_overrides: {{/source: {{subscription: {{depth: 3}}}}}}\n    icp.iterations: 5\n': '',
    f'other:\n  ros__parameters: {{speed: 1}}\n\ncsgm:\n  {ICP}\n': '',
    f'{WILD}icp.iterations: 5\ncsgm:\n  {ICP}\n': '',
    f'csgm:\n  {ICP}\n{WILD}icp.iterations: 5\n': '',
    f'/robot/csgm:\n  {ICP}\n/csgm:\n  ros__parameters: {{icp.iterations: 7}}\n': '',
    f'/*:\n  {ICP}\n/other/**:\n  ros__parameters: {{icp.iterations: 7}}\n': '',
    f'/**/csgm:\n  {ICP}\n/*/*:\n  ros__parameters: {{icp.iterations: 7}}\n': '',
    f'/robot/csgm:\n  ros__parameters: {{seed: 3}}\n/*/csgm:\n  {ICP}\n': 'robot',
    f'robot:\n  csgm:\n    {ICP}\n  "*":\n    ros__parameters: {{time_budget: 9}}\n': 'robot',
    f'{WILD}seed: 1\n/robot/csgm:\n  {ICP}\n/other/csgm/x:\n  ros__parameters: {{time_budget: 9}}\n': 'robot',
}
REFUSED = (  # or said to be left out, by the node
    *(f'{WILD}icp: {{iterations: {text}}}\n' for text in ('"5"', '1_0', '5.0', '~', '[5]', '-3', '!!str 5', 'soon')),
    *(f'{WILD}scale: {{scale_max: {text}}}\n' for text in ('.inf', '.nan', '"2.0"', 'true')),
    *(f'{WILD}icp: {{{text}}}\n' for text in ('iteration: 5', 'max_correspondence_distances: []')),
    *(
        f'{WILD}{text}\n'
        for text in ('icp: [{}]', 'trigger: sometimes', 'initial: 5', 'scale: {scale_min: 5.0, scale_max: 2.0}')
    ),
)
UNREADABLE = (  # no node of the file starts
    *(f'{WILD}{text}\n' for text in ('icp: &a {iterations: 5}\n    x: *a', '\ticp.iterations: 5')),
    *(f'{WILD}{text}\n' for text in ('icp.max_correspondence_distances: [1, 0.5]', 'icp: {iterations: }')),
    '/**:\n  ros__parameters:\n',
)


@pytest.fixture
def both(tmp_path):
    """Return a function that gives a file to the command line and to a node, and returns what each says."""
    context = rclpy.Context()
    rclpy.init(context=context)
    nodes, path = [], tmp_path / 'file.yaml'

    def started(namespace):
        arguments = ['--ros-args', '--params-file', str(path)]
        nodes.append(rclpy.create_node('csgm', context=context, namespace=namespace, cli_args=arguments))
        return Parameters(nodes[-1]).config, unknown(nodes[-1])

    def give(text, namespace=''):
        path.write_text(text)
        answers = []
        for read in (lambda: read_config(path), lambda: started(namespace)):
            try:
                answers.append(read())
            except Exception as error:
                answers.append(error)
        return answers

    yield give
    for node in nodes:
        node.destroy_node()
    context.try_shutdown()


def test_the_command_line_reads_a_file_as_the_node_does(both):
    for text, namespace in READ.items():
        config, node = both(text, namespace)
        assert node == (config, []), text
        assert config != Config() or 'seed' in text, text


def test_the_command_line_refuses_what_the_node_refuses(both):
    for text in REFUSED:
        config, node = both(text)
        assert isinstance(config, ConfigError), text
        assert isinstance(node, Exception) or node[1], text
    for text in UNREADABLE:
        config, node = both(text)
        assert isinstance(config, ConfigError), text
        assert isinstance(node, RCLError), text
