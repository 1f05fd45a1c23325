"""Which topics the observer reads, and how they are decoded, as the parameters choose."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, TypeVar

from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

from slam_observer_ros.common.errors import ParameterError
from slam_observer_ros.messages.detections import decode_apriltags
from slam_observer_ros.messages.message_types import (
    APRILTAGS,
    CLOUD_DECODERS,
    DETECTION_DECODERS,
    IMU,
    ODOMETRY,
    TRANSFORMS,
    VELOCITY_DECODERS,
)
from slam_observer_ros.messages.poses_and_velocities import (
    decode_imu,
    decode_odometry_pose,
)
from slam_observer_ros.nodes.intake.estimator_feed import EstimatorFeed
from slam_observer_ros.nodes.intake.input_topic import InputTopic
from slam_observer_ros.nodes.intake.warning_decoders import (
    CloudDecoder,
    OdometryDecoder,
    TagDecoder,
)
from slam_observer_ros.nodes.message_classes import is_installed, message_class
from slam_observer_ros.settings.input_settings import AUTO, ON_TF, POSE_DIFFERENCES
from slam_observer_ros.settings.node_settings import ObserverNodeSettings

ValueT = TypeVar('ValueT')


def open_inputs(
    node: Node, settings: ObserverNodeSettings, feed: EstimatorFeed
) -> list[InputTopic[Any]]:
    """Subscribe to what the parameters name; ParameterError if a type's package is missing."""
    velocity = _velocity_input(node, settings, feed)
    landmarks = _landmark_input(node, settings, feed)
    imu: list[InputTopic[Any]] = []
    if settings.use_imu:
        qos = _qos(settings.twist_qos, settings.queue_depth)
        imu.append(InputTopic(node, 'imu', {IMU: decode_imu}, partial(feed.add, 'imu'), qos))
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
        decoders: dict[str, Any] = {ODOMETRY: decode_odometry_pose}
    else:
        decoders = _chosen(
            VELOCITY_DECODERS | {ODOMETRY: OdometryDecoder(node, not settings.use_imu)},
            settings.velocity_type,
        )
    return InputTopic(node, 'twist', decoders, partial(feed.add, 'twist'), qos)


def _landmark_input(
    node: Node, settings: ObserverNodeSettings, feed: EstimatorFeed
) -> InputTopic[Any]:
    name = 'landmarks'
    take: Callable[[Any, int], None] = feed.add_observation
    decoders: dict[str, Any]
    if settings.landmarks_type == ON_TF:
        name, take = '/tf', feed.add_observations
        decoders = {TRANSFORMS: TagDecoder(node, settings.tag_frame_prefix)}
    else:
        decoders = _chosen(_landmark_decoders(node), settings.landmarks_type)
        if not any(map(is_installed, decoders)):
            message_class(next(iter(decoders)))  # raises, and says what to install
    qos = _qos(settings.landmarks_qos, settings.queue_depth)
    topic = InputTopic(node, name, decoders, take, qos, settings.landmarks_max_wait)
    topic.is_shared = True
    topic.advice = {
        message_type: f'landmarks_type: {message_type.rsplit("/", 1)[-1]}'
        for message_type in (APRILTAGS, *DETECTION_DECODERS, *CLOUD_DECODERS)
    }
    return topic


def _landmark_decoders(node: Node) -> dict[str, Any]:
    clouds = {message_type: CloudDecoder(node, message_type) for message_type in CLOUD_DECODERS}
    return clouds | {APRILTAGS: decode_apriltags} | DETECTION_DECODERS


def _chosen(decoders: Mapping[str, ValueT], type_choice: str) -> dict[str, ValueT]:
    """Return the decoders of a short type name, or all of them."""
    return {
        name: decoder
        for name, decoder in decoders.items()
        if type_choice in (AUTO, name.rsplit('/', 1)[-1])
    }


def _qos(reliability: str, depth: int) -> QoSProfile:
    return QoSProfile(
        reliability=ReliabilityPolicy[reliability.upper()],
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
    )
