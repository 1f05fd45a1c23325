"""Services and topics by which a person or another node steers the observer."""

from __future__ import annotations

import numpy as np
from rclpy.node import Node
from std_msgs.msg import Int64
from std_srvs.srv import Trigger

from slam_observer_ros.common.stamps import to_ns, to_s
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.nodes.intake.estimator_feed import EstimatorFeed
from slam_observer_ros.nodes.intake.transforms import TransformedOdometry
from slam_observer_ros.nodes.publishing.estimate_publisher import EstimatePublisher
from slam_observer_ros.nodes.ros_interface import RELIABLE_QOS

MAX_STEP_NS = 500_000_000
"""Time between two velocities, nanoseconds, whose stamps are believed at once."""


class PausedMotion:
    """Moves the estimate on, at the end of a pause, by what the odometry on /tf did meanwhile.

    The odometry's frame keeps its place in the map, with which /tf has had the robot right.
    """

    def __init__(self, estimator: Estimator, odometry: TransformedOdometry) -> None:
        self._estimator = estimator
        self._odometry = odometry
        self._correction: FloatArray | None = None

    def begin(self) -> None:
        """Remember where the odometry's frame is in the map."""
        stamp_ns, newest_ns = self._estimator.stamp_ns, self._odometry.newest_ns
        self._correction = None
        if stamp_ns is not None and newest_ns is not None:
            common_ns = min(stamp_ns, newest_ns)
            self._note(self._estimator.pose_at(common_ns), common_ns)

    def note_move(self) -> None:
        """Take that somebody has moved the robot meanwhile, to where it is now."""
        newest_ns = self._odometry.newest_ns
        self._correction = None
        if newest_ns is not None:
            self._note(self._estimator.pose, newest_ns)

    def end(self) -> bool:
        """Let the estimate follow the odometry; return whether it could."""
        start_ns, end_ns = self._estimator.stamp_ns, self._odometry.newest_ns
        odometry = None if end_ns is None else self._odometry.pose_until(end_ns)
        correction, self._correction = self._correction, None
        if correction is None or odometry is None or start_ns is None or end_ns is None:
            return False
        if end_ns <= start_ns:
            return True
        way = se3.log(se3.inverse(self._estimator.pose) @ correction @ odometry)
        step_ns = min(to_ns(self._estimator.settings.velocity_timeout) // 2, MAX_STEP_NS)
        velocity = way / to_s(end_ns - start_ns)
        for stamp_ns in range(start_ns + 1, end_ns, step_ns):
            self._estimator.add(VelocityEvent(stamp_ns, velocity, is_mean=True))
        self._estimator.add(VelocityEvent(end_ns, np.zeros(6)))
        return True

    def _note(self, pose: FloatArray, stamp_ns: int) -> None:
        odometry = self._odometry.pose_until(stamp_ns)
        if odometry is not None:
            self._correction = pose @ se3.inverse(odometry)


class ControlServices:
    """``~/reset``, ``~/pause``, ``~/resume`` and ``~/forget_landmark``."""

    def __init__(
        self,
        node: Node,
        estimator: Estimator,
        feed: EstimatorFeed,
        publisher: EstimatePublisher,
        odometry: TransformedOdometry,
    ) -> None:
        self._node = node
        self._estimator = estimator
        self._feed = feed
        self._publisher = publisher
        self._paused_motion = PausedMotion(estimator, odometry)
        node.create_service(Trigger, '~/reset', self._reset)
        node.create_service(Trigger, '~/pause', self._pause)
        node.create_service(Trigger, '~/resume', self._resume)
        node.create_subscription(Int64, '~/forget_landmark', self._forget, RELIABLE_QOS)

    def _reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._estimator.reset()
        self.note_move()
        return self._answer(response, 'pose and what was mapped are forgotten')

    def _pause(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._estimator.release()  # what has come before the pause counts
        if not self._feed.is_paused:
            self._paused_motion.begin()
        self._feed.is_paused = True
        self._feed.on_events('')
        return self._answer(response, 'paused: the pose is held, and all that comes in is dropped')

    def _resume(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        was_paused, self._feed.is_paused = self._feed.is_paused, False
        if not was_paused or self._paused_motion.end():
            return self._answer(response, 'resumed')
        return self._answer(response, 'resumed where it was paused: no odometry is on /tf')

    def note_move(self) -> None:
        """Take that the robot is somewhere else in the map than it was, or in another map."""
        self._publisher.reset()
        if self._feed.is_paused:
            self._paused_motion.note_move()

    def _answer(self, response: Trigger.Response, text: str) -> Trigger.Response:
        self._node.get_logger().info(text)
        response.success = True
        response.message = text
        return response

    def _forget(self, message: Int64) -> None:
        self._estimator.release()  # else a sighting that is held back would bring it back
        was_known = self._estimator.forget(message.data)
        if was_known:
            self._publisher.replace_landmarks()
        self._node.get_logger().info(
            f'landmark {message.data} is {"forgotten" if was_known else "not known"}'
        )
