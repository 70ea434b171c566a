"""The node's lifecycle over its services, from another process."""

import pytest

pytest.importorskip('rclpy')

from ros_helpers.clouds import easy_pair
from ros_helpers.process import NodeProcess
from ros_helpers.scene import received, wait_received
from ros_helpers.waiting import until

from csgm_ros.ros.client.commands import Client
from csgm_ros.ros.cloud_msgs import cloud_message, header

pytestmark = [pytest.mark.ros, pytest.mark.slow]


def test_round_trips_leave_nothing_behind(node, client, ros):
    source, target, _ = easy_pair()
    ros.send('/source', cloud_message(header('sfm', 0), source))
    ros.send('/target', cloud_message(header('camera', 0), target))
    sizes = []
    for _ in range(4):
        assert client.configure().success
        assert client.activate().success
        wait_received(client)
        assert client.register().success
        assert client.deactivate().success
        assert client.cleanup().success
        until(lambda: not ros.node.count_publishers('/csgm/transform'), 'the outputs to be gone')
        until(lambda: not ros.node.count_subscribers('/source'), 'the inputs to be gone')
        sizes.append((node.threads(), node.descriptors(), node.resident_mb()))
    print('threads, descriptors, MB after each round trip:', sizes)
    assert sizes[-1][0] <= sizes[1][0]
    assert sizes[-1][1] <= sizes[1][1] + 2
    assert sizes[-1][2] <= sizes[1][2] + 60


def test_illegal_transitions_are_answered(client):
    answer = client.activate()
    assert not answer.success
    assert 'unconfigured' in answer.message
    assert not client.deactivate().success
    assert client.configure().success
    assert not client.configure().success
    assert not client.deactivate().success
    assert client.state() == 'inactive'


def test_requests_without_clouds_or_activation_are_answered_at_once(client):
    assert 'unconfigured' in client.register(timeout=10).message
    assert not client.cancel().success
    assert client.configure().success
    assert 'inactive' in client.register(timeout=10).message
    assert client.activate().success
    answer = client.register(timeout=10)
    assert not answer.success
    assert 'no cloud on /source' in answer.message


def test_inactive_node_hears_nothing(client, ros):
    source, target, _ = easy_pair()
    assert client.configure().success
    ros.send('/source', cloud_message(header('sfm', 0), source))
    ros.send('/target', cloud_message(header('camera', 0), target))
    assert received(client, 'source') == 0
    assert client.activate().success
    wait_received(client)
    assert client.deactivate().success
    assert client.activate().success
    wait_received(client)  # latched clouds come again; the old ones were forgotten
    assert client.status().values['source']['received'] == '1'


def test_autostart_needs_no_manager(ros):
    process = NodeProcess('-p', 'autostart:=true', '-r', '__ns:=/solo')
    try:
        with Client('/solo/csgm') as client:
            until(lambda: client.state() == 'active', 'the node to start itself', 120.0)
            assert client.shutdown().success
            assert client.state() == 'finalized'
            assert not client.configure().success
    finally:
        process.close()


def test_exceptions_are_logged_with_traceback_and_survived():
    process = NodeProcess('-r', '__ns:=/faulty', module='ros_helpers.faulty_node')
    try:
        with Client('/faulty/csgm') as client:
            for failing, then in ((client.configure, 'unconfigured'), (client.activate, 'inactive')):
                assert not failing().success
                assert client.state() == then
                assert failing().success
            answer = client.cancel()
            assert not answer.success
            assert 'log of the node' in answer.message
            assert client.deactivate().success
            assert not client.cleanup().success  # error processing brings it where it was going
            assert client.state() == 'unconfigured'
            assert client.configure().success
        assert process.log.count('RuntimeError: as asked') == 4
        assert process.log.count('Traceback') == 4
    finally:
        process.close()
