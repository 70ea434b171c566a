"""Publish a pair to the node and wait until it is heard."""

from csgm_ros.ros.cloud_msgs import cloud_message, header
from ros_helpers.clouds import easy_pair
from ros_helpers.waiting import until

# So thorough that a registration takes long enough to be interrupted, and what it is otherwise.
SLOW = {'matching.alpha_steps': 1001, 'matching.frank_wolfe_iterations': 1000}
QUICK = {'matching.alpha_steps': 11, 'matching.frank_wolfe_iterations': 50}
SOURCE_STAMP, TARGET_STAMP = 5_000_000_001, 7_250_000_000


def received(client, name):
    """Return how many clouds the node says it received on an input."""
    return int(client.status().values[name]['received'])


def wait_received(client, source=1, target=1):
    until(
        lambda: received(client, 'source') >= source and received(client, 'target') >= target,
        f'{source} source and {target} target clouds received',
        30.0,
    )


def send_pair(ros, pair=None, *, space='', source_frame='sfm', target_frame='camera'):
    """Publish (source, target) latched; return the publishers, which must be kept."""
    source, target = (pair or easy_pair())[:2]
    return [
        ros.send(f'{space}/source', cloud_message(header(source_frame, SOURCE_STAMP), source)),
        ros.send(f'{space}/target', cloud_message(header(target_frame, TARGET_STAMP), target)),
    ]
