"""What is written appears whole or not at all: full disks, failures, interrupts and kills leave nothing behind."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from csgm_ros.errors import InputError
from csgm_ros.io import atomic, bags
from csgm_ros.io.atomic import replacing, write_text
from csgm_ros.io.files import SUFFIXES, write_cloud
from csgm_ros.types import Cloud

POINTS = np.random.default_rng(1).normal(size=(60000, 3))
# A limit on the size of a file is what a full disk is to a process: a write that stops short.
FULL = """
import resource, signal, sys
import numpy as np
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
from csgm_ros.io.files import write_cloud
import csgm_ros.io.formats.las, csgm_ros.errors
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
for path in sys.argv[1:]:
    try:
        write_cloud(path, np.random.default_rng(0).normal(size=(5000, 3)))
    except csgm_ros.errors.InputError as error:
        print(error)
"""


@pytest.fixture(params=[True, False], ids=['unnamed', 'named'])
def folder(request, tmp_path, monkeypatch):
    """A folder of a file system with and without files that have no name."""
    if not request.param:
        monkeypatch.delattr(os, 'O_TMPFILE')
    return tmp_path


def test_the_old_file_stands_until_the_new_one_is_whole(folder):
    path = folder / 'a.txt'
    write_text(path, 'old')
    os.chmod(path, 0o640)
    with replacing(path) as file:
        file.write(b'new')
        file.flush()
        assert path.read_text() == 'old'
    assert path.read_text() == 'new'
    assert path.stat().st_mode & 0o777 == 0o640
    assert os.listdir(folder) == ['a.txt']


@pytest.mark.parametrize('error', [ValueError, KeyboardInterrupt, OSError(28, 'No space left on device')])
def test_a_failure_leaves_the_old_file_alone(folder, error):
    path = folder / 'a.txt'
    write_text(path, 'old')

    def fail():
        with replacing(path) as file:
            file.write(b'half')
            raise error

    with pytest.raises((ValueError, KeyboardInterrupt)):
        fail()
    assert path.read_text() == 'old'
    assert os.listdir(folder) == ['a.txt']


def test_links_are_followed_and_devices_are_written_to(folder):
    (folder / 'there').mkdir()
    (folder / 'link.txt').symlink_to(folder / 'there' / 'a.txt')
    write_text(folder / 'link.txt', 'text')
    assert (folder / 'there' / 'a.txt').read_text() == 'text'
    assert (folder / 'link.txt').is_symlink()
    (folder / 'full.txt').symlink_to('/dev/full')
    with pytest.raises(InputError, match='No space left'):
        write_text(folder / 'full.txt', 'text' * 10000)
    with pytest.raises(InputError, match='is a folder'):
        write_text(folder / 'there', 'text')


def test_a_full_disk_is_an_error_and_leaves_nothing(tmp_path):
    paths = [tmp_path / f'a{suffix}' for suffix in SUFFIXES]
    said = subprocess.check_output([sys.executable, '-c', FULL, *map(str, paths)], text=True).splitlines()
    assert len(said) == len(paths)
    for line, path in zip(said, paths, strict=True):
        assert line.startswith(f'{path}: cannot be written (File too large)')
    assert os.listdir(tmp_path) == []


def test_a_killed_process_leaves_nothing(tmp_path):
    script = (
        'import sys, time\nfrom csgm_ros.io.atomic import replacing\nwith replacing(sys.argv[1]) as file:\n'
        "    file.write(b'half')\n    file.flush()\n    print('in', flush=True)\n    time.sleep(60)"
    )
    for how in (signal.SIGKILL, signal.SIGINT):
        run = subprocess.Popen(
            [sys.executable, '-c', script, str(tmp_path / 'a')], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        assert run.stdout.readline()
        run.send_signal(how)
        run.wait(20)
        run.stdout.close()
        assert os.listdir(tmp_path) == []


def test_a_reader_never_sees_half_a_file(tmp_path):
    script = (
        'import sys\nimport numpy as np\nfrom csgm_ros.io.files import write_cloud\n'
        'for i in range(30):\n    write_cloud(sys.argv[1], np.full((60000, 3), float(i)))'
    )
    path = tmp_path / 'a.npy'
    write_cloud(path, POINTS)
    run, size = subprocess.Popen([sys.executable, '-c', script, str(path)]), path.stat().st_size
    seen = set()
    while run.poll() is None:
        seen.add(path.stat().st_size)
        time.sleep(0.002)
    assert run.returncode == 0
    assert seen == {size}


def test_a_bag_appears_whole_or_not_at_all(tmp_path, monkeypatch):
    cloud = Cloud(POINTS[:100], None, 'a', 1)
    monkeypatch.setattr(bags, 'message_of', lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        bags.write_clouds(tmp_path / 'bag', [('/source', cloud)])
    assert os.listdir(tmp_path) == []
    monkeypatch.undo()
    bags.write_clouds(tmp_path / 'bag', [('/source', cloud), ('/target', cloud)])
    assert os.listdir(tmp_path) == ['bag']
    assert len(bags.read_clouds(tmp_path / 'bag', '/source', '/target')[0].points) == 100


def test_names_beside_the_file_never_meet():
    path = atomic.Path('/tmp/a')
    assert len({atomic._beside(path) for _ in range(100)}) == 100
