"""Fixtures of all tests; ROS tests run over real DDS in a domain of their own, node and test in two processes."""

import contextlib
import fcntl
import os
import signal
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings

from csgm_ros.ros.dds import use_large_buffers

# a busy machine is no failure, and a red run must be red again when it is repeated
settings.register_profile('csgm', deadline=None, derandomize=True)
settings.load_profile('csgm')

DOMAIN_LOCK = pytest.StashKey()

DOMAINS = range(2, 20)  # `csgm demo` takes those from 20 on


def pytest_configure(config):
    # A shell that starts the tests in the background ignores SIGINT, which the processes under test would inherit.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    config.stash[DOMAIN_LOCK] = lock = free_domain()
    os.environ['ROS_DOMAIN_ID'] = lock.name.rpartition('_')[2]
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    # As sensor drivers are told to: with the default transports, what is small comes seconds late beside clouds.
    use_large_buffers()


def free_domain():
    """Return the open, locked file of a domain that no other test session on this machine is in."""
    for domain in DOMAINS:
        with contextlib.suppress(OSError):  # locked, or left by another user
            file = (Path(tempfile.gettempdir()) / f'csgm_test_domain_{domain}').open('w')
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return file
    raise pytest.UsageError(f'{len(DOMAINS)} test sessions are running already')


@pytest.fixture(scope='session')
def shared() -> Path:
    """The folder of real data and references; not part of the product."""
    if 'CSGM_SHARED' not in os.environ:
        pytest.skip('CSGM_SHARED does not name the folder of reference data')
    return Path(os.environ['CSGM_SHARED'])


@pytest.fixture
def ros():
    """A peer of the node: publishes, listens and calls from the process of the test."""
    pytest.importorskip('rclpy')
    from ros_helpers.peer import Peer

    peer = Peer()
    yield peer
    peer.close()


@pytest.fixture(scope='session')
def nodes():
    """The node processes of the session: one, and another each time that one has died."""
    started = []
    yield started
    for process in started:
        process.close()


@pytest.fixture
def node(nodes):
    """The session's node process, which each test leaves unconfigured."""
    pytest.importorskip('rclpy')
    from ros_helpers.process import NodeProcess

    if not nodes or nodes[-1].popen.poll() is not None:
        nodes.append(NodeProcess())
    return nodes[-1]


@pytest.fixture
def client(node):
    """A client of that node; back to unconfigured and to its default parameters afterwards."""
    from csgm_ros.ros.client.commands import Client

    with Client() as connection:
        before = connection.all_parameters()
        yield connection
        connection.deactivate()
        connection.cleanup()
        changed = {name: value for name, value in before.items() if connection.all_parameters()[name] != value}
        assert not changed or connection.set_parameters(changed).success
        assert connection.state() == 'unconfigured'


@pytest.fixture
def active(node, client):
    """The same client, with the node active."""
    assert client.configure().success, node.log
    assert client.activate().success
    return client
