"""What a node has published last, fetched by somebody who comes late."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor

from csgm_ros.io.pointcloud2 import decode
from csgm_ros.ros.client.connection import NODE, PATIENCE, NoAnswerError
from csgm_ros.ros.outputs import TOPICS
from csgm_ros.ros.qos import LATCHED
from csgm_ros.types import Cloud, Similarity

WANTED = ('transform', 'scale', 'similarity', 'fused')


@dataclass(frozen=True, eq=False)
class Published:
    """The latched outputs of one accepted registration.

    Attributes
    ----------
    transform : Similarity
        ``x_target = s R x_source + t``, of ~/similarity.
    fused : Cloud
        Target plus moved source, of ~/fused.
    frame_id, child_frame_id : str
        Frames of ~/transform.
    """

    transform: Similarity
    fused: Cloud
    frame_id: str
    child_frame_id: str


def fetch(node: str = NODE, timeout: float = PATIENCE) -> Published:
    """Return the last result of a node.

    Raises
    ------
    NoAnswerError
        When there is none within ``timeout`` seconds.
    """
    heard: dict = {}
    context = rclpy.Context()
    rclpy.init(context=context)
    listener = rclpy.create_node('csgm_listener', context=context, start_parameter_services=False)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(listener)
    try:
        for name in WANTED:
            listener.create_subscription(TOPICS[name], f'/{node.strip("/")}/{name}', _keeper(heard, name), LATCHED)
        end = time.monotonic() + timeout
        while len(heard) < len(WANTED):
            if time.monotonic() > end:
                missing = [name for name in WANTED if name not in heard]
                raise NoAnswerError(f'nothing on ~/{missing[0]} of {node} within {timeout:g} s')
            executor.spin_once(timeout_sec=0.1)
    finally:
        executor.shutdown()
        listener.destroy_node()
        context.try_shutdown()
    matrix = np.array(heard['similarity'].data).reshape(4, 4)
    message = heard['transform']
    return Published(
        Similarity.from_matrix(matrix), decode(heard['fused']), message.header.frame_id, message.child_frame_id
    )


def _keeper(heard: dict, name: str):
    def keep(message) -> None:
        heard[name] = message

    return keep
