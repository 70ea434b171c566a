"""Bags: written, read offline, and replayed into the live node with their own timing."""

import signal

import numpy as np
import pytest
from ros_helpers.clouds import easy_pair

import csgm_ros
from csgm_ros.errors import InputError
from csgm_ros.io import bags
from csgm_ros.types import Cloud

SECOND = 10**9
STORAGES = ['mcap', 'sqlite3']


@pytest.fixture(params=STORAGES)
def bag(request, tmp_path):
    """A latched map and five frames of a sensor, 0.1 s apart."""
    source, target, _ = easy_pair()
    clouds = [('/colmap/map', Cloud(source, None, 'sfm', 100 * SECOND))]
    clouds += [
        ('/camera/points', Cloud(target + 0.001 * index, None, 'camera', 100 * SECOND + index * SECOND // 10))
        for index in range(5)
    ]
    path = tmp_path / request.param
    bags.write_clouds(path, clouds, latched=['/colmap/map'], storage=request.param)
    return path


def test_newest_clouds_are_read(bag):
    source, target = bags.read_clouds(bag, '/colmap/map', '/camera/points')
    np.testing.assert_array_equal(source.points, easy_pair()[0].astype('f4').astype(float))
    np.testing.assert_array_equal(target.points, (easy_pair()[1] + 0.004).astype('f4').astype(float))
    assert (source.frame_id, source.stamp) == ('sfm', 100 * SECOND)
    assert (target.frame_id, target.stamp) == ('camera', 100 * SECOND + 4 * SECOND // 10)


def test_windows_are_merged_as_the_node_does(bag):
    _, target = bags.read_clouds(bag, '/colmap/map', '/camera/points', target_window=3, window_voxel=0.0)
    assert len(target.points) == 3 * len(easy_pair()[1])


@pytest.mark.parametrize(
    ('source', 'target', 'complaint'),
    [
        ('/colmap/map', '/nothing', r'no sensor_msgs/msg/PointCloud2 on /nothing; .*/camera/points, /colmap/map'),
        ('/imu', '/camera/points', 'on /imu'),
    ],
)
def test_missing_topic_is_named_with_those_there_are(bag, source, target, complaint):
    with pytest.raises(InputError, match=complaint):
        bags.read_clouds(bag, source, target)


def test_what_is_no_bag_is_named(tmp_path):
    (tmp_path / 'metadata.yaml').write_text('nothing: of use')
    for path in (tmp_path, tmp_path / 'absent', tmp_path / 'metadata.yaml'):
        with pytest.raises(InputError, match='rosbag2'):
            bags.read_clouds(path, '/source', '/target')


def test_existing_folder_is_not_overwritten(tmp_path):
    with pytest.raises(InputError, match='exists already'):
        bags.write_clouds(tmp_path, [('/source', Cloud(np.zeros((1, 3))))])


def test_topic_without_a_usable_cloud_is_named(tmp_path):
    empty = Cloud(np.zeros((0, 3)))
    bags.write_clouds(tmp_path / 'bag', [('/source', empty), ('/target', empty)])
    with pytest.raises(InputError, match='no usable cloud on /source'):
        bags.read_clouds(tmp_path / 'bag', '/source', '/target')


def test_simulated_scene_is_recorded_organised(tmp_path):
    from csgm_ros.demo.simulation import recording, simulate

    pair = simulate(1, height=48, width=64, sfm_points=500)
    bags.write_clouds(tmp_path / 'demo', recording(pair, 4), latched=('/source',))
    source, target = bags.read_clouds(tmp_path / 'demo', '/source', '/target')
    np.testing.assert_allclose(source.points, pair.source, rtol=1e-6)
    seen = pair.target.reshape(-1, 3)[np.isfinite(pair.target.reshape(-1, 3)).all(axis=1)]
    np.testing.assert_array_equal(target.points, seen)
    assert target.dropped == pair.target.shape[0] * pair.target.shape[1] - len(seen)
    np.testing.assert_allclose(source.colors / 255, pair.source_colors, atol=0.5 / 255 + 1e-9)
    with bags.open_bag(tmp_path / 'demo') as reader:
        assert reader.message_count == 5


@pytest.mark.ros
class TestReplay:
    """The player in its own process, the node in another."""

    @pytest.fixture(autouse=True)
    def _ros(self):
        pytest.importorskip('rclpy')

    @pytest.fixture
    def play(self):
        from ros_helpers.process import Process

        started = []

        def start(*arguments):
            started.append(Process('-m', 'csgm_ros.ros.client.player', *map(str, arguments)))
            return started[-1]

        yield start
        for process in started:
            process.kill()

    def test_offline_and_live_give_the_same_result(self, bag, active, ros, play):
        from ros_helpers.scene import wait_received
        from std_msgs.msg import Float64MultiArray

        assert active.set_parameters({'seed': 11}).success
        player = play(bag, '--source-topic', '/colmap/map', '--target-topic', '/camera/points', '--rate', 1)
        player.wait_log('played /source 1, /target 5')
        print(player.log.strip())
        assert player.wait() == 0
        wait_received(active, 1, 5)
        assert active.register().success
        live = np.array(ros.listen('/csgm/similarity', Float64MultiArray).wait().data).reshape(4, 4)
        source, target = bags.read_clouds(bag, '/colmap/map', '/camera/points')
        offline = csgm_ros.register(source.points, target.points, seed=11)
        np.testing.assert_array_equal(live, offline.T_target_source)

    def test_original_timing_and_clock(self, bag, ros, play):
        import time

        from ros_helpers.peer import RELIABLE
        from rosgraph_msgs.msg import Clock
        from sensor_msgs.msg import PointCloud2

        ticks, arrivals = [], []
        ros.node.create_subscription(Clock, '/clock', lambda tick: ticks.append(tick.clock), 100)
        ros.node.create_subscription(
            PointCloud2, '/camera/points', lambda _: arrivals.append(time.monotonic()), RELIABLE
        )
        ros.listen('/colmap/map', PointCloud2)
        player = play(bag, '--rate', 0.5)
        player.wait_log('played')
        gaps = np.diff(arrivals)
        print('gaps between frames recorded 0.1 s apart, at half speed:', gaps.round(3))
        assert len(gaps) == 4
        assert np.sum(gaps) == pytest.approx(0.8, abs=0.4)
        stamps = [tick.sec * SECOND + tick.nanosec for tick in ticks]
        assert len(stamps) > 20
        assert stamps == sorted(stamps)
        assert (stamps[0], stamps[-1]) == (100 * SECOND, 100 * SECOND + 4 * SECOND // 10)

    def test_loop_plays_on_until_a_signal(self, bag, ros, play):
        from ros_helpers.peer import RELIABLE
        from sensor_msgs.msg import PointCloud2

        frames = ros.listen('/camera/points', PointCloud2, RELIABLE)
        player = play(bag, '--loop', '--rate', 4, '--wait', 0)
        frames.wait(8)
        player.signal(signal.SIGINT)
        assert player.wait() == 0
        assert 'Traceback' not in player.log

    @pytest.mark.parametrize(
        ('arguments', 'complaint'),
        [
            (['--source-topic', '/nothing'], 'no sensor_msgs'),
            (['--rate', '0'], 'above 0'),
            (['--rate', '-1'], 'above 0'),
        ],
    )
    def test_wrong_use_is_one_line(self, bag, play, arguments, complaint):
        player = play(bag, *arguments)
        assert player.wait() == 2
        assert complaint in player.log
        assert 'Traceback' not in player.log

    def test_real_kinect_frames_and_sfm_map(self, tmp_path, active, ros, play, shared):
        from ros_helpers.scene import wait_received

        from csgm_ros.io.files import read_cloud

        frames = [np.load(shared / 'data' / 'kinect_frames' / f'{index:02d}.npz') for index in range(10)]
        sfm = read_cloud(shared / 'data' / 'kinect_sfm' / 'kitchen_520_660' / 'sfm.ply')
        clouds = [('/map', Cloud(sfm.points, None, 'sfm', SECOND))]
        clouds += [
            ('/points', Cloud(frame['xyz'], frame['rgb'], 'camera', SECOND + int(index * SECOND / 10)))
            for index, frame in enumerate(frames)
        ]
        bags.write_clouds(tmp_path / 'bag', clouds, latched=['/map'])
        player = play(tmp_path / 'bag', '--source-topic', '/map', '--target-topic', '/points')
        player.wait_log('played')
        wait_received(active, 1, 10)
        status = active.status().values
        assert status['target']['rejected'] == '0'
        answer = active.register()
        offline = csgm_ros.register(*bags.read_pair(tmp_path / 'bag', '/map', '/points'))
        print('one Kinect frame against the SfM map:', answer.message)
        assert answer.success == offline.accepted
        assert status['target']['received'] == '10'
