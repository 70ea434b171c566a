"""The window on a result: what it draws, on a display where there is one, and what is said where there is none."""

import json
import os
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest

from csgm_ros.cli.main import main
from csgm_ros.io.files import CloudFile, write_cloud
from csgm_ros.types import Similarity
from csgm_ros.visual import window

TRUTH = Similarity(3.0, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([5e5, 5e6, 100.0]))
COLORS = np.tile((0.1, 0.8, 0.1), (3000, 1))


@pytest.fixture(scope='module')
def pair():
    points = np.random.default_rng(0).random((3000, 3)) * (3, 2, 1)
    points[5] = np.nan
    return CloudFile(points, COLORS), CloudFile(TRUTH.apply(points))


@pytest.fixture(scope='module')
def result(pair, tmp_path_factory):
    """A result as `register --json` writes it, beside its clouds."""
    folder = tmp_path_factory.mktemp('view')
    for name, cloud in zip(('source', 'target'), pair, strict=True):
        write_cloud(folder / f'{name}.npz', cloud.points)
    inputs = {name: str(folder / f'{name}.npz') for name in ('source', 'target')}
    text = json.dumps({'T_target_source': TRUTH.matrix.tolist(), 'accepted': True, 'inputs': inputs})
    (folder / 'result.json').write_text(text)
    return folder / 'result.json'


def test_before_is_matched_in_size_and_after_lies_on_the_target(pair):
    shown = window.views(*pair, TRUTH)
    assert len(shown.target.points) == 2999
    np.testing.assert_allclose(shown.sources[1].points, shown.target.points, atol=1e-6)
    before = shown.sources[0].points
    assert np.abs(np.median(before, axis=0)).max() < 1e-9
    assert 0.9 < np.linalg.norm(before, axis=1).mean() / np.linalg.norm(shown.target.points, axis=1).mean() < 1.1


def test_open3d_draws_both_clouds(pair):
    colors = []

    def on_frame(opened):
        if len(colors) < 2:  # what is there after the second frame has settled
            colors.append(None)
            return True
        colors.append(np.asarray(opened.capture_screen_float_buffer(True)).reshape(-1, 3))
        return False

    aside = Similarity(1.0, np.eye(3), np.array([9.0, 0, 0])) @ TRUTH
    window.view(*pair, aside, 'aside', on_frame)
    seen = colors[-1]
    orange, blue = (seen[:, 0] > seen[:, 2] + 0.3).sum(), (seen[:, 2] > seen[:, 0] + 0.3).sum()
    assert min(orange, blue) > 3000


def test_rerun_gets_what_is_before_and_after(pair, tmp_path):
    rerun = pytest.importorskip('rerun')
    recording = rerun.RecordingStream('csgm_ros')
    recording.save(tmp_path / 'a.rrd')
    window.log(recording, window.views(*pair, TRUTH))
    recording.flush()
    data = (tmp_path / 'a.rrd').read_bytes()
    assert data.startswith(b'RRF')
    for name in (b'target', b'source', b'source_in_its_colours', b'step'):
        assert name in data


def test_without_a_display_one_line_says_so(result, monkeypatch, capsys):
    for name in ('DISPLAY', 'WAYLAND_DISPLAY'):
        monkeypatch.delenv(name, raising=False)
    assert main(['view', str(result)]) == 2
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert 'no display' in said
    assert '--report' in said


def test_a_result_that_does_not_know_its_clouds_is_told_them(result, tmp_path, capsys, monkeypatch):
    other = tmp_path / 'other.json'
    other.write_text(json.dumps({'T_target_source': TRUTH.matrix.tolist()}))
    opened = []
    monkeypatch.setattr(window, 'view', lambda *given: opened.append(given))
    assert main(['view', str(other)]) == 2
    assert 'name source and target' in capsys.readouterr().err
    assert main(['view', str(other), 'a.ply']) == 2
    files = [str(result.parent / f'{name}.npz') for name in ('source', 'target')]
    assert main(['view', str(other), *files]) == 0
    assert [len(cloud.points) for cloud in opened[0][:2]] == [3000, 3000]


@pytest.fixture
def display():
    """A display of its own that nobody sees."""
    if not shutil.which('Xvfb'):
        pytest.skip('xvfb is not installed')
    number, told = os.pipe()
    command = ['Xvfb', '-displayfd', str(told), '-screen', '0', '1280x800x24']
    with subprocess.Popen(command, pass_fds=[told], stderr=subprocess.DEVNULL) as server:
        os.close(told)
        yield f':{os.read(number, 20).decode().strip()}'
        os.close(number)
        server.terminate()


def test_the_command_opens_a_window_and_ctrl_c_closes_it(result, display):
    without_rerun = 'import sys; sys.modules["rerun"] = None; from csgm_ros.cli.main import main; sys.exit(main())'
    command = [sys.executable, '-c', without_rerun, 'view', str(result)]
    pipes = {'stdout': subprocess.PIPE, 'stderr': subprocess.PIPE}
    run = subprocess.Popen(command, text=True, env={**os.environ, 'DISPLAY': display}, **pipes)
    assert 'B before and after' in run.stdout.readline()
    with pytest.raises(subprocess.TimeoutExpired):
        run.wait(1)  # it stays open
    run.send_signal(signal.SIGINT)
    _, said = run.communicate(timeout=30)
    assert run.returncode == 130, said
    assert 'interrupted' in said
