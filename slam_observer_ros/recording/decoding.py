"""Which decoder reads a recorded message, by its topic and what is wanted of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TypeAlias

import numpy as np

from slam_observer_ros.common.errors import RecordingError
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.inputs.event_builder import Measured
from slam_observer_ros.messages.cdr import Buffer
from slam_observer_ros.messages.detections import decode_apriltags, observed_tags
from slam_observer_ros.messages.measurement import Measurement
from slam_observer_ros.messages.message_types import (
    APRILTAGS,
    CLOUD_DECODERS,
    DETECTION_DECODERS,
    POSE_DECODERS,
    TRANSFORMS,
    VELOCITY_DECODERS,
)
from slam_observer_ros.messages.point_clouds import scan_problem
from slam_observer_ros.messages.pose_blocks import decode_poses, PoseBlock
from slam_observer_ros.messages.poses_and_velocities import (
    decode_imu,
    decode_odometry_pose,
    decode_transforms,
    PoseMessage,
)
from slam_observer_ros.messages.velocity_blocks import BLOCK_DECODERS, BlockDecoder
from slam_observer_ros.recording.definitions import decoder_of_other_fields
from slam_observer_ros.recording.sources import RawBlock, RawMessage, Topic
from slam_observer_ros.recording.topics import SelectedTopics
from slam_observer_ros.settings.input_settings import InputSettings, POSE_DIFFERENCES

Decode: TypeAlias = Callable[[RawMessage], Sequence[Measured]]
"""From a message to what it measures.

Raises :class:`MessageError` if it is malformed, :class:`RecordingError` if it is a lidar's scan.
"""


_OBSERVATION_DECODERS = CLOUD_DECODERS | DETECTION_DECODERS


def input_decoders(selected: SelectedTopics, inputs: InputSettings) -> dict[Topic, Decode]:
    """Return how each of the estimator's topics is decoded."""
    decoders: dict[Topic, Decode] = {
        selected.velocity: _one(VELOCITY_DECODERS[selected.velocity.message_type]),
        selected.landmarks: _landmarks,
    }
    if inputs.velocity_source == POSE_DIFFERENCES:
        decoders[selected.velocity] = _one(decode_odometry_pose)
    if selected.landmarks.message_type == TRANSFORMS:
        decoders[selected.landmarks] = partial(_tags_on_tf, inputs.tag_frame_prefix)
    elif selected.landmarks.message_type == APRILTAGS:
        decoder_of_other_fields(APRILTAGS, selected.landmarks.definition)
        decoders[selected.landmarks] = _one(decode_apriltags)
    if selected.imu is not None:
        decoders[selected.imu] = _one(decode_imu)
    return decoders


def block_decoder(selected: SelectedTopics, inputs: InputSettings) -> BlockDecoder | None:
    """Return what decodes velocities in blocks; None if they come one by one."""
    if inputs.velocity_source == POSE_DIFFERENCES:
        return None
    return BLOCK_DECODERS.get(selected.velocity.message_type)


def decode_landmarks(raw: RawMessage) -> Measurement[ObservationEvent]:
    """Decode landmarks, measured or true."""
    topic = raw.topic
    decode = decoder_of_other_fields(topic.message_type, topic.definition)
    decode = decode or _OBSERVATION_DECODERS[topic.message_type]
    return decode(raw.data, raw.receive_stamp_ns)


def decode_pose(raw: RawMessage) -> PoseMessage:
    """Decode a pose; it has its receive time if its publisher left the stamp out."""
    message = POSE_DECODERS[raw.topic.message_type](raw.data)
    return replace(message, stamp_ns=message.stamp_ns or raw.receive_stamp_ns)


def decode_pose_block(raw: RawBlock) -> PoseBlock:
    """Decode poses as :func:`decode_pose` each of them.

    Raise :class:`MessageError` if one is malformed, or they do not have all in common.
    """
    block = decode_poses(raw.topic.message_type, raw.data)
    stamps_ns = np.where(block.stamps_ns == 0, raw.receive_stamps_ns, block.stamps_ns)
    return replace(block, stamps_ns=stamps_ns)


def decode_transform_message(raw: RawMessage) -> list[PoseMessage]:
    """Decode a message on /tf or /tf_static."""
    return decode_transforms(raw.data)


def _one(decode: Callable[[Buffer, int], Measured]) -> Decode:
    return lambda raw: [decode(raw.data, raw.receive_stamp_ns)]


def _landmarks(raw: RawMessage) -> list[Measurement[ObservationEvent]]:
    message = decode_landmarks(raw)
    problem = scan_problem(message.event)
    if problem:
        raise RecordingError(f'{raw.topic}: {problem}')
    return [message]


def _tags_on_tf(tag_frame_prefix: str, raw: RawMessage) -> list[Measurement[ObservationEvent]]:
    return observed_tags(decode_transforms(raw.data), tag_frame_prefix)
