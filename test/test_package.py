"""The package as it is installed: by pip into a folder, and as colcon and rosdep read it."""

import configparser
import os
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
SHIPPED = (
    'package.xml',
    'pyproject.toml',
    'setup.py',
    'setup.cfg',
    'README.md',
    'LICENSE',
    'resource',
    'config',
    'csgm_ros',
)


@pytest.fixture(scope='module')
def wheel(tmp_path_factory):
    """A wheel made from a copy of the tree."""
    folder = tmp_path_factory.mktemp('build')
    for name in SHIPPED:
        path = ROOT / name
        if path.is_dir():
            shutil.copytree(path, folder / 'tree' / name, ignore=shutil.ignore_patterns('__pycache__'))
        elif path.exists():
            (folder / 'tree').mkdir(exist_ok=True)
            shutil.copy(path, folder / 'tree' / name)
    pip = [
        sys.executable,
        '-m',
        'pip',
        'wheel',
        '-q',
        '--no-deps',
        '--no-build-isolation',
        '-w',
        str(folder),
    ]
    subprocess.run([*pip, str(folder / 'tree')], check=True)
    return next(folder.glob('*.whl'))


def package_xml():
    return ElementTree.parse(ROOT / 'package.xml').getroot()


def test_package_xml_says_what_ros_tools_need():
    root = package_xml()
    assert root.get('format') == '3'
    assert root.findtext('name') == 'csgm_ros'
    assert root.findtext('license') == 'Apache-2.0'
    assert root.find('maintainer').get('email').endswith('@example.org')
    assert root.findtext('export/build_type') == 'ament_python'


def test_both_files_tell_the_same_version(wheel):
    assert f'-{package_xml().findtext("version")}-' in wheel.name


def test_executables_go_where_ros2_run_looks():
    config = configparser.ConfigParser()
    config.read(ROOT / 'setup.cfg')
    assert config['install']['install_scripts'] == '$base/lib/csgm_ros'
    assert config['develop']['script_dir'] == '$base/lib/csgm_ros'


def test_the_wheel_holds_everything_that_is_installed(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    shared = {name.split('/data/share/')[1] for name in names if '/data/share/' in name}
    assert 'ament_index/resource_index/packages/csgm_ros' in shared
    assert 'csgm_ros/package.xml' in shared
    for folder in (ROOT / 'config', ROOT / 'csgm_ros' / 'launch'):
        for path in folder.glob('*'):
            if path.is_file():
                assert f'csgm_ros/{folder.name}/{path.name}' in shared
    for path in (ROOT / 'csgm_ros').rglob('*.py'):
        if path.parent.name != 'launch':
            assert str(path.relative_to(ROOT)) in names
    assert not [name for name in names if name.startswith('test')]
    scripts = next(name for name in names if name.endswith('entry_points.txt'))
    text = zipfile.ZipFile(wheel).read(scripts).decode()
    assert 'csgm = csgm_ros.cli.main:main' in text
    assert 'csgm_node = csgm_ros.ros.node:main' in text


def test_an_installed_package_finds_its_configuration(wheel, tmp_path):
    target = tmp_path / 'site'
    pip = [sys.executable, '-m', 'pip', 'install', '-q', '--no-deps', '--target', str(target)]
    subprocess.run([*pip, str(wheel)], check=True)
    script = (
        'import csgm_ros; from csgm_ros.io.resources import config_file\n'
        'print(csgm_ros.__file__); print(config_file("csgm.yaml"))'
    )
    environment = {**os.environ, 'PYTHONPATH': str(target)}
    said = subprocess.check_output([sys.executable, '-c', script], cwd=tmp_path, env=environment, text=True)
    assert [line.startswith(str(target)) for line in said.split()] == [True, True]


def test_every_locked_version_is_exact_and_wanted_names_are_there():
    text = (ROOT / 'requirements.lock').read_text().replace('\\\n', ' ')
    lines = [line for line in text.splitlines() if not line.startswith('#')]
    assert all('==' in line and '--hash=sha256:' in line for line in lines)
    locked = {canonicalize_name(line.split('==')[0]) for line in lines}
    for wanted in map(Requirement, metadata.requires('csgm_ros')):
        extras = [{'extra': extra} for extra in ('', 'ros', 'test', 'dev')]
        if wanted.marker is None or any(wanted.marker.evaluate(extra) for extra in extras):
            assert canonicalize_name(wanted.name) in locked, f'{wanted.name} is not in requirements.lock: make lock'


def test_the_license_is_whole():
    text = (ROOT / 'LICENSE').read_text()
    assert 'Apache License' in text
    assert 'END OF TERMS AND CONDITIONS' in text


def test_the_licence_of_everything_that_is_installed_is_known():
    run = subprocess.run([sys.executable, ROOT / '.ci' / 'licences.py'], capture_output=True, text=True, check=True)
    assert 'numpy' in run.stdout
    assert 'not stated' not in run.stdout
