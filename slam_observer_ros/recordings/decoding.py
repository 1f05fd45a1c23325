"""Which decoder reads a recorded message, by its topic and what is wanted of it.

And by how the recording defines its messages: packages change, and keep the names.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from typing import Any, TYPE_CHECKING, TypeAlias

import numpy as np

from slam_observer_ros.common.errors import MessageError, RecordingError
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.messages.cdr import Buffer
from slam_observer_ros.messages.clouds import scan_problem
from slam_observer_ros.messages.detections import (
    decode_detections,
    DETECTIONS,
    observed_tags,
    OTHER_DETECTIONS,
)
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
from slam_observer_ros.recordings.event_builder import Measured
from slam_observer_ros.recordings.opening import types_in
from slam_observer_ros.recordings.sources import RawBlock, RawMessage, Topic
from slam_observer_ros.recordings.topics import SelectedTopics
from slam_observer_ros.settings.node_settings import (
    InputSettings,
    message_types,
    POSE_DIFFERENCES,
)

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

Decode: TypeAlias = Callable[[RawMessage], Sequence[Measured]]
"""From a message to what it measures.

Raises :class:`MessageError` if it is malformed, :class:`RecordingError` if it is a lidar's scan.
"""


def input_decoders(selected: SelectedTopics, inputs: InputSettings) -> dict[Topic, Decode]:
    """Return how each of the estimator's topics is decoded."""
    velocity, landmarks = selected.velocity, selected.landmarks
    decoded: dict[Topic, Decode] = {landmarks: _landmarks}
    if landmarks.message_type == TRANSFORMS:
        prefix = inputs.tag_frame_prefix
        decoded[landmarks] = lambda raw: observed_tags(decode_transforms(raw.data), prefix)
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
    if problem := scan_problem(event):
        raise RecordingError(f'{raw.topic}: {problem}')
    return [event]


@cache
def landmark_decoder(message_type: str, definition: str) -> DecodeOne[ObservationEvent]:
    """Return what decodes landmarks of a type, as a recording defines it.

    Raises a RecordingError if it has other fields there than are known.
    """
    known = message_types('landmarks')[message_type]
    defined = types_in(definition, message_type)
    if message_type == DETECTIONS:
        return _decoder_of_detections(defined)
    if known.definition and message_type in defined:
        read = types_in(known.definition, message_type)
        right, there = _typestore(read), _typestore(read | defined)
        changed = [
            name
            for name in defined
            if name in read and _layout(right, name) != _layout(there, name)
        ]
        if changed:
            raise _other_release(changed)
    return decoders('landmarks')[message_type]


def _other_release(changed: Sequence[str]) -> RecordingError:
    names = ', '.join(name.rpartition('/')[2] for name in changed)
    package = changed[0].partition('/')[0]
    return RecordingError(
        f'{names} of {package} has other fields in this recording than in the releases that are '
        'read; record it with another one, or leave the topic out'
    )


def _decoder_of_detections(defined: dict[str, Any]) -> DecodeOne[ObservationEvent]:
    detection = defined.get('vision_msgs/msg/Detection3D')
    if detection is None:
        return _of_galactic_or_foxy
    names = tuple(name for name, _ in detection[1])
    if names[:3] == ('header', 'results', 'bbox'):
        if names[3:] == ('id',):
            return decode_detections
        if names[3:] in OTHER_DETECTIONS:
            return partial(_named, *OTHER_DETECTIONS[names[3:]])
    raise _other_release(['vision_msgs/msg/Detection3D'])


def _of_galactic_or_foxy(raw: Buffer, receive_ns: int) -> ObservationEvent:
    """Decode detections of a recording that does not say how: Foxy's never do."""
    try:
        return decode_detections(raw, receive_ns)
    except MessageError:
        with suppress(MessageError):
            return next(iter(OTHER_DETECTIONS.values()))[1](raw, receive_ns)
        raise


def _named(
    release: str, decode: DecodeOne[ObservationEvent], raw: Buffer, receive_ns: int
) -> ObservationEvent:
    try:
        return decode(raw, receive_ns)
    except MessageError as error:
        raise MessageError(f'{error} (fields as in vision_msgs of {release})') from error


def _typestore(defined: dict[str, Any]) -> Typestore:
    """Return the common types, and others that are defined."""
    from rosbags.typesys import get_typestore, Stores

    store = get_typestore(Stores.ROS2_JAZZY)
    store.register({name: what for name, what in defined.items() if name not in store.types})
    return store


def _layout(store: Typestore, message_type: str) -> tuple[object, ...]:
    """Return the types of all bytes, whatever the names of fields."""

    def of(described: Any) -> object:
        kind, what = described
        if isinstance(what, str):
            return _layout(store, what) if what in store.fielddefs else what
        return kind.name, of(what[0]) if isinstance(what[0], tuple) else what[0], what[1]

    return tuple(of(described) for _, described in store.fielddefs[message_type][1])
