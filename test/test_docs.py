"""What docs/ tells a reader to type is typed here, and must print what the page says; what it names must exist."""

import doctest
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import free_domain

from csgm_ros.cli.main import main
from csgm_ros.config import Config, NodeConfig, flatten

DOCS = Path(__file__).parents[1] / 'docs'
PAGES = sorted(DOCS.glob('*.rst'))
OTHERS = {'colmap', 'ros2', 'pip', 'cloudcompare', 'sbatch', 'dask'}  # programs that are not ours: told, not run
BLOCK = re.compile(r'^\.\. code-block:: console\n((?:\n|   .*\n)+)', re.MULTILINE)
LINES = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def commands(page):
    """Each `$ command` of a page with the output that is told below it, in order."""
    for block in BLOCK.findall(page.read_text()):
        text = re.sub(r'^   ', '', block, flags=re.MULTILINE).replace('\\\n', ' ')
        for command, output in re.findall(r'^\$ (.*)\n((?:(?!\$ ).*\n)*)', text, re.MULTILINE):
            yield shlex.split(command, comments=True), output.strip()


def ours(page):
    return [words for words, _ in commands(page) if words[0] not in OTHERS]


@pytest.mark.parametrize('page', [page for page in PAGES if ours(page)], ids=lambda page: page.stem)
def test_every_command_of_a_page_does_what_the_page_says(page, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    domain = free_domain()  # another node may be there in that of the session
    monkeypatch.setenv('ROS_DOMAIN_ID', domain.name.rpartition('_')[2])
    running = []
    try:
        for words, told in commands(page):
            if words[0] in OTHERS:
                continue
            if words[-1] == '&':
                running.append(started(words[:-1]))
                continue
            code = run(words)
            said = capfd.readouterr()
            assert code in (0, 3), said.err
            assert (code == 3) == ('rejected' in told), said.out
            if told:
                checker = doctest.OutputChecker()
                assert checker.check_output(told + '\n', said.out, LINES), f'{shlex.join(words)} prints:\n{said.out}'
    finally:
        for process in running:
            process.send_signal(signal.SIGINT)
            process.wait(30)
        domain.close()


def started(words):
    pytest.importorskip('rclpy')
    assert words[0] == 'csgm_node'
    return subprocess.Popen([sys.executable, '-m', 'csgm_ros.ros.node', *words[1:]], stderr=subprocess.DEVNULL)


def run(words):
    if words[0] == 'csgm':
        return main(words[1:])
    assert words[0] in ('ls', 'cat'), f'{words[0]}: neither ours nor in OTHERS'
    return subprocess.run(words, check=False).returncode


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.stem)
def test_parameters_that_a_page_names_are_there(page):
    known = set(flatten(Config())) | set(flatten(NodeConfig()))
    parts = {name.partition('.')[0] for name in known if '.' in name}
    for name in re.findall(r'``([a-z_]+\.[a-z_]+)(?:[= ].*?)?``', page.read_text()):
        assert name in known or name.partition('.')[0] not in parts


def test_the_symptoms_are_what_the_program_says():
    said = ''.join(path.read_text() for path in (DOCS.parent / 'csgm_ros').rglob('*.py'))
    symptoms = re.findall(r'^``(.+)``$', (DOCS / 'tuning.rst').read_text(), re.MULTILINE)
    assert len(symptoms) > 8
    for symptom in symptoms:
        for part in symptom.split(' ... '):
            assert part in said, symptom
