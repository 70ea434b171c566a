"""What the node hears: every QoS, every layout, and what it says when it hears nothing."""

import time

import numpy as np
import pytest

pytest.importorskip('rclpy')

from ros_helpers.clouds import easy_pair
from ros_helpers.peer import BEST_EFFORT, LATCHED, RELIABLE
from ros_helpers.process import NodeProcess, Process
from ros_helpers.scene import SLOW, received, send_pair, wait_received
from ros_helpers.waiting import until
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import String

from csgm_ros.ros.client.commands import Client
from csgm_ros.ros.cloud_msgs import cloud_message, header

pytestmark = [pytest.mark.ros, pytest.mark.slow]


@pytest.fixture
def sensors():
    """Start cloud publishers in processes of their own."""
    started = []

    def start(*arguments, env=None):
        started.append(Process('-m', 'ros_helpers.send_clouds', *map(str, arguments), env=env))
        return started[-1]

    yield start
    for process in started:
        process.end()


def cloud(points=None):
    return cloud_message(header('camera', 0), easy_pair()[1] if points is None else points)


def qos_of(client, name):
    return client.status().values[name]['qos']


@pytest.mark.parametrize(
    ('offered', 'expected'),
    [(BEST_EFFORT, 'best_effort/volatile'), (RELIABLE, 'reliable/volatile'), (LATCHED, 'reliable/transient_local')],
    ids=['best effort', 'reliable', 'latched'],
)
def test_every_offer_is_heard_as_well_as_it_can_be(active, ros, offered, expected):
    publisher = ros.publisher('/source', offered)
    until(lambda: qos_of(active, 'source') == expected, expected)
    until(lambda: publisher.get_subscription_count() == 1, 'one subscription')
    sent = 0
    while sent == 0 or (offered is BEST_EFFORT and sent < 20 and not received(active, 'source')):
        publisher.publish(cloud())  # best effort is lost as long as the subscriber does not know the publisher too
        sent += 1
        time.sleep(0.5 * (offered is BEST_EFFORT))
    wait_received(active, 1, 0)
    assert 1 <= received(active, 'source') <= sent


def test_the_only_message_of_one_who_comes_and_sends_at_once_is_heard(active, ros):
    for name in ('source', 'target'):
        until(lambda name=name: 'reliable/volatile' in qos_of(active, name), 'a reliable subscription')
        assert 'best_effort/volatile' in qos_of(active, name)
        publisher = ros.publisher(f'/{name}', RELIABLE)
        until(publisher.get_subscription_count, 'a subscription')
        publisher.publish(cloud())
        wait_received(active, 1, int(name == 'target'))
    assert received(active, 'source') == received(active, 'target') == 1


def test_publishers_of_different_qos_on_one_topic_are_all_heard_once(active, ros):
    publishers = [ros.publisher('/source', qos) for qos in (BEST_EFFORT, RELIABLE)]
    latched = ros.send('/source', cloud(), LATCHED)  # sent before anybody subscribes with its durability
    wait_received(active, 1, 0)
    until(lambda: 'transient_local' in qos_of(active, 'source'), 'a latched subscription')
    for count, publisher in enumerate([*publishers, latched], start=2):
        until(publisher.get_subscription_count, 'a subscription')
        publisher.publish(cloud())
        wait_received(active, count, 0)
    assert received(active, 'source') == 4


def test_qos_can_be_fixed_and_the_mismatch_is_explained(ros):
    process = NodeProcess(
        *('-r', '__ns:=/fixed', '-p', 'input_timeout:=1.0'),
        *('-p', 'qos_overrides./fixed/source.subscription.reliability:=reliable'),
    )
    publisher = ros.publisher('/fixed/source', BEST_EFFORT)
    try:
        with Client('/fixed/csgm') as client:
            assert client.configure().success
            assert client.activate().success
            process.wait_log('QoS of /fixed/source is incompatible')
            assert 'remove the qos_overrides' in client.status().values['source']['message']
            assert not publisher.get_subscription_count()
    finally:
        process.close()


def test_silence_is_explained_with_a_remedy(active, ros):
    assert active.set_parameters({'input_timeout': 0.5}).success
    until(lambda: 'nothing publishes a PointCloud2' in said(active, 'source'), 'no publisher')
    elsewhere = ros.publisher('/camera/depth/points', BEST_EFFORT)
    until(lambda: '-r source:=/camera/depth/points' in said(active, 'source'), 'a remap to be suggested')
    assert 'remap it' in active.register().message
    wrong = ros.publisher('/target', RELIABLE, String)
    until(lambda: 'carries std_msgs/msg/String' in said(active, 'target'), 'the wrong type')
    mute = ros.publisher('/source', BEST_EFFORT)
    until(lambda: 'net.core.rmem_max' in said(active, 'source'), 'lost clouds')
    mute.publish(cloud())
    until(lambda: said(active, 'source') == '1 clouds received', 'all well')
    assert wrong
    assert elsewhere


def said(client, name):
    return client.status().values[name]['message']


def test_unusable_messages_are_counted_and_answered(active, ros):
    publisher = ros.publisher('/source')
    until(publisher.get_subscription_count, 'a subscription')
    for count, message in enumerate(unusable(), start=1):
        publisher.publish(message)
        until(lambda count=count: rejected(active) == count, f'{count} messages rejected')
    answer = active.register()
    assert 'last message unusable: ' in answer.message
    send_pair(ros)
    wait_received(active, 1, 1)
    publisher.publish(next(iter(unusable())))  # does not replace the good one
    until(lambda: rejected(active) == count + 1, 'one more rejected')
    assert active.register().success


def rejected(client):
    return int(client.status().values['source']['rejected'])


def unusable():
    """Yield messages that contradict themselves."""
    for change in (
        {'width': 0},
        {'point_step': 0},
        {'point_step': 7},
        {'row_step': 1, 'height': 2},
        {'width': 2**32 - 1, 'height': 2**32 - 1},
        {'fields': []},
        {'fields': [PointField(name=name, offset=0, datatype=99, count=1) for name in 'xyz']},
        {'fields': [PointField(name=name, offset=4 * 10**9, datatype=7, count=1) for name in 'xyz']},
    ):
        message = cloud()
        for name, value in change.items():
            setattr(message, name, value)
        yield message


def test_cloud_that_cannot_be_registered_is_answered(active, ros):
    for points, complaint in (
        (np.full((500, 3), np.nan), 'source: none of the 500 points'),
        (np.zeros((500, 3)), 'failed: '),
        (np.zeros((2, 3)), 'failed: '),
        (np.linspace(0, 1, 500)[:, None] * np.ones(3), 'failed: '),
    ):
        before = [received(active, name) for name in ('source', 'target')]
        kept = send_pair(ros, (points, easy_pair()[1]))
        wait_received(active, *(count + 1 for count in before))
        answer = active.register()
        assert not answer.success
        assert complaint in answer.message
        assert 'internal error' not in answer.message
        assert kept


def test_publisher_that_is_killed_is_noticed_and_replaced(node, active, ros, sensors):
    assert active.set_parameters({'input_timeout': 1.0}).success
    sensor = sensors('/source')
    wait_received(active, 3, 0)
    sensor.kill()
    until(lambda: said(active, 'source').startswith(('/source has 1', 'no publisher')), 'silence')
    before = received(active, 'source')
    sensors('/source')
    wait_received(active, before + 3, 0)
    until(lambda: said(active, 'source').endswith('clouds received'), 'all well')
    assert 'clouds on /source again' in node.log


def test_large_best_effort_clouds_arrive_with_the_shipped_profile(active, sensors):
    """5 MB at 10 Hz for 5 s; the node selects the profile itself, so the sensor may have any transports."""
    figures = {}
    for name, profile in (('default transports', ''), ('shipped profile', 'config/fastdds.xml')):
        before = received(active, 'source')
        env = {'FASTRTPS_DEFAULT_PROFILES_FILE': str(NodeProcess.ROOT / profile)} if profile else {}
        sensor = sensors('/source', '--points', 320_000, '--count', 50, env=env)
        sensor.wait_log('"sent"')
        arrived = settled(lambda before=before: received(active, 'source') - before)
        figures[name] = f'{arrived} of 50 heard'
        sensor.end()
    delay = active.status().values['source']['longest delay ms']
    print('5.1 MB best effort at 10 Hz, by the transports of the sensor:', figures, f'longest delay {delay} ms')
    assert arrived >= 40


def settled(count):
    """Return the count once two readings, a diagnostics period apart, agree."""
    readings = [count()]

    def agree():
        readings.append(count())
        return readings[-1] == readings[-2]

    until(agree, 'the count to settle')
    return readings[-1]


def test_clouds_are_heard_while_a_registration_runs(active, ros, sensors):
    send_pair(ros)
    wait_received(active)
    assert active.set_parameters(SLOW).success
    sensor = sensors('/target', '--points', 20_000, '--rate', 30, '--reliable')
    sensor.wait_log('matched')
    future = ask_register(ros)
    until(lambda: 'stage' in active.status().values['registration'] or future.done(), 'a registration to run')
    before = received(active, 'target')
    until(lambda: received(active, 'target') > before + 30, 'clouds meanwhile')
    values = active.status().values
    print(f'while registering: {values["target"]["received"]} clouds, delay {values["target"]["longest delay ms"]} ms')
    active.cancel()
    until(future.done, 'the answer')


def ask_register(ros):
    from std_srvs.srv import Trigger

    service = ros.node.create_client(Trigger, '/csgm/register')
    assert service.wait_for_service(10.0)
    return service.call_async(Trigger.Request())


def test_windows_merge_the_newest_messages(active, ros):
    assert active.set_parameters({'target_window': 3, 'window_voxel': 0.0}).success
    source, target, _ = easy_pair()
    kept = send_pair(ros, (source, target[:100]))
    wait_received(active)
    publisher = ros.publisher('/target')
    until(publisher.get_subscription_count, 'a subscription')
    for count, part in enumerate((target[0::3], target[1::3], target[2::3]), start=2):
        publisher.publish(cloud(part))
        wait_received(active, 1, count)
    assert active.register().success
    fused = ros.listen('/csgm/fused', PointCloud2).wait()
    assert fused.width == len(source) + len(target)
    assert active.status().values['registration']['target points'] == str(len(target))
    assert kept
