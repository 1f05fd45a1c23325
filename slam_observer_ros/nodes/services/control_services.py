"""Services and topics by which a person or another node steers the observer."""

from __future__ import annotations

from rclpy.node import Node
from std_msgs.msg import Int64
from std_srvs.srv import Trigger

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.nodes.intake.estimator_feed import EstimatorFeed
from slam_observer_ros.nodes.intake.transformed_odometry import TransformedOdometry
from slam_observer_ros.nodes.publishing.estimate_publisher import EstimatePublisher
from slam_observer_ros.nodes.qos import RELIABLE_QOS
from slam_observer_ros.nodes.services.paused_motion import PausedMotion


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
