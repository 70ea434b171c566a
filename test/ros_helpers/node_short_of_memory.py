"""The node, where memory for the first source cloud is missing."""

import sys

from rclpy.executors import MultiThreadedExecutor

from csgm_ros.ros.node import main

taken = []
healthy = MultiThreadedExecutor._take_subscription


def take(self, subscription):
    taken.append(subscription.topic)
    if taken.count('/short/source') == 1:
        taken.append('/short/source')
        raise MemoryError
    return healthy(self, subscription)


if __name__ == '__main__':
    MultiThreadedExecutor._take_subscription = take
    sys.exit(main())
