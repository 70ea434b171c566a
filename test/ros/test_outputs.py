"""What is published: by several threads at once, while the outputs are taken down and made anew."""

import threading

import numpy as np
import pytest

pytest.importorskip('rclpy')

import rclpy
from rclpy.lifecycle import LifecycleNode

from csgm_ros.config import profile
from csgm_ros.ros.cloud_msgs import header, transform_message
from csgm_ros.ros.outputs import Outputs
from csgm_ros.types import Cloud, RegistrationResult, Similarity
from csgm_ros.verification.decide import no_hypothesis

pytestmark = pytest.mark.ros


@pytest.fixture
def node():
    context = rclpy.Context()
    rclpy.init(context=context)
    made = LifecycleNode('outputs', context=context)
    yield made
    made.destroy_node()
    made._state_machine.destroy_when_not_in_use()
    context.try_shutdown()


def test_publishing_while_the_outputs_are_taken_down_is_no_error(node):
    result = RegistrationResult(Similarity.identity(), no_hypothesis(), {}, 0, profile())
    cloud = Cloud(np.zeros((10, 3)), None, 'map', 0)
    current, failures, counts, stop = [Outputs(node)], [], [0, 0, 0], threading.Event()

    def publish(number):
        while not stop.is_set():
            try:
                current[0].publish(result, cloud, cloud, 'child')
                counts[number] += 1
            except Exception as error:
                failures.append(repr(error))
                return

    threads = [threading.Thread(target=publish, args=(number,)) for number in range(3)]
    for thread in threads:
        thread.start()
    for _ in range(40):
        before = list(counts)
        while not failures and any(now <= then for now, then in zip(counts, before, strict=True)):
            stop.wait(0.001)
        current[0].destroy()
        current[0] = Outputs(node)
    stop.set()
    for thread in threads:
        thread.join(10)
    current[0].destroy()
    assert not failures
    assert min(counts) >= 40


def test_a_transform_message_keeps_map_coordinates_to_a_micrometre():
    """A matrix and a quaternion of doubles, at (4e6, 5e5) m."""
    turn = Similarity.from_quaternion(np.array([0.1, -0.3, 0.7, 0.6]), np.zeros(3))
    transform = Similarity(1.0, turn.rotation, np.array([5e5, 4e6, 120.0]))
    message = transform_message(header('map', 0), 'child', transform).transform
    rotation = np.array([getattr(message.rotation, name) for name in 'xyzw'])
    place = np.array([getattr(message.translation, name) for name in 'xyz'])
    points = np.random.default_rng(0).uniform(-1e6, 1e6, (100, 3))
    heard = Similarity.from_quaternion(rotation, place)
    assert np.abs(heard.apply(points) - transform.apply(points)).max() < 1e-6
