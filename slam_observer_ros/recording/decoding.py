"""Which decoder reads a recorded message, by its topic and what is wanted of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import TypeAlias

import numpy as np

from slam_observer_ros.common.errors import RecordingError
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.inputs.event_builder import Measured
from slam_observer_ros.messages.clouds import scan_problem
from slam_observer_ros.messages.detections import observed_tags
from slam_observer_ros.messages.poses import (
    decode_imu,
    decode_odometry_pose,
    decode_poses,
    decode_transforms,
    PoseBlock,
    PoseMessage,
    TRANSFORMS,
)
from slam_observer_ros.messages.registry import BlockDecoder, Decoder, decoders
from slam_observer_ros.messages.registry import Decode as DecodeOne
from slam_observer_ros.recording.definitions import landmark_decoder
from slam_observer_ros.recording.sources import RawBlock, RawMessage, Topic
from slam_observer_ros.recording.topics import SelectedTopics
from slam_observer_ros.settings.input_settings import InputSettings, POSE_DIFFERENCES

Decode: TypeAlias = Callable[[RawMessage], Sequence[Measured]]
"""From a message to what it measures.

Raises :class:`MessageError` if it is malformed, :class:`RecordingError` if it is a lidar's scan.
"""


def input_decoders(selected: SelectedTopics, inputs: InputSettings) -> dict[Topic, Decode]:
    """Return how each of the estimator's topics is decoded."""
    velocity, landmarks = selected.velocity, selected.landmarks
    decoded: dict[Topic, Decode] = {landmarks: _landmarks}
    if landmarks.message_type == TRANSFORMS:
        decoded[landmarks] = partial(_tags_on_tf, inputs.tag_frame_prefix)
    else:
        landmark_decoder(landmarks.message_type, landmarks.definition)  # raises, if none does
    if inputs.velocity_source == POSE_DIFFERENCES:
        decoded[velocity] = _one(decode_odometry_pose)
    else:
        decoded[velocity] = _one(decoders('velocity')[velocity.message_type])
    if selected.imu is not None:
        decoded[selected.imu] = _one(decode_imu)
    return decoded


def block_decoder(selected: SelectedTopics, inputs: InputSettings) -> BlockDecoder | None:
    """Return what decodes velocities in blocks; None if they come one by one."""
    if inputs.velocity_source == POSE_DIFFERENCES:
        return None
    return BlockDecoder(decoders('velocity')[selected.velocity.message_type])


def decode_landmarks(raw: RawMessage) -> ObservationEvent:
    """Decode landmarks, measured or true."""
    topic = raw.topic
    decode = landmark_decoder(topic.message_type, topic.definition)
    return decode(raw.data, raw.receive_stamp_ns)


def decode_pose(raw: RawMessage) -> PoseMessage:
    """Decode a pose; it has its receive time if its publisher left the stamp out."""
    message = _pose_decoder(raw.topic.message_type)(raw.data)
    return replace(message, stamp_ns=message.stamp_ns or raw.receive_stamp_ns)


def decode_pose_block(raw: RawBlock) -> PoseBlock:
    """Decode poses as :func:`decode_pose` each of them.

    Raise :class:`MessageError` if one is malformed, or they do not have all in common.
    """
    decode = _pose_decoder(raw.topic.message_type)
    block = decode_poses(decode, raw.data, raw.receive_stamps_ns)
    stamps_ns = np.where(block.stamps_ns == 0, raw.receive_stamps_ns, block.stamps_ns)
    return replace(block, stamps_ns=stamps_ns)


@cache
def _pose_decoder(message_type: str) -> Decoder[PoseMessage]:
    return decoders('pose')[message_type]


def decode_transform_message(raw: RawMessage) -> list[PoseMessage]:
    """Decode a message on /tf or /tf_static."""
    return decode_transforms(raw.data)


def _one(decode: DecodeOne[Measured]) -> Decode:
    return lambda raw: [decode(raw.data, raw.receive_stamp_ns)]


def _landmarks(raw: RawMessage) -> list[ObservationEvent]:
    event = decode_landmarks(raw)
    problem = scan_problem(event)
    if problem:
        raise RecordingError(f'{raw.topic}: {problem}')
    return [event]


def _tags_on_tf(tag_frame_prefix: str, raw: RawMessage) -> list[ObservationEvent]:
    return observed_tags(decode_transforms(raw.data), tag_frame_prefix)
