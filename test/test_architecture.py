"""Who may look into whom, read off the tree; what an import costs."""

import ast
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / 'csgm_ros'
MODULES = sorted(PACKAGE.rglob('*.py'))
NOUNS = {'types', 'config', 'schema', 'errors', 'progress'}
EVERYWHERE = NOUNS | {'cloud'}
# What each room may import beside the nouns, `cloud` and itself.
ROOMS = {
    **dict.fromkeys(('cloud', 'structure', 'graph', 'matching', 'transform', 'verification'), frozenset()),
    'io': set(),
    'visual': {'io'},
    'demo': {'io', 'visual', 'ros'},
    'ros': {'registration', 'io', 'visual', 'tracking'},
    'cli': {'registration', 'scale', 'structure', 'io', 'visual', 'demo', 'tracking', 'batch'},
    'tracking': {'scale', 'transform', 'io'},
    'batch': {'registration', 'io', 'visual'},
    'launch': set(),
}
FILES = {
    **dict.fromkeys(NOUNS, frozenset()),
    'scale': set(),
    'attempts': set(),
    'exchange': set(),
    'registration': {'scale', 'structure', 'graph', 'matching', 'transform', 'verification', 'attempts', 'exchange'},
    '__init__': {'registration'},
}
# Libraries that rosdep does not know, extras of pip, and where alone they are imported.
OPTIONAL = {
    'formats': {'laspy', 'lazrs', 'pye57', 'trimesh'},
    'batch': {'dask', 'distributed', 'pyarrow'},
    'visual': {'rerun'},
}
ROS = {
    *('rclpy', 'rcl_interfaces', 'builtin_interfaces', 'std_msgs', 'std_srvs', 'sensor_msgs', 'geometry_msgs'),
    *('diagnostic_msgs', 'visualization_msgs', 'nav_msgs', 'lifecycle_msgs', 'rosgraph_msgs', 'tf2_msgs', 'tf2_ros'),
    *('launch', 'launch_ros', 'ament_index_python', 'rosbag2_py', 'sensor_msgs_py'),
}


def imports(path, *, top_level=False):
    """Dotted names that a module imports, wherever in it; relative imports are not used in this package."""
    tree = ast.parse(path.read_text())
    for node in tree.body if top_level else ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path} uses a relative import'
            yield from (f'{node.module}.{alias.name}' for alias in node.names)


def own_imports(path):
    """First name below the package of each own import: `types`, `tools`, ..."""
    return {name.split('.')[1] for name in imports(path) if name.startswith('csgm_ros.')}


def third_party(paths):
    names = {name.split('.')[0] for path in paths for name in imports(path)}
    return names - set(sys.stdlib_module_names) - {'csgm_ros'}


def ids(path):
    return str(path.relative_to(PACKAGE))


def room(path):
    """The folder below the package that a module is in; the module's own name at the root."""
    return path.relative_to(PACKAGE).with_suffix('').parts[0]


def test_every_folder_and_every_file_at_the_root_has_its_place():
    folders = {path.name for path in PACKAGE.iterdir() if path.is_dir() and path.name != '__pycache__'}
    assert folders <= set(ROOMS), 'say in ROOMS what the new folder may import'
    assert {path.stem for path in PACKAGE.glob('*.py')} == set(FILES)


@pytest.mark.parametrize('path', MODULES, ids=ids)
def test_a_module_imports_nouns_cloud_its_own_room_and_what_stands_below(path):
    place = room(path)
    allowed = NOUNS if place in NOUNS else EVERYWHERE | {place} | (FILES if path.parent == PACKAGE else ROOMS)[place]
    assert own_imports(path) <= allowed


def test_no_room_may_look_where_it_does_not():
    for place, allowed in ROOMS.items():
        assert allowed <= set().union(*(own_imports(path) for path in MODULES if room(path) == place)), place


@pytest.mark.parametrize('path', [p for p in MODULES if room(p) not in ('ros', 'launch')], ids=ids)
def test_only_the_ros_room_imports_ros(path):
    found = {name.split('.')[0] for name in imports(path)} & ROS
    assert not found


def test_nouns_import_numpy_and_the_standard_library_alone():
    for name in NOUNS:
        assert third_party([PACKAGE / f'{name}.py']) <= {'numpy'}


def test_the_tests_mirror_the_rooms():
    folders = {path.name for path in (ROOT / 'test').iterdir() if path.is_dir() and any(path.glob('test_*.py'))}
    assert folders <= set(ROOMS)


@pytest.mark.parametrize('path', MODULES, ids=ids)
def test_public_functions_are_documented_and_annotated(path):
    tree = ast.parse(path.read_text())
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith('_'):
            assert ast.get_docstring(node), f'{path.name}: {node.name}'
        if isinstance(node, ast.ClassDef) and not node.name.startswith('_'):
            assert ast.get_docstring(node), f'{path.name}: {node.name}'


def test_importing_the_package_loads_nothing_heavy():
    script = 'import sys, csgm_ros; print([m for m in ("numpy", "scipy", "numba", "open3d") if m in sys.modules])'
    assert subprocess.check_output([sys.executable, '-c', script], cwd=ROOT, text=True).strip() == '[]'


def test_the_pipeline_imports_with_ros_absent():
    script = f"""
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] in {ROS!r}:
            raise ModuleNotFoundError(name, name=name)
sys.meta_path.insert(0, Absent())
import csgm_ros.registration, csgm_ros.cli.main, csgm_ros.demo.run, csgm_ros.io.bags
try:
    csgm_ros.cli.main.ROS_COMMANDS and csgm_ros.cli.main._ros_command('call', ['status'])
except csgm_ros.cli.main.InputError as error:
    print(error)
"""
    said = subprocess.check_output([sys.executable, '-c', script], cwd=ROOT, text=True)
    assert 'which is not here' in said


def test_every_import_is_declared():
    tree = ElementTree.parse(ROOT / 'package.xml')
    declared = {element.text for tag in ('depend', 'exec_depend') for element in tree.iter(tag)}
    keys = {'yaml': 'python3-yaml', 'open3d': 'python3-open3d-pip', 'rosbags': 'python3-rosbags-pip'}
    keys |= {name: f'python3-{name}' for name in ('numpy', 'scipy', 'numba', 'threadpoolctl', 'matplotlib', 'tqdm')}
    keys |= {'tf2_ros': 'tf2_ros_py', 'PIL': 'python3-pil'}
    launch = list((PACKAGE / 'launch').glob('*.py'))
    others = [path for path in MODULES if path.parent.name not in OPTIONAL]
    needed = third_party([*others, *launch])
    for folder, names in OPTIONAL.items():
        needed |= third_party([path for path in MODULES if path.parent.name == folder]) - names
    assert not {name for name in needed if keys.get(name, name) not in declared}


def test_no_two_test_files_have_one_name():
    names = sorted(path.name for path in (ROOT / 'test').rglob('test_*.py'))
    assert names == sorted(set(names)), 'pytest imports them all by their bare names'
