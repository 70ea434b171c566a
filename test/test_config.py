"""One configuration: YAML files, command line and dataclasses say the same."""

import dataclasses
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from csgm_ros.config import RENAMED, Config, NodeConfig, configured, flatten, parameter_fields, profile, replaced
from csgm_ros.errors import ConfigError
from csgm_ros.io.config_files import assignment, config_yaml, read_config
from csgm_ros.io.resources import config_file

FILES = {'robust': 'csgm.yaml', 'paper': 'paper.yaml'}
NUMBERS = {name: spec for name, spec in parameter_fields(Config).items() if type(spec.default) in (int, float)}


@pytest.mark.parametrize('name', FILES)
def test_the_shipped_file_is_what_csgm_config_prints(name):
    assert config_file(FILES[name]).read_text() == config_yaml(profile(name)), 'run `make config`'


@pytest.mark.parametrize('name', FILES)
def test_the_shipped_file_reads_back_as_its_profile(name):
    assert read_config(config_file(FILES[name])) == profile(name)


def test_the_shipped_file_holds_every_parameter_of_the_node_too():
    values = yaml.safe_load(config_file('csgm.yaml').read_text())['/**']['ros__parameters']
    nested = {name: value for name, value in values.items() if not isinstance(value, dict)}
    assert set(flatten(NodeConfig())) <= set(nested)


def test_every_parameter_is_described_and_its_default_is_within_its_bounds():
    for part in (Config(), NodeConfig()):
        for name, spec in parameter_fields(type(part)).items():
            assert spec.metadata['description'], name
            assert replaced(part, {name: flatten(part)[name]}) == part


@given(st.data())
def test_any_value_survives_the_file(data):
    import tempfile

    name = data.draw(st.sampled_from(sorted(NUMBERS)))
    low, high = (NUMBERS[name].metadata[key] for key in ('low', 'high'))
    draw = st.integers if type(NUMBERS[name].default) is int else st.floats
    try:
        changed = replaced(profile(), {name: data.draw(draw(low, high))})
    except ConfigError:  # contradicts another value, such as scale_min above scale_max
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'config.yaml'
        path.write_text(config_yaml(changed))
        assert read_config(path) == changed


@pytest.mark.parametrize(
    'text',
    [
        'icp: {iterations: 7}',
        'icp.iterations: 7',
        '/**: {ros__parameters: {icp: {iterations: 7}}}',
        '/csgm: {ros__parameters: {icp.iterations: 7, autostart: true}}',
        '/**: {ros__parameters: {icp: {iterations: 9}}}\ncsgm: {ros__parameters: {icp.iterations: 7}}',
        'csgm: {ros__parameters: {icp.iterations: 9}}\n/**: {ros__parameters: {icp: {iterations: 7}}}',
        'robot: {csgm: {ros__parameters: {icp.iterations: 7}}, other: {ros__parameters: {no: 1}}}',
        '/*: {ros__parameters: {icp.iterations: 7, use_sim_time: true, qos_overrides: {/source: {x: 1}}}}',
    ],
)
def test_nested_dotted_and_ros_forms_mean_the_same(tmp_path, text):
    path = tmp_path / 'c.yaml'
    path.write_text(text)
    assert read_config(path) == replaced(profile(), {'icp.iterations': 7})


def test_a_profile_is_the_same_however_it_is_chosen():
    assert Config() == profile('robust')
    assert Config(profile='paper') == profile('paper') == configured({'profile': 'paper'})
    assert Config(profile='paper').hypotheses.method == 'ransac'
    for late in (lambda: assignment(profile(), 'profile=paper'), lambda: replaced(profile(), {'profile': 'paper'})):
        with pytest.raises(ConfigError, match='--profile'):
            late()


@pytest.mark.parametrize('old', RENAMED)
def test_an_earlier_name_is_answered_with_the_new_one(old, tmp_path):
    assert RENAMED[old] in flatten(Config())
    path = tmp_path / 'c.yaml'
    path.write_text(f'{old}: 1')
    for use in (lambda: read_config(path), lambda: assignment(profile(), f'{old}=1')):
        with pytest.raises(ConfigError, match=f'{old} is called {RENAMED[old]} now'):
            use()


def test_a_file_may_choose_its_profile(tmp_path):
    path = tmp_path / 'c.yaml'
    path.write_text('profile: paper\nicp.iterations: 7')
    assert read_config(path) == replaced(profile('paper'), {'icp.iterations': 7})
    assert read_config(path, 'paper') == read_config(path)
    with pytest.raises(ConfigError, match=r'c\.yaml: is for profile paper'):
        read_config(path, 'robust')


def test_an_empty_file_and_no_file_are_the_profile(tmp_path):
    path = tmp_path / 'c.yaml'
    path.write_text('# nothing\n')
    assert read_config(path) == read_config(None) == profile()
    assert read_config(None, 'paper') == profile('paper')


@pytest.mark.parametrize(
    ('text', 'names'),
    [
        ('icp: {iteration: 7}', 'icp.iteration'),
        ('icp: {iterations: -1}', 'iterations must lie in'),
        ('icp: {iterations: many}', 'iterations must be int'),
        ('icp: 3', "'icp'"),
        ('autostart: 5', 'autostart must be bool'),
        ('profile: best', 'profile must be one of'),
        ('[1, 2]', 'holds no parameters'),
        ('a: [', 'not valid YAML'),
        ('/a: {ros__parameters: {}}\n/b: {ros__parameters: {}}', 'nothing for /csgm, only for /a, /b'),
        ('/a/csgm: {ros__parameters: {}}\n/b/csgm: {ros__parameters: {}}', '/a/csgm and /b/csgm'),
        ('a: &a [1, 1]\nb: &b [*a, *a]\nc: [*b, *b]', 'aliases'),
        ('icp: {iterations: "7"}', "iterations must be int, not '7'"),
        ('time_budget: "1e3"', 'time_budget must be float'),
        ('icp: {iterations: 1_0}', 'iterations must be int'),
        ('icp: {iterations: 2001-01-01}', 'iterations must be int'),
        ('icp: {iterations: {}}', 'iterations'),
        ('? [1, 2]\n: 3', 'not valid YAML'),
        ('[' * 10000, 'not valid YAML'),
        ('icp: {iterations: !!python/name:os.system ""}', 'not valid YAML'),
        ('csgm: {ros__parameters: 5}', 'holds no parameters'),
        ('#' * 2000000, 'larger than'),
    ],
)
def test_wrong_files_are_refused_by_name(tmp_path, text, names):
    path = tmp_path / 'c.yaml'
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        read_config(path)
    assert names in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_missing_or_binary_file_is_refused(tmp_path):
    with pytest.raises(ConfigError, match='cannot be read'):
        read_config(tmp_path / 'none.yaml')
    (tmp_path / 'b.yaml').write_bytes(b'\xff\xfe\x00')
    with pytest.raises(ConfigError):
        read_config(tmp_path / 'b.yaml')


def test_assignments():
    assert assignment(profile(), 'preprocess.smoothing=[10, 20]').preprocess.smoothing == (10, 20)
    assert assignment(profile(), 'scale.scale_min=1e-3').scale.scale_min == 1e-3
    assert assignment(profile(), 'scale.estimate_scale=false').scale.estimate_scale is False
    for wrong in (
        'preprocess.smoothing',
        'nothing=1',
        'icp.iterations=1.5',
        'preprocess.smoothing=[]',
        'preprocess.smoothing=[1',
    ):
        with pytest.raises(ConfigError):
            assignment(profile(), wrong)


def test_configurations_are_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        profile().icp.iterations = 3
