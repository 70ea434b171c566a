"""`csgm call`, for machines without the ros2 command."""

import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

pytest.importorskip('rclpy')

from ros_helpers.process import NodeProcess
from ros_helpers.scene import send_pair, wait_received

from csgm_ros.ros.client import commands as calls

pytestmark = [pytest.mark.ros, pytest.mark.slow]


def csgm(*arguments):
    """Run the command line; return (exit code, stdout, stderr)."""
    done = subprocess.run(
        [sys.executable, '-m', 'csgm_ros.cli.main', *arguments], capture_output=True, text=True, timeout=120
    )
    return done.returncode, done.stdout.strip(), done.stderr.strip()


def test_a_whole_session(node, client, ros):
    assert csgm('call', 'configure') == (0, 'configured', '')
    assert csgm('call', 'activate') == (0, 'active', '')
    code, said, _ = csgm('call', 'configure')
    assert code == 1
    assert 'the node is active' in said
    kept = send_pair(ros)
    wait_received(client)
    code, said, _ = csgm('call', 'register')
    assert code == 0
    assert said.startswith('accepted: scale ')
    code, told, _ = csgm('call', 'status')
    assert code == 0
    assert told.splitlines()[:2] == ['state: active', said]
    assert 'topic: /source' in told
    assert csgm('call', 'cancel') == (1, 'no registration is running', '')
    assert csgm('call', 'deactivate') == (0, 'inactive', '')
    assert csgm('call', 'cleanup') == (0, 'unconfigured', '')
    assert kept


def test_a_node_that_is_not_there_is_told_soon_and_the_client_does_not_list_itself():
    started = time.monotonic()
    code, _, complaint = csgm('call', 'status', '--namespace', 'nobody')
    assert code == 2
    assert 'no node /nobody/csgm in this ROS domain within 6 s' in complaint
    assert 'csgm_client' not in complaint
    assert time.monotonic() - started < 25.0  # 6 s of looking, on a busy machine


def test_the_namespace_is_given_as_to_any_ros_program():
    process = NodeProcess('-r', '__ns:=/robot')
    try:
        process.wait_log('transports')
        assert csgm('call', 'deactivate', '--ros-args', '-r', '__ns:=/robot')[0] == 1
        code, said, _ = csgm('call', 'status', '--namespace', 'robot')
        assert code == 0
        assert 'state: unconfigured' in said
    finally:
        process.close()


def test_absent_node_is_named_with_those_there_are(node):
    code, _, complaint = csgm('call', 'status', '--node', '/elsewhere/csgm', '--timeout', '3')
    assert code == 2
    assert 'no node /elsewhere/csgm' in complaint
    assert '/csgm' in complaint
    assert len(complaint.splitlines()) == 1


def test_functions_do_the_same(node, client):
    assert calls.configure() == calls.Answer(True, 'configured')
    assert calls.activate().success
    assert not calls.register().success
    assert calls.status().state == 'active'
    assert calls.deactivate().success
    assert calls.cleanup().success


def test_no_answer_is_lost_while_others_ask_as_fast_as_they_are_answered(node):
    def ask(_):
        end, answers = time.monotonic() + 8.0, 0
        with calls.Client() as client:
            while time.monotonic() < end:
                answers += bool(client.transitions())  # raises where no answer comes
        return answers

    with ThreadPoolExecutor(6) as threads:
        assert min(threads.map(ask, range(6))) > 1
