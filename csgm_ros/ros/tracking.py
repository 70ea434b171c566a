"""What the node does in mode tracking: a map, frames of a depth sensor, and where that sensor is."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger

from csgm_ros.errors import InputError
from csgm_ros.ros.diagnostics import tracking_status
from csgm_ros.ros.frames import LATEST, Frames, pose
from csgm_ros.ros.inputs import CloudInput, Window
from csgm_ros.ros.lifecycle import SafeLifecycleNode, answering, guarded
from csgm_ros.ros.parameters import Parameters
from csgm_ros.ros.poses import Poses, metric_frame
from csgm_ros.ros.tracker import Tracked, Tracker
from csgm_ros.tracking.maps import PreparedMap, read_map
from csgm_ros.tracking.session import Session
from csgm_ros.types import Prior, Similarity

LEAST_SIGMA = 0.1, 5.0  # metres and degrees: a prior is never believed to be better
SCALE_SIGMA = 0.05


class Tracking:
    """Follows a sensor through a map of any unit; nothing is given out while it is lost."""

    def __init__(self, node: SafeLifecycleNode, settings: Parameters, frames: Frames):
        self._node, self._settings, self._frames = node, settings, frames
        self._map = CloudInput(node, 'map', self._window, self._on_map)
        self._points = CloudInput(node, 'points', self._window, self._on_frame)
        self._tracker = Tracker(node, self._publish, self._on_prepared)
        self._file: PreparedMap | None = None
        self._outputs: Poses | None = None
        self._initial: Subscription | None = None
        self._prior: Prior | None = None
        self._complaint = ''
        node.create_service(Trigger, '~/relocalize', answering(self._on_relocalize, node))

    @property
    def inputs(self) -> list[CloudInput]:
        """The topics that are listened to."""
        return [self._points] if self._settings.node_config.map_file else [self._map, self._points]

    def _window(self) -> Window:
        return Window(1, self._settings.node_config.max_points)

    def configure(self) -> None:
        """Read the map where it is a file, compile the kernels and create the outputs."""
        path = self._settings.node_config.map_file
        self._file = read_map(Path(path)) if path else None
        self._prior = self._settings.prior
        warm_up_once()
        self._outputs = Poses(self._node)

    def open(self) -> str:
        """Listen; return what to, in one line."""
        settings = self._settings.node_config
        if settings.odom_frame or settings.base_frame:
            self._frames.listen()
        if settings.tf_broadcast and self._outputs is not None:
            self._outputs.advertise_tf()
        self._tracker.open()
        if self._file is not None:
            self._tracker.use_map(self._file, settings.map_frame)
        self._initial = self._node.create_subscription(
            PoseWithCovarianceStamped, 'initialpose', guarded(self._on_initial_pose, self._node), QoSProfile(depth=1)
        )
        for cloud_input in self.inputs:
            cloud_input.open()
        where = settings.map_file or self._map.topic
        return f'map {where}, frames {self._points.topic}'

    def close(self, reason: str) -> None:
        """Listen no more, and forget where the sensor was."""
        for cloud_input in (self._map, self._points):
            cloud_input.close()
        if self._initial is not None:
            self._node.destroy_subscription(self._initial)
            self._initial = None
        self._tracker.close(reason)

    def release(self) -> None:
        """Take the outputs down, and forget the map."""
        if self._outputs is not None:
            self._outputs.destroy()
            self._outputs = None
        self._file = None

    def stop(self, timeout: float) -> bool:
        """End the thread; False when a computation is still running."""
        return self._tracker.stop(timeout)

    def status(self, name: str) -> DiagnosticStatus:
        """Return what is to be said of the frames."""
        return tracking_status(f'{name}: tracking', self._node.state, self._tracker)

    def monitor(self) -> None:
        """Publish what need not be published with every frame."""
        if self._outputs is not None:
            self._outputs.publish_path()

    # Inputs

    def _on_map(self) -> None:
        message = self._map.messages[-1]
        self._tracker.use_map(message, message.header.frame_id)

    def _on_frame(self) -> None:
        messages = self._points.messages
        if messages and self._node.state == 'active':
            settings = self._settings.node_config
            self._tracker.submit(messages[-1], self._settings.config, settings.seed, self._odometry, self._prior)

    def _odometry(self, sensor: str, stamp: int) -> Similarity | None:
        """Return where TF has the sensor in the odometry's frame, None where it does not tell."""
        odom = self._settings.node_config.odom_frame
        if not odom:
            return None
        try:
            found = self._frames.lookup(odom, sensor, stamp)
        except InputError as error:
            self._say(str(error))
            return None
        self._say('')
        return found

    def _say(self, complaint: str) -> None:
        """Log why the odometry is missing, once for each reason's kind."""
        if bool(complaint) != bool(self._complaint) and complaint:
            self._node.get_logger().warning(f'tracking without odometry: {complaint}')
        self._complaint = complaint

    def _on_relocalize(self) -> tuple[bool, str]:
        if self._node.state != 'active':
            return False, f'the node is {self._node.state}; configure and activate it first'
        if not self._tracker.ask(Session.relocalize):
            return False, f'no map on {self._map.topic} yet ({self._map.explanation})'
        return True, 'searching everywhere'

    def _on_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Search near a pose that somebody gave, as the pose tool of RViz does."""
        metric = self._prior_of(message)
        frame = message.header.frame_id

        def request(session: Session) -> None:
            map_frame = self._tracker.map_frame
            if frame != metric_frame(map_frame):
                raise InputError(f'/initialpose is in {frame!r}; give it in {metric_frame(map_frame)!r}')
            if not np.isfinite(session.scale):
                raise InputError('/initialpose is left out: the scale of the map is not known yet')
            session.relocalize(in_map(metric, session.scale))

        if not self._tracker.ask(request):
            raise InputError('/initialpose is left out: there is no map yet')

    def _prior_of(self, message: PoseWithCovarianceStamped) -> Prior:
        """Return the sensor's pose and its uncertainty in metres."""
        given = message.pose
        place = Similarity.from_quaternion(*pose(given.pose.orientation, given.pose.position))
        if not np.isfinite(place.matrix).all():
            raise InputError('/initialpose holds no pose: its quaternion is zero or a value is not finite')
        covariance = np.array(given.covariance).reshape(6, 6)
        shift, turn = (np.sqrt(max(np.linalg.norm(part, 2), 0.0)) for part in (covariance[:3, :3], covariance[3:, 3:]))
        sigma = max(float(shift), LEAST_SIGMA[0]), max(float(np.degrees(turn)), LEAST_SIGMA[1]), SCALE_SIGMA
        base, sensor = self._settings.node_config.base_frame, self._tracker.sensor_frame
        if base and sensor:
            place = place @ self._frames.lookup(base, sensor, LATEST)
        return Prior(place, sigma)

    # Outputs

    def _on_prepared(self, prepared: PreparedMap, frame_id: str) -> None:
        self._node.get_logger().info(f'map of {len(prepared.points)} points in {frame_id}')
        if self._outputs is not None:
            self._outputs.use_map(prepared, frame_id)

    def _publish(self, tracked: Tracked) -> None:
        estimate, outputs = tracked.estimate, self._outputs
        if estimate.T_map_sensor is None or estimate.covariance is None or outputs is None:
            return
        settings = self._settings.node_config
        found = Similarity.from_matrix(estimate.T_map_sensor)
        sensor = Similarity(1.0, found.rotation, found.translation / found.scale)
        child, place, covariance = tracked.frame_id, sensor, estimate.covariance
        if settings.base_frame:
            child = settings.base_frame
            place = sensor @ self._frames.lookup(tracked.frame_id, child, tracked.stamp)
            covariance = carried(covariance, place.translation - sensor.translation)
        outputs.publish(tracked.stamp, place, covariance, found.scale)
        if not settings.tf_broadcast:
            return
        if not settings.odom_frame:
            outputs.broadcast(tracked.stamp, child, place)
        elif tracked.odometry is not None:
            ahead = tracked.stamp + int(1e9 * settings.transform_tolerance)
            outputs.broadcast(ahead, settings.odom_frame, sensor @ tracked.odometry.inverse())


def in_map(metric: Prior, scale: float) -> Prior:
    """Return a prior in metres as one in map units, of which ``scale`` are a metre."""
    place = Similarity(scale, metric.transform.rotation, scale * metric.transform.translation)
    return Prior(place, (scale * metric.sigma[0], *metric.sigma[1:]))


def carried(covariance: np.ndarray, arm: np.ndarray) -> np.ndarray:
    """Return the (6, 6) covariance of a point that is (3,) ``arm`` off, as both turn together."""
    jacobian = np.eye(6)
    jacobian[:3, 3:] = np.array(((0.0, arm[2], -arm[1]), (-arm[2], 0.0, arm[0]), (arm[1], -arm[0], 0.0)))
    return jacobian @ covariance @ jacobian.T


@functools.cache
def warm_up_once() -> None:
    """Import and compile what tracking and localising need."""
    from csgm_ros.tracking.session import warm_up

    warm_up()
