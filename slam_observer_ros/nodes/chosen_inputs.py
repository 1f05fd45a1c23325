"""Which topics the observer reads, and how they are decoded, as the parameters choose.

Decoders warn once of what the messages do not contain.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
import time
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from slam_observer_ros.common.errors import ParameterError
from slam_observer_ros.common.findings import Finding
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID, VelocityEvent
from slam_observer_ros.messages.cdr import Buffer
from slam_observer_ros.messages.clouds import CLOUDS, ID_NAME, missing_ids, read_fields
from slam_observer_ros.messages.detections import no_tags, observed_tags
from slam_observer_ros.messages.poses import (
    decode_odometry,
    decode_odometry_pose,
    decode_transforms,
    ODOMETRY,
    TRANSFORMS,
)
from slam_observer_ros.messages.registry import Decode, decoders
from slam_observer_ros.nodes.estimator_feed import EstimatorFeed
from slam_observer_ros.nodes.input_topic import InputTopic
from slam_observer_ros.nodes.ros_node import is_installed, message_class
from slam_observer_ros.recordings.event_builder import OdometryCheck
from slam_observer_ros.runs.health import of_twist
from slam_observer_ros.settings.node_settings import (
    AUTO,
    message_types,
    ObserverNodeSettings,
    ON_TF,
    POSE_DIFFERENCES,
    Role,
)

# Any publisher is heard by it; so many messages of an input are kept while the node is busy.
QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)


def open_inputs(
    node: Node, settings: ObserverNodeSettings, feed: EstimatorFeed
) -> list[InputTopic]:
    """Subscribe to what the parameters name; ParameterError if a type's package is missing."""
    chosen = _chosen('velocity', settings.velocity_type)
    if settings.velocity_source == POSE_DIFFERENCES:
        if settings.velocity_type not in (AUTO, 'Odometry'):
            raise ParameterError(
                f"velocity_type '{settings.velocity_type}' has no poses: with velocity_source "
                "'pose_differences' it is 'Odometry' or 'auto'"
            )
        chosen = {ODOMETRY: decode_odometry_pose}
    elif ODOMETRY in chosen:
        chosen[ODOMETRY] = OdometryDecoder(node, not settings.use_imu)
    velocity = InputTopic(node, 'twist', chosen, partial(feed.add, 'twist'), QOS)
    landmarks = _landmark_input(node, settings, feed)
    imu: list[InputTopic] = []
    if settings.use_imu:
        of_imu = decoders('angular velocity')
        imu.append(InputTopic(node, 'imu', of_imu, partial(feed.add, 'imu'), QOS))
    velocity.read_first, landmarks.read_first = imu, [velocity, *imu]
    return [velocity, landmarks, *imu]


def _landmark_input(node: Node, settings: ObserverNodeSettings, feed: EstimatorFeed) -> InputTopic:
    name = 'landmarks'
    take: Callable[[Any, int], None] = feed.add_observation
    chosen: dict[str, Any]
    if settings.landmarks_type == ON_TF:
        name, take = '/tf', feed.add_observations
        chosen = {TRANSFORMS: TagDecoder(node, settings.tag_frame_prefix)}
    else:
        chosen = _chosen('landmarks', settings.landmarks_type)
        for cloud in chosen.keys() & CLOUDS:
            chosen[cloud] = CloudDecoder(node, cloud)
        if not any(map(is_installed, chosen)):
            message_class(next(iter(chosen)))  # raises, and says what to install
    topic = InputTopic(node, name, chosen, take, QOS, settings.landmarks_max_wait)
    topic.is_shared = True
    topic.advice = {
        message_type: f'landmarks_type: {known.short_name}'
        for message_type, known in message_types('landmarks').items()
    }
    return topic


def _chosen(role: Role, type_choice: str) -> dict[str, Any]:
    """Return what decodes the types of a short name, or all that are read as this."""
    return {
        name: known.decode
        for name, known in message_types(role).items()
        if type_choice in (AUTO, known.short_name)
    }


MOVED_M = 0.1  # how far an odometry's poses go before its velocities can't all be zero
WITHOUT_TAG_S = 20.0  # time without any fiducial on /tf after which their names may be others


class CloudDecoder:
    """Decodes clouds of a type; warns once if points have no ids, as a misspelt field has it."""

    def __init__(self, node: Node, message_type: str) -> None:
        self._node, self._message_type = node, message_type
        self._decode: Decode[ObservationEvent] = decoders('landmarks')[message_type]
        self._is_checked = False

    def __call__(self, raw: Buffer, receive_ns: int) -> ObservationEvent:
        """Decode a cloud."""
        event = self._decode(raw, receive_ns)
        if self._is_checked or not len(event.ids) or (event.ids != UNKNOWN_ID).any():
            return event
        self._is_checked = True
        names = read_fields(raw, self._message_type).names
        if missing := missing_ids(names, self._message_type):
            topic = self._node.resolve_topic_name('landmarks')
            self._node.get_logger().warning(
                f"points on '{topic}' come {missing}: they are distinguished by where they are; "
                f"if they have ids, name these '{ID_NAME}'"
            )
        return event


class OdometryDecoder:
    """Decodes velocities of odometries; warns once if their poses move otherwise.

    ``doubt`` is what is wrong with them: None until it is seen, and, of zeros, until one is none.
    """

    def __init__(self, node: Node, uses_turn: bool = True) -> None:
        self._node = node
        self._topic = node.resolve_topic_name('twist')
        self._gives_velocities = False
        self._check = OdometryCheck(uses_turn)
        self.doubt: Finding | None = None
        self._first: FloatArray | None = None

    def __call__(self, raw: Buffer, receive_ns: int) -> VelocityEvent:
        """Decode the velocity of a nav_msgs/Odometry."""
        pose, velocity = decode_odometry(raw)
        if self._gives_velocities:
            if not self._check.is_decided:
                self._check.add(pose, velocity)
                if self._check.problem:
                    self._warn(self._check.problem)
        elif velocity.body_velocity.any():  # and it will do so again
            self._gives_velocities, self.doubt = True, None
        elif not (self.doubt or pose.problem):  # nobody asked for its pose
            self._first = pose.position if self._first is None else self._first
            if np.linalg.norm(pose.position - self._first) > MOVED_M:
                self._warn()
        return velocity

    def _warn(self, problem: str = '') -> None:
        self.doubt = of_twist(f"'{self._topic}'", problem)
        self._node.get_logger().warning(self.doubt.text())


class TagDecoder:
    """Decodes fiducials on /tf, and warns once if no frame is named as they are."""

    def __init__(self, node: Node, tag_frame_prefix: str) -> None:
        self._node, self._prefix = node, tag_frame_prefix
        self._warn_at_s = time.monotonic() + WITHOUT_TAG_S
        self._is_checked = False
        self._frames: set[str] = set()

    def __call__(self, raw: Buffer, _receive_ns: int) -> list[ObservationEvent]:
        """Decode what of a tf2_msgs/TFMessage are sightings of fiducials."""
        transforms = decode_transforms(raw)
        seen = observed_tags(transforms, self._prefix)
        self._is_checked = self._is_checked or bool(seen)
        if not self._is_checked:
            self._frames |= {transform.child_frame_id for transform in transforms}
            if time.monotonic() > self._warn_at_s:
                self._is_checked = True
                reason = no_tags(self._prefix, self._frames)
                self._node.get_logger().warning(f'no fiducial seen so far: {reason}')
        return seen
