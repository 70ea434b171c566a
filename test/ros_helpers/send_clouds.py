"""A sensor in a process of its own: publishes clouds at a rate and prints how many.

They are random points, or one side of a pair that registers, drawn as densely as asked for.
Its transports are what the environment says: the defaults, unless a test sets the shipped profile.
"""

import argparse
import json
import time

import numpy as np
import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2

from csgm_ros.ros.cloud_msgs import cloud_message, header
from ros_helpers.clouds import easy_pair

JITTER = 1e-3  # of the extent, by which repeated points differ


def cloud(count: int, side: str) -> np.ndarray:
    """Return (count, 3) points, random ones where no side is named."""
    rng = np.random.default_rng(0)
    if not side:
        return rng.normal(size=(count, 3))
    points = easy_pair()[('source', 'target').index(side)]
    noise = JITTER * np.ptp(points, axis=0).max() * rng.normal(size=(count, 3))
    return points[rng.integers(len(points), size=count)] + noise


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument('topic')
    parser.add_argument('--points', type=int, default=1000)
    parser.add_argument('--count', type=int, default=10**9)
    parser.add_argument('--rate', type=float, default=10.0)
    parser.add_argument('--side', choices=['source', 'target'], default='')
    parser.add_argument('--reliable', action='store_true')
    parser.add_argument('--latched', action='store_true')
    options = parser.parse_args()
    rclpy.init()
    node = rclpy.create_node('sensor')
    qos = QoSProfile(
        depth=1,
        reliability=ReliabilityPolicy.RELIABLE if options.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if options.latched else DurabilityPolicy.VOLATILE,
    )
    publisher = node.create_publisher(PointCloud2, options.topic, qos)
    points = cloud(options.points, options.side)
    message = cloud_message(header(options.side or 'sensor', 0), points, np.zeros((options.points, 3), np.uint8))
    while not publisher.get_subscription_count():
        time.sleep(0.01)
    print(json.dumps({'event': 'matched', 'megabytes': len(message.data) / 1e6}), flush=True)
    started = time.monotonic()
    for number in range(options.count):
        time.sleep(max(0.0, started + number / options.rate - time.monotonic()))
        message.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(message)
    print(json.dumps({'event': 'sent', 'count': options.count}), flush=True)
    while publisher.get_subscription_count():  # latched and reliable messages need their writer
        time.sleep(0.01)


if __name__ == '__main__':
    main()
