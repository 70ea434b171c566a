"""What the README says is so: parameters and defaults, topics, commands, files."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from csgm_ros.cli.main import ROS_COMMANDS, main
from csgm_ros.config import Config, NodeConfig, flatten
from csgm_ros.demo.simulation import simulate
from csgm_ros.io.config_files import scalar

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / 'README.md').read_text()
ROWS = [[cell.strip() for cell in line.strip('| ').split(' | ')] for line in TEXT.splitlines() if line.startswith('|')]


def section(title):
    return TEXT.split(f'\n## {title}\n')[1].split('\n## ')[0]


def test_the_direction_is_told_in_one_sentence():
    assert 'x_target = s R x_source + t' in TEXT


def test_the_first_commands_register_and_show_a_pair(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    commands = re.findall(r'^\.venv/bin/csgm (.*?)\s*(?:#.*)?$', section('Two clouds in five minutes'), re.MULTILINE)
    assert [main(shlex.split(command)) for command in commands] == [0, 0]
    assert all((tmp_path / name).stat().st_size > 1e5 for name in ('fused.ply', 'report.html'))


def test_the_example_in_python_registers():
    made = simulate(0)
    code = re.search(r'```python\n(.*?)```', section('From Python'), re.DOTALL)[1]
    names = {'source': made.source, 'target': made.target.reshape(-1, 3)}
    exec(code, names)
    assert names['result'].accepted
    assert names['moved'].shape == made.source.shape


def test_parameters_and_their_defaults_are_those_of_the_configuration():
    defaults = {**flatten(Config()), **flatten(NodeConfig())}
    told = re.findall(r'^\| `([\w.]+)` \| `(.*?)` \|', section('Parameters'), re.MULTILINE)
    assert len(told) > 10
    for name, default in told:
        assert default == scalar(defaults[name]), f'{name}: run `make config`'


def test_topics_are_those_of_the_node():
    pytest.importorskip('rclpy')
    from csgm_ros.ros import outputs, poses

    topics = outputs.TOPICS | {name: kind for name, (kind, _) in poses.TOPICS.items()}
    told = {name.removeprefix('~/') for row in ROWS for name in re.findall(r'`(~/\w+)`', row[0])}
    assert set(topics) | {'register', 'cancel', 'save_report'} == told
    assert '`~/relocalize`' in TEXT
    for row in ROWS:
        name = row[0].strip('`').removeprefix('~/')
        if name in topics:
            assert row[1] == topics[name].__name__


def test_commands_are_those_of_csgm():
    help_text = subprocess.check_output([sys.executable, '-m', 'csgm_ros.cli.main', '--help'], text=True)
    there = set(re.findall(r'^    ([a-z-]+)', help_text, re.MULTILINE))
    told = set(re.findall(r'csgm ([a-z-]+)', TEXT))
    assert told == there
    assert set(ROS_COMMANDS) <= there


def test_targets_are_those_of_make():
    there = set(re.findall(r'^(\w+):', (ROOT / 'Makefile').read_text(), re.MULTILINE))
    assert set(re.findall(r'`make (\w+)`', TEXT)) | set(re.findall(r'^make (\w+)', TEXT, re.MULTILINE)) <= there


def test_files_it_names_are_there():
    for name in re.findall(r'`((?:config|resource|csgm_ros)/[\w./]+)`|\]\(([\w./]+)\)', TEXT):
        assert (ROOT / (name[0] or name[1])).exists()
