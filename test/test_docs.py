"""What docs/ tells a reader to type is typed here, and must print what the page says; what it names must exist."""

import doctest
import importlib
import re
import shlex
from pathlib import Path

import pytest

from csgm_ros.cli.main import main
from csgm_ros.config import Config, NodeConfig, flatten

DOCS = Path(__file__).parents[1] / 'docs'
PAGES = sorted(DOCS.glob('*.rst'))
OTHERS = {'colmap', 'ros2', 'pip', 'cloudcompare', 'sbatch', 'dask'}  # programs that are not ours: told, not run
LIVE = [['csgm', 'replay'], ['csgm', 'call'], ['csgm_node', '&']]  # run by test/ros, over a node that is there
BLOCK = re.compile(r'^\.\. code-block:: console\n((?:\n|   .*\n)+)', re.MULTILINE)
EXAMPLES = sorted(path for path in (DOCS.parent / 'csgm_ros').rglob('*.py') if '>>> ' in path.read_text())
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
    for words, told in commands(page):
        if words[0] in OTHERS or words[:2] in LIVE:
            continue
        assert words[0] == 'csgm', f'{words[0]}: neither ours nor in OTHERS'
        code = main(words[1:])
        said = capfd.readouterr()
        assert code == 0, said.err
        if told:
            checker = doctest.OutputChecker()
            assert checker.check_output(told + '\n', said.out, LINES), f'{shlex.join(words)} prints:\n{said.out}'


@pytest.mark.parametrize('path', EXAMPLES, ids=lambda path: path.stem)
def test_examples_of_docstrings_do_what_they_say(path):
    module = importlib.import_module('.'.join(path.relative_to(DOCS.parent).with_suffix('').parts))
    found = doctest.testmod(module, optionflags=LINES)
    assert found.attempted
    assert not found.failed


def test_what_is_told_of_the_live_node_is_there():
    pytest.importorskip('rclpy')
    from csgm_ros.ros.client.commands import COMMANDS

    called = [words[2] for page in PAGES for words, _ in commands(page) if words[:2] == ['csgm', 'call']]
    assert set(called) <= set(COMMANDS)
    assert called


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.stem)
def test_options_that_a_page_names_are_there(page, capsys):
    for command in re.findall(r'``(csgm [^`]+)``', page.read_text()):
        words = command.split()[1:]
        parts = words[: 2 if words[0] == 'batch' and words[1:2] in (['report'], ['align']) else 1]
        with pytest.raises(SystemExit) as ended:
            main([*parts, '--help'])
        assert ended.value.code == 0, command
        there = capsys.readouterr().out
        assert [option for option in words if option.startswith('-') and option not in there] == [], command


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
