"""Which topics the observer reads, and how they are decoded, as the parameters choose."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

from slam_observer_ros.common.errors import ParameterError
from slam_observer_ros.messages.clouds import CLOUDS
from slam_observer_ros.messages.poses import decode_odometry_pose, ODOMETRY, TRANSFORMS
from slam_observer_ros.messages.registry import decoders
from slam_observer_ros.nodes.intake.estimator_feed import EstimatorFeed
from slam_observer_ros.nodes.intake.input_topic import InputTopic
from slam_observer_ros.nodes.intake.warning_decoders import (
    CloudDecoder,
    OdometryDecoder,
    TagDecoder,
)
from slam_observer_ros.nodes.message_classes import is_installed, message_class
from slam_observer_ros.settings.input_settings import AUTO, ON_TF, POSE_DIFFERENCES
from slam_observer_ros.settings.message_types import message_types, Role
from slam_observer_ros.settings.node_settings import ObserverNodeSettings


def open_inputs(
    node: Node, settings: ObserverNodeSettings, feed: EstimatorFeed
) -> list[InputTopic[Any]]:
    """Subscribe to what the parameters name; ParameterError if a type's package is missing."""
    velocity = _velocity_input(node, settings, feed)
    landmarks = _landmark_input(node, settings, feed)
    imu: list[InputTopic[Any]] = []
    if settings.use_imu:
        qos = _qos(settings.twist_qos, settings.queue_depth)
        of_imu = decoders('angular velocity')
        imu.append(InputTopic(node, 'imu', of_imu, partial(feed.add, 'imu'), qos))
    velocity.read_first, landmarks.read_first = imu, [velocity, *imu]
    return [velocity, landmarks, *imu]


def _velocity_input(
    node: Node, settings: ObserverNodeSettings, feed: EstimatorFeed
) -> InputTopic[Any]:
    qos = _qos(settings.twist_qos, settings.queue_depth)
    if settings.velocity_source == POSE_DIFFERENCES:
        if settings.velocity_type not in (AUTO, 'Odometry'):
            raise ParameterError(
                f"velocity_type '{settings.velocity_type}' has no poses: with velocity_source "
                "'pose_differences' it is 'Odometry' or 'auto'"
            )
        chosen: dict[str, Any] = {ODOMETRY: decode_odometry_pose}
    else:
        chosen = _chosen('velocity', settings.velocity_type)
        if ODOMETRY in chosen:
            chosen[ODOMETRY] = OdometryDecoder(node, not settings.use_imu)
    return InputTopic(node, 'twist', chosen, partial(feed.add, 'twist'), qos)


def _landmark_input(
    node: Node, settings: ObserverNodeSettings, feed: EstimatorFeed
) -> InputTopic[Any]:
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
    qos = _qos(settings.landmarks_qos, settings.queue_depth)
    topic = InputTopic(node, name, chosen, take, qos, settings.landmarks_max_wait)
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


def _qos(reliability: str, depth: int) -> QoSProfile:
    return QoSProfile(
        reliability=ReliabilityPolicy[reliability.upper()],
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
    )
