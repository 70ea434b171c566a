"""The node in mode tracking, over DDS: a real walk with a blocked stretch, and what goes wrong."""

import contextlib
import threading

import numpy as np
import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path
from rclpy.qos import QoSProfile
from ros_helpers.peer import RELIABLE
from ros_helpers.process import NodeProcess
from ros_helpers.waiting import until
from sensor_msgs.msg import PointCloud2
from sequences import Sequence
from std_msgs.msg import Float64
from tf2_msgs.msg import TFMessage

from csgm_ros.io.pointcloud2 import stamp_of
from csgm_ros.ros.client.commands import Client
from csgm_ros.ros.cloud_msgs import cloud_message, header, transform_message
from csgm_ros.ros.frames import pose
from csgm_ros.ros.poses import pose_message
from csgm_ros.types import Similarity

pytestmark = [pytest.mark.ros, pytest.mark.slow]

SPACE = '/walk'  # apart from the node of other tests
SENSOR = 'camera_depth_optical_frame'


@pytest.fixture(scope='module')
def kitchen(shared):
    return Sequence(shared / 'data' / 'sequence_kitchen')


@pytest.fixture(scope='module')
def tracking():
    process = NodeProcess('-p', 'mode:=tracking', '-r', f'__ns:={SPACE}')
    yield process
    process.close()


@pytest.fixture
def client(tracking):
    with active(tracking, SPACE) as connection:
        yield connection


@pytest.fixture
def start():
    """Start a node with settings of its own in a namespace of its own."""
    with contextlib.ExitStack() as stack:

        def started(space, *settings):
            words = [word for setting in ('mode:=tracking', *settings) for word in ('-p', setting)]
            process = NodeProcess(*words, '-r', f'__ns:={space}')
            stack.callback(process.close)
            return stack.enter_context(active(process, space))

        yield started


@contextlib.contextmanager
def active(process, space):
    with Client(f'{space}/csgm') as connection:
        assert connection.configure().success, process.log
        assert connection.activate().success
        yield connection
        connection.deactivate()
        connection.cleanup()


class Walker:
    """Sends frames of a sequence and keeps what comes back; ``ahead(number, stamp)`` is called before each."""

    def __init__(self, ros, kitchen, client, space=SPACE, ahead=None):
        self._kitchen, self._client, self._ahead = kitchen, client, ahead
        self._map = ros.send(f'{space}/map', cloud_message(header('sfm', 0), kitchen.map))
        self._frames = ros.publisher(f'{space}/points')
        self.poses = ros.listen(f'{space}/csgm/pose', PoseWithCovarianceStamped, RELIABLE)
        self.tf = ros.listen('/tf', TFMessage, QoSProfile(depth=100))
        until(self._ready, 'the node to have the map, and to listen reliably')

    def _ready(self):
        values = self._client.status().values
        return values['map']['received'] == '1' and 'reliable/volatile' in values['points']['qos']

    def send(self, number):
        """Send a frame and wait until the node has worked on it."""
        before = self._worked_on()
        stamp = int(1e9 * (100 + self._kitchen.stamps[number]))
        if self._ahead is not None:
            self._ahead(number, stamp)
        points = self._kitchen.points(number).astype(np.float32)
        points[points[:, 2] == 0] = np.nan  # a covered sensor sends nothing but this
        self._frames.publish(cloud_message(header(SENSOR, stamp), points))
        until(lambda: self._worked_on() > before, f'frame {number} to be worked on', 60.0)

    def _worked_on(self):
        values = self.status()
        return sum(int(values[name]) for name in ('frames', 'failed'))

    def status(self):
        return self._client.status().values['tracking']

    def send_until_tracking(self, numbers):
        """Send frames, slowly enough for the search to keep up, until one has a pose; return its number."""
        for number in numbers:
            before = len(self.poses)
            self.send(number)
            if self.status()['state'] == 'tracking':
                until(lambda b=before: len(self.poses) > b, 'the pose of a frame that is tracked')
                return number
            threading.Event().wait(0.15)
        raise AssertionError(f'not tracking after {len(numbers)} frames: {self.status()}')


def test_a_walk_over_dds_is_localised_tracked_blocked_and_found_again(client, ros, kitchen):
    walker = Walker(ros, kitchen, client)
    first = walker.send_until_tracking(range(60))
    for number in range(first + 1, first + 6):
        walker.send(number)
    assert walker.status()['state'] == 'tracking'
    told = len(walker.poses)
    assert told >= 6

    for number in (75, 76, 77, 82, 84):  # the sensor is covered
        walker.send(number)
    assert walker.status()['state'] == 'lost'
    assert len(walker.poses) == len(walker.tf) == told
    walker.send_until_tracking(range(86, 140))
    until(lambda: len(walker.tf) == len(walker.poses) > told, 'a transform of each pose')

    scale = ros.listen(f'{SPACE}/csgm/scale', Float64).wait().data
    assert scale == pytest.approx(np.cbrt(np.linalg.det(kitchen.truth[0][:3, :3])), rel=0.06)
    numbers = {round(1e9 * (100 + stamp)): number for number, stamp in enumerate(kitchen.stamps)}
    for message, tf in zip(walker.poses, walker.tf, strict=True):
        assert message.header.frame_id == tf.transforms[0].header.frame_id == 'sfm_metric'
        assert tf.transforms[0].child_frame_id == SENSOR
        assert message.header.stamp == tf.transforms[0].header.stamp
        place = Similarity.from_quaternion(*pose(message.pose.pose.orientation, message.pose.pose.position))
        number = min(numbers.items(), key=lambda item: abs(item[0] - stamp_of(message)))[1]
        assert kitchen.right(number, np.diag((scale, scale, scale, 1.0)) @ place.matrix)
        covariance = np.array(message.pose.covariance).reshape(6, 6)
        assert (np.linalg.eigvalsh(covariance) > 0).all()
    path = ros.listen(f'{SPACE}/csgm/path', Path).wait()
    assert path.header.frame_id == 'sfm_metric'
    assert ros.listen(f'{SPACE}/csgm/map', PointCloud2).wait().header.frame_id == 'sfm_metric'
    values = walker.status()
    assert (values['dropped'], values['failed']) == ('0', '0')
    assert float(values['evidence agreement']) > 0.6

    # A pose by hand narrows the next search; asked for everywhere, it is lost at once.
    message = walker.poses[-1]
    ros.send(f'{SPACE}/initialpose', message, RELIABLE)
    assert client.relocalize().success
    walker.send(140)
    assert walker.status()['state'] != 'tracking'


class Robot:
    """Its wheels tell where the base is in a frame of their own, and the camera is mounted askew."""

    ODOM, BASE = 'walk_odom', 'walk_base'
    SETTINGS = (f'odom_frame:={ODOM}', f'base_frame:={BASE}', 'transform_tolerance:=0.2')

    def __init__(self, ros, kitchen):
        self._kitchen = kitchen
        self.camera_in_base = Similarity.from_quaternion((0.5, -0.5, 0.5, -0.5), (0.2, 0.05, 1.1))
        self._map_in_odom = Similarity.from_quaternion((0.1, -0.3, 0.2, 0.9), (3.0, -7.0, 0.4))
        mount = transform_message(header(self.BASE, 0), SENSOR, self.camera_in_base)
        self._mount = ros.send('/tf_static', TFMessage(transforms=[mount]))
        self._moving = ros.publisher('/tf', RELIABLE, TFMessage)

    def base_in_map(self, number):
        """In metres."""
        truth = Similarity.from_matrix(self._kitchen.truth[number])
        return Similarity(1.0, truth.rotation, truth.translation / truth.scale) @ self.camera_in_base.inverse()

    def base_in_odom(self, number):
        return self._map_in_odom @ self.base_in_map(number)

    def move(self, number, stamp):
        told = transform_message(header(self.ODOM, stamp), self.BASE, self.base_in_odom(number))
        self._moving.publish(TFMessage(transforms=[told]))


def test_odometry_by_tf_gives_map_to_odom_and_the_pose_of_the_base(start, ros, kitchen):
    robot = Robot(ros, kitchen)
    walker = Walker(ros, kitchen, start('/robot', *Robot.SETTINGS), '/robot', robot.move)
    first = walker.send_until_tracking(range(60))
    sent = range(first, first + 6)
    for number in sent[1:]:
        walker.send(number)

    def corrections():
        return [t for message in walker.tf for t in message.transforms if t.header.frame_id == 'sfm_metric']

    until(lambda: len(walker.poses) == len(corrections()) == len(sent), 'a pose and a correction of each frame')
    scale = ros.listen('/robot/csgm/scale', Float64).wait().data

    def right(number, base):
        return kitchen.right(number, np.diag((scale, scale, scale, 1.0)) @ (base @ robot.camera_in_base).matrix)

    for number, message, correction in zip(sent, walker.poses, corrections(), strict=True):
        base = Similarity.from_quaternion(*pose(message.pose.pose.orientation, message.pose.pose.position))
        assert right(number, base)
        assert correction.child_frame_id == Robot.ODOM
        assert stamp_of(correction) - stamp_of(message) == 200_000_000  # good until the next one comes
        odom = Similarity.from_quaternion(*pose(correction.transform.rotation, correction.transform.translation))
        np.testing.assert_allclose((odom @ robot.base_in_odom(number)).matrix, base.matrix, atol=1e-6)

    # RViz's tool sends the pose of the base: the place is forgotten, and found again near there.
    later = sent[-1] + 1
    guess = PoseWithCovarianceStamped(header=header('sfm_metric', 0))
    guess.pose.pose = pose_message(robot.base_in_map(later))
    guess.pose.covariance = np.diag((0.05, 0.05, 0.05, 0.02, 0.02, 0.02)).ravel().tolist()
    publisher = ros.publisher('/robot/initialpose', RELIABLE, PoseWithCovarianceStamped)
    until(publisher.get_subscription_count, 'the node to listen to poses')
    publisher.publish(guess)
    later = next(n for n in range(later, later + 5) if walker.send(n) or walker.status()['state'] != 'tracking')
    again = walker.send_until_tracking(range(later + 1, later + 12))
    found = walker.poses[-1].pose.pose
    assert right(again, Similarity.from_quaternion(*pose(found.orientation, found.position)))


def test_frames_faster_than_the_node_are_dropped_and_counted(client, ros, kitchen):
    walker = Walker(ros, kitchen, client)
    for number in range(20):
        stamp = int(1e9 * (100 + kitchen.stamps[number]))
        walker._frames.publish(cloud_message(header(SENSOR, stamp), kitchen.points(number).astype(np.float32)))

    def accounted():
        values = client.status().values
        heard = int(values['points']['received'])  # of a burst, DDS may lose some itself
        told = sum(int(values['tracking'][name]) for name in ('frames', 'failed', 'dropped'))
        return heard >= 5 and heard == told

    until(accounted, 'every frame to be accounted for')
    assert int(walker.status()['dropped']) > 0


def test_a_map_that_is_none_is_said_and_the_node_lives_on(client, ros):
    ros.send(f'{SPACE}/map', cloud_message(header('sfm', 0), np.zeros((10, 3))))
    frames = ros.publisher(f'{SPACE}/points')
    until(frames.get_subscription_count, 'the node to listen')
    frame = cloud_message(header(SENSOR, 0), np.random.default_rng(0).normal(size=(1000, 3)))

    def complained():
        frames.publish(frame)
        return 'map' in client.status().message and client.status().values['tracking']['failed'] != '0'

    until(complained, 'the complaint about the map')
    assert client.state() == 'active'


def test_a_map_file_that_is_missing_is_refused(ros):
    process = NodeProcess('-p', 'mode:=tracking', '-p', 'map_file:=/nowhere.ply', '-r', '__ns:=/other')
    try:
        with Client('/other/csgm') as client:
            assert not client.configure().success
        assert '/nowhere.ply' in process.log
    finally:
        process.close()
