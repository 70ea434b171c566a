"""What a node in the field meets: no memory, signals at any time, security settings, parameters nobody knows."""

import subprocess
import sys

import pytest

pytest.importorskip('rclpy')

from ros_helpers.clouds import easy_pair
from ros_helpers.peer import RELIABLE
from ros_helpers.process import NodeProcess
from ros_helpers.scene import received
from ros_helpers.waiting import until

from csgm_ros.ros.client.commands import Client
from csgm_ros.ros.cloud_msgs import cloud_message, header

pytestmark = [pytest.mark.ros, pytest.mark.slow]
SECURE = {'ROS_SECURITY_ENABLE': 'true', 'ROS_SECURITY_STRATEGY': 'Enforce', 'ROS_SECURITY_KEYSTORE': '/nowhere'}


def test_a_message_that_no_memory_is_left_for_is_left_out_and_the_node_lives(ros):
    process = NodeProcess('-r', '__ns:=/short', '-p', 'autostart:=true', module='ros_helpers.node_short_of_memory')
    publisher = ros.publisher('/short/source', RELIABLE)
    message = cloud_message(header('sfm', 0), easy_pair()[0])
    try:
        with Client('/short/csgm') as client:
            until(lambda: client.state() == 'active', 'the node to start itself', 120.0)
            until(publisher.get_subscription_count, 'a subscription')
            publisher.publish(message)
            process.wait_log('out of memory')
            publisher.publish(message)  # the same subscription goes on
            until(lambda: received(client, 'source') >= 1, 'the next message')
            assert not client.register().success
    finally:
        process.close()


@pytest.mark.parametrize('number', ['SIGINT', 'SIGTERM'])
def test_a_signal_while_the_node_is_made_ends_it_with_code_0(number):
    process = NodeProcess(module='ros_helpers.node_ended_early', env={'END_BY': number})
    try:
        assert process.wait(60.0) == 0, process.log
        assert 'Traceback' not in process.log
    finally:
        process.kill()


def csgm(*arguments, env=None):
    return subprocess.run(
        [sys.executable, '-m', 'csgm_ros.cli.main', *arguments], capture_output=True, text=True, timeout=120, env=env
    )


def test_security_settings_that_the_middleware_cannot_meet_are_one_line(monkeypatch, tmp_path):
    for name, value in SECURE.items():
        monkeypatch.setenv(name, value)
    process = NodeProcess()
    try:
        assert process.wait(60.0) == 2, process.log
        (line,) = [line for line in process.log.splitlines() if 'csgm' in line]
        assert 'unset ROS_SECURITY_ENABLE' in line
        assert 'Traceback' not in process.log
    finally:
        process.kill()
    done = csgm('call', 'status')
    assert done.returncode == 2
    assert 'unset ROS_SECURITY_ENABLE' in done.stderr
    assert 'Traceback' not in done.stderr


def test_start_up_parameters_that_nobody_knows_are_said_and_whole_numbers_are_taken(tmp_path):
    file = tmp_path / 'mine.yaml'
    file.write_text("""
/**:
  ros__parameters:
    use_sim_time: false
    verification.min_fitnes: 0.3
    verification.min_planes: 1
    time_budget: 20
    qos_overrides./source.subscription.depth: 3
""")
    process = NodeProcess('-r', '__ns:=/filed', '--params-file', str(file), '-p', 'scale.scale_max:=50')
    try:
        with Client('/filed/csgm') as client:
            found = client.get_parameters(['verification.min_planes', 'time_budget', 'scale.scale_max'])
        assert found == {'verification.min_planes': 1.0, 'time_budget': 20.0, 'scale.scale_max': 50.0}
        assert process.log.count('a start-up parameter is left out') == 1
        assert "'verification.min_fitnes'" in process.log
    finally:
        process.close()
