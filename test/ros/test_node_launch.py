"""The launch files: what they would start, and that it starts; against a stand-in where launch is not installed."""

import sys
from pathlib import Path

import pytest
import yaml
from ros_helpers import launch_standin

ROOT = Path(__file__).parents[2]


@pytest.fixture
def launch(monkeypatch, tmp_path):
    """Return a function that visits a launch file of an installed package."""
    for name, module in launch_standin.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    (tmp_path / 'config').symlink_to(ROOT / 'config')
    (tmp_path / 'launch').symlink_to(ROOT / 'csgm_ros' / 'launch')

    def visit(name, **settings):
        return launch_standin.run(tmp_path / 'launch' / name, tmp_path, **settings)

    return visit


def test_defaults_start_the_node_alone_with_the_shipped_files(launch):
    context = launch('csgm.launch.py')
    (command,) = context.started
    assert command[0] == 'csgm_ros/csgm_node'
    assert '__node:=csgm' in command
    assert {'source:=source', 'target:=target'} <= set(command)
    assert {'autostart:=true', 'use_sim_time:=false', 'trigger:=on_request', 'publish_tf:=false'} <= set(command)
    assert Path(command[command.index('--params-file') + 1]).is_file()
    assert Path(context.environment['FASTRTPS_DEFAULT_PROFILES_FILE']).is_file()
    assert all(context.declared.values())


def test_arguments_reach_node_and_rviz(launch):
    context = launch(
        'csgm.launch.py', source_topic='/map', target_topic='/points', rviz='true', namespace='robot', frame='lidar'
    )
    node, rviz = context.started
    assert {'source:=/map', 'target:=/points', '__ns:=/robot'} <= set(node)
    assert Path(rviz[rviz.index('-d') + 1]).is_file()
    assert rviz[rviz.index('-f') + 1] == 'lidar'
    assert {'/source:=/map', '/csgm/fused:=csgm/fused', '__ns:=/robot'} <= set(rviz)


def test_localization_starts_the_node_in_its_mode(launch):
    context = launch('localization.launch.py', map_file='/m.npz', points_topic='/depth', odom_frame='odom', rviz='true')
    node, rviz = context.started
    assert {'map:=map', 'points:=/depth', 'mode:=tracking', 'map_file:=/m.npz', 'odom_frame:=odom'} <= set(node)
    assert 'tf_broadcast:=true' in node
    assert Path(rviz[rviz.index('-d') + 1]).is_file()
    assert rviz[rviz.index('-f') + 1] == 'map_metric'


def test_replay_uses_the_time_of_the_bag(launch):
    context = launch('replay.launch.py', bag='/data/bag', source_topic='/map', loop='true', rate='2.0')
    node, player = context.started
    assert {'use_sim_time:=true', 'trigger:=on_first_pair', 'source:=/map'} <= set(node)
    assert player[:5] == ['csgm_ros/csgm', 'replay', '/data/bag', '--rate', '2.0']
    assert '--loop' in player
    other = launch('replay.launch.py', bag='/data/bag', player='ros2', trigger='on_every_pair')
    assert other.started[1] == ['ros2', 'bag', 'play', '/data/bag', '--clock', '--rate', '1.0']
    assert 'trigger:=on_every_pair' in other.started[0]


@pytest.mark.parametrize('settings', [{}, {'bag': 'b', 'player': 'vlc'}, {'bag': 'b', 'trigger': 'never'}])
def test_wrong_arguments_are_refused(launch, settings):
    with pytest.raises(AssertionError):
        launch('replay.launch.py', **settings)


@pytest.mark.ros
def test_what_replay_starts_registers_the_bag(launch, tmp_path, ros):
    from geometry_msgs.msg import TransformStamped
    from ros_helpers.clouds import easy_pair
    from ros_helpers.process import Process

    from csgm_ros.io.bags import write_clouds
    from csgm_ros.types import Cloud

    source, target, _ = easy_pair()
    clouds = [('/map', Cloud(source, None, 'sfm', 10**9))]
    clouds += [('/points', Cloud(target, None, 'camera', 10**9 + index * 10**8)) for index in range(5)]
    write_clouds(tmp_path / 'bag', clouds, latched=['/map'])
    context = launch(
        'replay.launch.py', bag=str(tmp_path / 'bag'), source_topic='/map', target_topic='/points', namespace='replayed'
    )
    programs = {'csgm_ros/csgm_node': 'csgm_ros.ros.node', 'csgm_ros/csgm': 'csgm_ros.cli.main'}
    node, player = ([programs[command[0]], *command[1:]] for command in context.started)
    started = [Process('-m', *node, env=context.environment)]
    try:
        started[0].wait_log('active: source /map, target /points', 180.0)
        started.append(Process('-m', *player, env=context.environment))
        found = ros.listen('/replayed/csgm/transform', TransformStamped).wait(1, 60.0)
        assert (found.header.frame_id, found.child_frame_id) == ('camera', 'sfm_scaled')
        started[1].wait_log('played')
        assert started[1].wait() == 0
    finally:
        for process in started:
            process.end()


def test_rviz_shows_every_cloud_with_the_qos_it_is_sent_with():
    shown = yaml.safe_load((ROOT / 'config' / 'csgm.rviz').read_text())['Visualization Manager']['Displays']
    topics = {display['Topic']['Value']: display['Topic'] for display in shown if 'Topic' in display}
    assert set(topics) == {'/source', '/target', '/csgm/fused', '/csgm/aligned', '/csgm/graphs'}
    for name, topic in topics.items():
        ours = name.startswith('/csgm/')
        assert topic['Reliability Policy'] == ('Reliable' if ours else 'Best Effort')
        assert topic['Durability Policy'] == ('Transient Local' if ours else 'Volatile')
