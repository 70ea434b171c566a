"""The command line as a user types it: results, files, exit codes, and one line on stderr for every mistake."""

import json
import os
import pty
import signal
import subprocess
import sys
import termios

import numpy as np
import pytest

from csgm_ros.cli.main import _parser, _prior, main
from csgm_ros.config import flatten, profile, replaced
from csgm_ros.demo.simulation import recording, simulate
from csgm_ros.io.files import read_cloud, write_cloud
from csgm_ros.io.results import errors
from csgm_ros.types import Similarity

KEYS = {
    *('T_target_source', 'scale', 'accepted', 'reason', 'fitness_source', 'fitness_target', 'inlier_rmse', 'margin'),
    *('seconds', 'timings', 'seed', 'config'),
    *('confidence', 'undetermined', 'inputs'),
}
COMMAND = [sys.executable, '-m', 'csgm_ros.cli.main']


@pytest.fixture(scope='module')
def pair(tmp_path_factory):
    """Files of a simulated pair, and the pair itself."""
    folder, made = tmp_path_factory.mktemp('pair'), simulate(0)
    write_cloud(folder / 'sfm.ply', made.source, made.source_colors)
    write_cloud(folder / 'kinect.npz', made.target.reshape(-1, 3).astype(float))
    return folder / 'sfm.ply', folder / 'kinect.npz', made


@pytest.fixture(scope='module')
def registered(pair, tmp_path_factory):
    """One run of the real command with everything it writes."""
    folder = tmp_path_factory.mktemp('out')
    files = ['--output', str(folder / 'fused.ply'), '--json', str(folder / 'result.json')]
    files += ['--report', str(folder / 'report.html'), '--picture', str(folder / 'picture.png')]
    run = subprocess.run(
        [*COMMAND, 'register', str(pair[0]), str(pair[1]), '--seed', '4', *files], capture_output=True, text=True
    )
    return run, folder


def one_line(capsys):
    captured = capsys.readouterr()
    assert captured.err.count('\n') == 1
    return captured.err


def test_register_accepts_the_pair_near_its_truth(pair, registered):
    run, folder = registered
    assert run.returncode == 0, run.stderr
    assert run.stderr == ''
    assert run.stdout.startswith('accepted: ')
    result = json.loads((folder / 'result.json').read_text())
    found = errors(Similarity.from_matrix(np.array(result['T_target_source'])), pair[2].truth, pair[2].source)
    assert found['rotation_deg'] < 2
    assert found['scale_percent'] < 2
    assert found['mean_displacement'] < 0.05


def test_what_is_expected_is_read_and_what_is_not_is_said(pair, tmp_path, capsys):
    files, initial = list(map(str, pair[:2])), tmp_path / 'initial.json'
    initial.write_text(json.dumps({'T_target_source': pair[2].truth.matrix.tolist()}))
    options = _parser().parse_args(['register', *files, '--initial', str(initial)])
    assert _prior(options).sigma == (0.0, 15.0, 0.1)
    assert np.allclose(_prior(options).transform.matrix, pair[2].truth.matrix)
    assert main(['register', *files, '--initial-sigma', '1', '2', '0.1']) == 2
    assert main(['register', *files, '--initial', str(tmp_path / 'none.json')]) == 2
    assert main(['register', *files, '--initial', str(initial), '--initial-sigma', '1', '2', '-1']) == 2
    said = capsys.readouterr().err.splitlines()
    assert ['--initial' in said[0], 'none.json' in said[1], 'sigma' in said[2]] == [True] * 3


def test_the_json_holds_the_promised_keys(pair, registered):
    result = json.loads((registered[1] / 'result.json').read_text())
    assert set(result) == KEYS
    assert result['accepted'] is True
    assert result['seed'] == 4
    assert result['inputs'] == {'source': str(pair[0]), 'target': str(pair[1])}
    assert np.linalg.det(np.array(result['T_target_source'])[:3, :3]) == pytest.approx(result['scale'] ** 3)
    assert replaced(profile(), result['config']) == profile()
    assert sum(result['timings'].values()) == pytest.approx(result['seconds'])


def test_the_fused_file_holds_the_target_and_the_moved_source(pair, registered):
    matrix = np.array(json.loads((registered[1] / 'result.json').read_text())['T_target_source'])
    source, target = (read_cloud(path).points for path in pair[:2])
    fused = read_cloud(registered[1] / 'fused.ply')
    assert len(fused.points) == len(source) + len(target)
    assert np.allclose(fused.points[-len(source) :], source @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-4)
    assert len(np.unique(fused.colors[: len(target)], axis=0)) == 1  # the target file has no colours: one tint


def test_the_report_and_the_picture_show_the_result(registered):
    run, folder = registered
    page = (folder / 'report.html').read_text()
    assert f'Accepted: {run.stdout.splitlines()[0].removeprefix("accepted: ")}' in page
    assert 'verification.min_margin' in page
    for section in ('three-d', 'slices', 'supervoxels', 'matching', 'run'):
        assert f'<section id="{section}">' in page
    assert (folder / 'picture.png').read_bytes().startswith(b'\x89PNG')


def test_a_rejected_result_exits_with_3_and_writes_no_cloud(pair, tmp_path, capsys):
    impossible = ['--set', 'verification.min_planes=999.0']
    files = ['--output', str(tmp_path / 'f.ply'), '--json', str(tmp_path / 'r.json')]
    assert main(['register', *map(str, pair[:2]), *impossible, *files]) == 3
    captured = capsys.readouterr()
    assert captured.out.startswith('rejected: ')
    assert 'is not written' in captured.err
    assert not (tmp_path / 'f.ply').exists()
    result = json.loads((tmp_path / 'r.json').read_text())
    assert result['accepted'] is False
    assert result['config']['verification.min_planes'] == 999.0


def test_a_bag_gives_what_its_files_give(pair, tmp_path, capsys):
    from csgm_ros.io.bags import write_clouds

    write_clouds(tmp_path / 'bag', recording(pair[2], frames=2), latched=('/source',))
    assert main(['register', '--bag', str(tmp_path / 'bag'), '--json', str(tmp_path / 'r.json')]) == 0
    matrix = np.array(json.loads((tmp_path / 'r.json').read_text())['T_target_source'])
    found = errors(Similarity.from_matrix(matrix), pair[2].truth, pair[2].source)
    assert found['mean_displacement'] < 0.05
    capsys.readouterr()
    assert main(['register', '--bag', str(tmp_path / 'bag'), '--source-topic', '/sfm']) == 2
    assert '/target' in one_line(capsys)


@pytest.mark.parametrize(
    ('arguments', 'names'),
    [
        (['register', 'none.ply', 'none.ply'], 'none.ply'),
        (['register'], 'SOURCE and TARGET'),
        (['register', 'a.ply'], 'SOURCE and TARGET'),
        (['register', 'a.ply', 'b.ply', '--bag', 'c'], '--bag replaces'),
        (['register', '--bag', 'none'], 'none'),
        (['register', 'a.ply', 'b.ply', '--set', 'x'], 'name=value'),
        (['register', 'a.ply', 'b.ply', '--set', 'icp.iterations=-1'], 'icp.iterations'),
        (['register', 'a.ply', 'b.ply', '--config', 'none.yaml'], 'none.yaml'),
        (['register', 'a.ply', 'b.ply', '--output', 'f.stl'], 'f.stl'),
        (['register', 'a.ply', 'b.ply', '--output', 'nowhere/f.ply'], 'nowhere'),
        (['register', 'a.ply', 'b.ply', '--json', 'r.txt'], 'r.txt'),
        (['inspect', 'none.pcd'], 'none.pcd'),
        (['register', 'a.doc', 'b.ply'], '.laz'),
        (['apply', 'none.json', 'a.ply', '-o', 'b.ply'], 'none.json'),
        (['apply', 'none.json', 'a.ply', '-o', 'b.stl'], 'b.stl'),
        (['export-transform', 'none.json', '--format', 'ros'], 'none.json'),
        (['demo', '--source', 'a.ply'], '--target'),
    ],
)
def test_mistakes_exit_with_2_and_one_line_that_names_them(arguments, names, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    assert names in one_line(capsys)


@pytest.mark.parametrize(
    'arguments', [[], ['nothing'], ['register', 'a', 'b', '--seed', '-1'], ['config', '--profile', 'x']]
)
def test_usage_errors_exit_with_2_and_one_line(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    assert '--help' in one_line(capsys)


def test_a_degenerate_cloud_is_refused_by_its_role(pair, tmp_path, capsys):
    np.save(tmp_path / 'flat.npy', np.zeros((100, 3)))
    assert main(['register', str(tmp_path / 'flat.npy'), str(pair[1])]) == 2
    said = one_line(capsys)
    assert 'source' in said
    assert 'flat.npy' in said


def test_config_prints_the_yaml_and_the_file_is_read_back(pair, tmp_path, capsys):
    assert main(['config', '--profile', 'paper']) == 0
    text = capsys.readouterr().out
    (tmp_path / 'c.yaml').write_text(text)
    for name in flatten(profile('paper')):
        assert name.rsplit('.', maxsplit=1)[-1] + ':' in text


def test_simulate_and_inspect(tmp_path, capsys):
    assert main(['simulate', str(tmp_path / 'pair')]) == 0
    files = [str(tmp_path / 'pair' / name) for name in ('sfm.ply', 'kinect.ply')]
    assert main(['inspect', *files, '--picture', str(tmp_path / 'p.png')]) == 0
    said = capsys.readouterr().out
    assert said.count('radius ') == 2
    assert 'target units per source unit' in said
    assert (tmp_path / 'p.png').read_bytes().startswith(b'\x89PNG')


@pytest.mark.parametrize(
    'name',
    ['register', 'view', 'apply', 'export-transform', 'demo', 'inspect', 'config', 'simulate', 'record-demo', 'replay'],
)
def test_every_command_has_help(name):
    pytest.importorskip('rclpy')
    said = subprocess.run([*COMMAND, name, '--help'], capture_output=True, text=True)
    assert said.returncode == 0
    assert 'usage: csgm' in said.stdout


def test_help_loads_nothing_heavy():
    script = (
        'import sys; from csgm_ros.cli.main import main\ntry: main(["--help"])\nexcept SystemExit: pass\n'
        'print([m for m in ("numpy", "scipy", "numba", "open3d", "rclpy") if m in sys.modules])'
    )
    assert subprocess.check_output([sys.executable, '-c', script], text=True).strip().endswith('[]')


def test_progress_shows_on_a_terminal_and_ctrl_c_exits_with_130(pair):
    main_end, terminal = pty.openpty()
    termios.tcsetwinsize(terminal, (24, 80))
    run = subprocess.Popen([*COMMAND, 'register', *map(str, pair[:2])], stdout=subprocess.DEVNULL, stderr=terminal)
    os.close(terminal)
    seen = b''
    while b'%' not in seen:  # the bar is there: the registration runs
        seen += os.read(main_end, 1000)
    run.send_signal(signal.SIGINT)
    try:
        while part := os.read(main_end, 1000):
            seen += part
    except OSError:  # the terminal's other end is closed
        pass
    os.close(main_end)
    assert run.wait() == 130
    assert b'Traceback' not in seen
    assert b'interrupted' in seen


@pytest.fixture
def result_file(tmp_path):
    """A result as `register --json` writes it, of a transform that mixes every component."""
    rotation = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
    transform = Similarity(1.7, rotation, np.array([665171.25, -5648298.125, 1 / 3]))
    (tmp_path / 'r.json').write_text(json.dumps({'T_target_source': transform.matrix.tolist(), 'accepted': True}))
    return tmp_path / 'r.json', transform


def test_apply_moves_points_and_normals_of_a_further_cloud(result_file, tmp_path):
    path, transform = result_file
    points, colors = np.random.default_rng(1).normal(size=(50, 3)), np.full((50, 3), 0.2)
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    write_cloud(tmp_path / 'a.ply', points, colors, normals=normals)
    assert main(['apply', str(path), str(tmp_path / 'a.ply'), '-o', str(tmp_path / 'b.ply')]) == 0
    moved = read_cloud(tmp_path / 'b.ply')
    np.testing.assert_allclose(moved.points, transform.apply(points), atol=1e-9)
    np.testing.assert_allclose(moved.normals, normals @ transform.rotation.T, atol=1e-6)
    np.testing.assert_allclose(moved.colors, colors)


def test_a_rejected_result_is_not_used_unasked(result_file, tmp_path, capsys):
    path, _ = result_file
    path.write_text(path.read_text().replace('true', 'false'))
    write_cloud(tmp_path / 'a.ply', np.zeros((3, 3)))
    for command in (
        ['apply', str(path), str(tmp_path / 'a.ply'), '-o', str(tmp_path / 'b.ply')],
        ['export-transform', str(path), '--format', 'colmap'],
    ):
        assert main(command) == 3
        assert 'rejected' in one_line(capsys)
        assert main([*command, '--rejected']) == 0
        capsys.readouterr()


def test_exports_reproduce_the_transform(result_file, capsys, tmp_path):
    path, transform = result_file

    def exported(kind):
        assert main(['export-transform', str(path), '--format', kind]) == 0
        return capsys.readouterr().out

    scale, w, x, y, z, *translation = map(float, exported('colmap').split())
    made = Similarity(scale, of_quaternion(w, x, y, z), np.array(translation))
    np.testing.assert_allclose(made.matrix, transform.matrix, rtol=1e-14, atol=1e-15)
    rows = np.array([line.split() for line in exported('cloudcompare').splitlines()], float)
    np.testing.assert_allclose(rows, transform.matrix, rtol=1e-14, atol=1e-15)
    words = exported('ros').split('static_transform_publisher')[1].split()
    given = dict(zip(words[::2], words[1::2], strict=True))
    w, x, y, z = (float(given[f'--q{name}']) for name in 'wxyz')
    np.testing.assert_allclose(of_quaternion(w, x, y, z), transform.rotation, atol=1e-15)
    assert [float(given[f'--{name}']) for name in 'xyz'] == transform.translation.tolist()
    text = exported('matlab').split('[')[1].split(']')[0]
    rows = np.array([row.split() for row in text.split(';')], float)
    np.testing.assert_allclose(rows, transform.matrix, rtol=1e-14, atol=1e-15)
    assert main(['export-transform', str(path), '--format', 'colmap', '-o', str(tmp_path / 't.txt')]) == 0
    assert len((tmp_path / 't.txt').read_text().split()) == 8


def of_quaternion(w, x, y, z):
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@pytest.mark.parametrize(
    'text',
    [
        '',
        '{}',
        '[]',
        '{"T_target_source": [[1]]}',
        '[' * 100000,
        '{"T_target_source": [[1,0,0,0],[0,2,0,0],[0,0,3,0],[0,0,0,1]]}',
    ],
)
def test_results_that_are_none_are_refused(text, tmp_path, capsys):
    (tmp_path / 'r.json').write_text(text)
    assert main(['export-transform', str(tmp_path / 'r.json'), '--format', 'ros']) == 2
    assert 'r.json' in one_line(capsys)


def test_a_full_disk_is_bad_input_not_success(pair, tmp_path, capsys, monkeypatch):
    (tmp_path / 'full.ply').symlink_to('/dev/full')
    (tmp_path / 'r.json').write_text(json.dumps({'T_target_source': np.eye(4).tolist()}))
    assert main(['apply', str(tmp_path / 'r.json'), str(pair[0]), '-o', str(tmp_path / 'full.ply')]) == 2
    assert 'No space left' in one_line(capsys)
