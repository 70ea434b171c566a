"""Who may look into whom; the size of modules and functions; what an import costs."""

import ast
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / 'csgm_ros'
MODULES = sorted(PACKAGE.rglob('*.py'))
NOUNS = {'types', 'config', 'errors', 'schema'}
STAGES = {
    *('preprocess', 'scale', 'supervoxels', 'descriptors', 'graph', 'affinity', 'matching'),
    *('ransac', 'icp', 'hypotheses', 'verification'),
}
ROS = {
    *('rclpy', 'rcl_interfaces', 'builtin_interfaces', 'std_msgs', 'std_srvs', 'sensor_msgs', 'geometry_msgs'),
    *('diagnostic_msgs', 'visualization_msgs', 'lifecycle_msgs', 'rosgraph_msgs', 'tf2_msgs', 'tf2_ros'),
    *('launch', 'launch_ros', 'ament_index_python', 'rosbag2_py', 'sensor_msgs_py'),
}
LONGEST_MODULE = 300


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


@pytest.mark.parametrize('path', [p for p in MODULES if p.parent.name not in ('ros', 'launch')], ids=ids)
def test_only_the_ros_room_imports_ros(path):
    found = {name.split('.')[0] for name in imports(path)} & ROS
    assert not found


def test_nouns_import_numpy_and_the_standard_library_alone():
    for name in NOUNS:
        path = PACKAGE / f'{name}.py'
        assert third_party([path]) <= {'numpy'}
        assert own_imports(path) <= NOUNS


def test_stages_do_not_know_each_other_nor_who_composes_them():
    stages = [PACKAGE / f'{name}.py' for name in STAGES if (PACKAGE / f'{name}.py').exists()]
    assert len(stages) >= 6
    for path in stages:
        assert not own_imports(path) & ((STAGES - {path.stem}) | {'pipeline', 'tools', 'ros'}), path.name


def test_nothing_below_the_pipeline_looks_up():
    for path in PACKAGE.glob('*.py'):
        if path.name not in ('pipeline.py', '__init__.py'):
            assert not own_imports(path) & {'pipeline', 'tools', 'ros'}, path.name


def test_the_edges_call_the_pipeline_and_no_stage():
    for room in ('tools', 'ros'):
        for path in (PACKAGE / room).glob('*.py'):
            assert not own_imports(path) & STAGES, path.name


@pytest.mark.parametrize('path', MODULES, ids=ids)
def test_modules_and_functions_fit(path):
    text = path.read_text()
    assert len(text.splitlines()) <= LONGEST_MODULE
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef):
            documented = ast.get_docstring(node) is not None
            lines = node.end_lineno - (node.body[0].end_lineno if documented else node.lineno)
            assert lines <= 60, f'{path.name}: {node.name} has {lines} lines'


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
import csgm_ros.pipeline, csgm_ros.tools.cli, csgm_ros.tools.demo, csgm_ros.tools.bags
try:
    csgm_ros.tools.cli.ROS_COMMANDS and csgm_ros.tools.cli._ros_command('call', ['status'])
except csgm_ros.tools.cli.InputError as error:
    print(error)
"""
    said = subprocess.check_output([sys.executable, '-c', script], cwd=ROOT, text=True)
    assert 'which is not here' in said


def test_every_import_is_declared():
    tree = ElementTree.parse(ROOT / 'package.xml')
    declared = {element.text for tag in ('depend', 'exec_depend') for element in tree.iter(tag)}
    keys = {'yaml': 'python3-yaml', 'open3d': 'python3-open3d-pip', 'rosbags': 'python3-rosbags-pip'}
    keys |= {name: f'python3-{name}' for name in ('numpy', 'scipy', 'numba', 'matplotlib', 'tqdm')}
    keys |= {'tf2_ros': 'tf2_ros_py', 'PIL': 'python3-pil'}
    launch = list((PACKAGE / 'launch').glob('*.py'))
    missing = {name for name in third_party([*MODULES, *launch]) if keys.get(name, name) not in declared}
    assert not missing
