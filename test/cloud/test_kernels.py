"""Compiled functions: what is kept on disk is renewed when any kernel's source changes."""

import subprocess
import sys
import textwrap
from pathlib import Path

ROOT = Path(__file__).parents[2]

CALLED = """
from csgm_ros.cloud.kernels import kernel


@kernel
def called(x):
    return x + {added}
"""
CALLING = """
from csgm_ros.cloud.kernels import kernel
from csgm_ros.cloud.called import called


@kernel
def calling(x):
    return 10 * called(x)
"""


def test_a_kernel_is_renewed_when_one_that_it_calls_in_another_file_changes(tmp_path):
    rooms = tmp_path / 'csgm_ros' / 'cloud'
    rooms.mkdir(parents=True)
    for name in ('__init__.py', 'cloud/__init__.py'):
        (tmp_path / 'csgm_ros' / name).write_text('')
    (rooms / 'kernels.py').write_text((ROOT / 'csgm_ros/cloud/kernels.py').read_text())
    (rooms / 'calling.py').write_text(CALLING)
    script = textwrap.dedent("""
        from csgm_ros.cloud.calling import calling
        print(calling(1), sum(calling.stats.cache_hits.values()))
    """)
    # Python's own cache of a file tells its edits apart by the second
    env, said = {'PATH': '', 'PYTHONDONTWRITEBYTECODE': '1'}, []
    for added in (1, 1, 2):
        (rooms / 'called.py').write_text(CALLED.format(added=added))
        run = subprocess.run(
            [sys.executable, '-c', script], cwd=tmp_path, capture_output=True, text=True, check=True, env=env
        )
        said.append(tuple(map(int, run.stdout.split())))
    assert said == [(20, 0), (20, 1), (30, 0)]


def test_every_kernel_of_the_package_is_made_by_the_same_decorator():
    for path in (ROOT / 'csgm_ros').rglob('*.py'):
        if path.name != 'kernels.py':
            assert 'njit' not in path.read_text(), path
