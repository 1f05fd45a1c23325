"""Poses that a person or another node gives to the observer."""

from __future__ import annotations

from collections.abc import Callable

from geometry_msgs.msg import PoseWithCovarianceStamped
import numpy as np
from rclpy.node import Node

from slam_observer_ros.common.errors import MessageError, ParameterError
from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimator.estimator import Estimator, GIVEN_POSE_STD
from slam_observer_ros.geometry.matrices import are_covariances, limited
from slam_observer_ros.messages.poses import (
    decode_pose_with_covariance_stamped,
    PoseMessage,
)
from slam_observer_ros.nodes.intake.clocks import FUTURE_NS
from slam_observer_ros.nodes.intake.transforms import TransformedOdometry
from slam_observer_ros.nodes.message_classes import RELIABLE_QOS
from slam_observer_ros.settings.estimator_settings import MAX_POSITION_M
from slam_observer_ros.state.covariances import MAX_POSE_ERRORS, of_moved_pose

TOPICS = ('initialpose', '~/set_pose')


class InitialPoseListener:
    """Moves the robot to the poses in ``map_frame`` that come on ``TOPICS``."""

    def __init__(
        self,
        node: Node,
        map_frame: str,
        estimator: Estimator,
        odometry: TransformedOdometry,
        on_move: Callable[[], None],
    ) -> None:
        self._node = node
        self._odometry = odometry
        self._map_frame = map_frame
        self._estimator = estimator
        self._on_move = on_move
        for topic in TOPICS:
            node.create_subscription(
                PoseWithCovarianceStamped, topic, self._receive, RELIABLE_QOS, raw=True
            )

    def _receive(self, raw: bytes) -> None:
        try:
            message = decode_pose_with_covariance_stamped(raw)
            self._check(message)
            covariance = filled_in(message.covariance)
            self._estimator.release()  # what has come before belongs to where the robot was
            self._set(message.pose, covariance, message.stamp_ns)
        except (MessageError, ParameterError) as error:
            self._node.get_logger().error(f'the pose given is not used: {error}')
            return
        self._on_move()
        x, y, z = message.position.tolist()
        what = 'is set to' if self._estimator.is_localised else 'is searched for about'
        self._node.get_logger().info(f'the robot {what} ({x:.2f}, {y:.2f}, {z:.2f}) m')

    def _set(self, pose: FloatArray, covariance: FloatArray, stamp_ns: int) -> None:
        """Move the robot to where it was at a stamp, and add how it moved since, as AMCL does."""
        estimator = self._estimator
        now_ns = estimator.stamp_ns or 0
        ahead_ns = stamp_ns - int(self._node.get_clock().now().nanoseconds)
        if ahead_ns > FUTURE_NS:
            self._node.get_logger().warning(
                f"the pose given is stamped {to_s(ahead_ns):.3f} s ahead of this machine's clock: "
                'it is taken as of now; synchronise the clocks'
            )
        if not 0 < stamp_ns < now_ns or estimator.knows_motion_since(stamp_ns):
            estimator.set_pose(pose, covariance, min(stamp_ns or now_ns, now_ns))
            return
        motion = self._odometry.motion(stamp_ns, now_ns)
        if motion is None:
            self._node.get_logger().warning(
                f'the pose given is {to_s(now_ns - stamp_ns):.1f} s old, and how the robot moved '
                'since is not known: it is taken as of now'
            )
            motion = np.eye(4)
        moved = of_moved_pose(covariance, pose, motion, np.zeros((6, 6)))
        estimator.set_pose(pose @ motion, moved)

    def _check(self, message: PoseMessage) -> None:
        if message.frame_id.lstrip('/') not in ('', self._map_frame):
            raise MessageError(f"it is in frame '{message.frame_id}', not '{self._map_frame}'")
        if not np.isfinite(message.position).all():
            raise MessageError('its position has a NaN or infinite entry')
        if np.abs(message.position).max() > MAX_POSITION_M:
            raise MessageError(f'its position has an entry beyond {MAX_POSITION_M:g} m')


def filled_in(covariance: FloatArray | None) -> FloatArray:
    """Return a covariance (6, 6) with variances assumed where the message gives none.

    RViz's 2D Pose Estimate, for one, gives those of x, y and yaw only, and zeros else. Those
    that are so large that they only say 'unknown' are made less, lest they drown all others.
    Raises a MessageError if it is not finite, not symmetric, or negative in some direction.
    """
    given = np.zeros((6, 6)) if covariance is None else covariance
    if not (np.isfinite(given).all() and are_covariances(given)):
        raise MessageError(
            'its covariance is not finite, not symmetric, or negative in some direction'
        )
    assumed: FloatArray = np.where(np.diagonal(given) == 0.0, GIVEN_POSE_STD**2, 0.0)
    return limited(given, MAX_POSE_ERRORS) + np.diag(assumed)
