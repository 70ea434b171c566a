"""Inputs after public reports of other people: each is right, or refused for the reason that it has."""

import json
import shutil

import numpy as np
import pytest

from csgm_ros.cli.main import main
from csgm_ros.errors import ConfigError, InputError
from csgm_ros.io.bags import read_clouds
from csgm_ros.io.config_files import read_config
from csgm_ros.io.files import read_cloud, write_cloud
from csgm_ros.io.results import fused
from csgm_ros.io.transforms import matrix_text
from csgm_ros.types import Similarity

MEAN_COLOR = [0.3978, 0.3693, 0.2412]


@pytest.fixture(scope='module')
def cases(shared):
    return shared / 'cases'


@pytest.mark.parametrize(
    ('name', 'colored'),
    [
        ('ascii_two_points_per_line.ply', False),
        ('double_binary.pcd', False),
        ('uppercase_fields.pcd', False),
        ('cloudcompare_header.xyz', True),
        ('comma.xyz', True),
        ('colours.xyz', True),
        ('ushort_colour.ply', True),
    ],
)
def test_files_of_other_tools_hold_1500_points(cases, name, colored):
    cloud = read_cloud(cases / name)
    assert cloud.points.shape == (1500, 3)
    if not name.startswith('ascii'):
        assert 665171 <= cloud.points[:, 0].min() < cloud.points[:, 0].max() <= 665175
        assert cloud.points[:, 1].min() >= 5648298
    assert (cloud.colors is not None) == colored
    if colored:
        np.testing.assert_allclose(cloud.colors.mean(0), MEAN_COLOR, atol=1e-4)


def test_float_colours_are_those_of_the_shorts(cases, tmp_path):
    cloud = read_cloud(cases / 'ushort_colour.ply')
    rows = np.hstack([cloud.points, cloud.colors]).astype('<f8')
    head = 'ply\nformat binary_little_endian 1.0\nelement vertex 1500\n'
    names = [f'property double {name}\n' for name in ('x', 'y', 'z', 'red', 'green', 'blue')]
    (tmp_path / 'f.ply').write_bytes((head + ''.join(names) + 'end_header\n').encode() + rows.tobytes())
    np.testing.assert_allclose(read_cloud(tmp_path / 'f.ply').colors, cloud.colors)


def test_a_cut_file_ends_early(cases, capsys):
    with pytest.raises(InputError, match=r'ends early \(750 of 1500'):
        read_cloud(cases / 'realsense_cut_half.ply')
    assert main(['register', str(cases / 'realsense_cut_half.ply'), str(cases / 'pair_target.ply')]) == 2
    assert 'ends early' in capsys.readouterr().err


@pytest.mark.parametrize('suffix', ['.xyz', '.ply', '.pcd', '.npz', '.laz'])
def test_geographic_coordinates_survive_to_the_output(cases, tmp_path, suffix):
    source, target = (read_cloud(cases / f'{name}.ply') for name in ('ecef_source', 'utm_target'))
    truth = Similarity(1.7, Similarity.identity().rotation, target.points.mean(0) - 1.7 * source.points.mean(0))
    cloud = fused(source, target, truth)
    write_cloud(tmp_path / f'f{suffix}', cloud.points, cloud.colors, origin=cloud.origin)
    written = read_cloud(tmp_path / f'f{suffix}').points[: len(target.points)]
    assert np.abs(written - target.points).max() <= 1e-6
    printed = np.array([line.split() for line in matrix_text(truth.matrix).splitlines()], float)
    np.testing.assert_array_equal(printed, truth.matrix)


def test_geographic_clouds_register_and_what_is_printed_and_written_is_the_result(cases, tmp_path, capsys):
    files = [str(cases / f'{name}.ply') for name in ('ecef_source', 'utm_target')]
    outputs = ['--json', str(tmp_path / 'r.json'), '--output', str(tmp_path / 'fused.ply')]
    assert main(['register', *files, *outputs]) == 0
    lines = capsys.readouterr().out.splitlines()
    first = next(number for number, line in enumerate(lines) if 'T_target_source' in line) + 1
    printed = np.array([line.split() for line in lines[first : first + 4]], float)
    source, target = map(read_cloud, files)
    written = np.array(json.loads((tmp_path / 'r.json').read_text())['T_target_source'])
    moved = (Similarity.from_matrix(matrix).apply(source.points) for matrix in (printed, written))
    assert np.abs(np.subtract(*moved)).max() < 1e-3
    kept = read_cloud(tmp_path / 'fused.ply').points[: len(target.points)]
    assert np.abs(kept - target.points).max() <= 1e-6


def test_the_run_of_a_bag_that_is_named_is_registered(cases, tmp_path):
    topics = ['--source-topic', '/sfm/points', '--target-topic', '/camera/points']
    result = tmp_path / 'r.json'
    assert main(['register', '--bag', str(cases / 'two_runs' / 'run2.mcap'), *topics, '--json', str(result)]) == 0
    assert json.loads(result.read_text())['scale'] == pytest.approx(1.7, rel=0.01)


def test_the_file_that_is_named_is_read(cases, tmp_path):
    topics = ('/sfm/points', '/camera/points')
    first, second = (np.ptp(read_clouds(cases / 'two_runs' / f'run{i}.mcap', *topics)[0].points) for i in (1, 2))
    assert first == pytest.approx(3 * second, rel=1e-3)
    assert np.ptp(read_clouds(cases / 'two_runs', *topics)[0].points) == first
    shutil.copy(cases / 'two_runs' / 'run2.mcap', tmp_path)
    for bare in (tmp_path / 'run2.mcap', tmp_path):
        assert np.ptp(read_clouds(bare, *topics)[0].points) == second


@pytest.mark.parametrize('command', [['register', '--bag'], ['replay']])
@pytest.mark.parametrize(
    ('name', 'complaint'),
    [('two_runs/none.mcap', 'no such file'), ('ros1.bag', 'ROS 1 bag; convert it: rosbags-convert')],
)
def test_what_is_no_bag_is_told(cases, command, name, complaint, capsys):
    if command == ['replay']:
        pytest.importorskip('rclpy')
    assert main([*command, str(cases / name)]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert complaint in said[-1]


def test_parameter_files_of_whole_robots(cases):
    for name in ('sim', 'nav2', 'wild_and_name'):
        assert read_config(cases / f'{name}.yaml').icp.iterations == 12
    config = read_config(cases / 'int_for_double.yaml')
    assert (config.time_budget, config.verification.min_margin) == (60.0, 2.0)
    with pytest.raises(ConfigError, match=r'icp\.iteration'):
        read_config(cases / 'typo.yaml')
