"""Recordings as events for the estimator, and as truth to compare its estimate with."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
import dataclasses
import logging
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from slam_observer_ros.common.errors import MessageError, RecordingError, TransformError
from slam_observer_ros.common.findings import found
from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import Event, VelocityBlock
from slam_observer_ros.lie import se3
from slam_observer_ros.messages.detections import decode_camera_info
from slam_observer_ros.messages.poses import PoseBlock
from slam_observer_ros.messages.registry import BlockDecoder
from slam_observer_ros.recordings.contents import Arrivals, Contents
from slam_observer_ros.recordings.event_builder import (
    drop_reason,
    DropError,
    EventBuilder,
    with_receive_time,
)
from slam_observer_ros.recordings.frames import BaseFrame, insert_transforms, TransformBuffer
from slam_observer_ros.recordings.opening import open_source
from slam_observer_ros.recordings.sources import FEWEST_IN_BLOCK, Loss, RawBlock, RawMessage, Topic
from slam_observer_ros.recordings.topics import (
    block_decoder,
    Decode,
    decode_landmarks,
    decode_pose,
    decode_pose_block,
    decode_transform_message,
    input_decoders,
    select_topics,
    SelectedTopics,
    TopicNames,
    transform_topics,
    TransformTopics,
)
from slam_observer_ros.recordings.trajectory import base_in_frames, other_frames, Trajectory, Truth
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import InputSettings

if TYPE_CHECKING:
    from slam_observer_ros.recordings.writer import RecordingWriter

logger = logging.getLogger(__name__)
_Decoded = TypeVar('_Decoded')


@dataclasses.dataclass(frozen=True, slots=True)
class _Reading:
    """How the messages of a recording become events."""

    transforms: TransformBuffer
    builder: EventBuilder
    decoders: dict[Topic, Decode]
    decode_block: BlockDecoder | None
    simulated: set[Topic]  # of a clock that begins at zero
    moving: Sequence[Topic]  # of transforms


class Recording:
    """An open MCAP file, rosbag2 (directory or bare .db3) or ROS 1 .bag: use it in ``with``.

    Of a damaged MCAP file, what is whole is read. Raises a RecordingError that says in one line
    what to do if there is nothing to read, also later if another file turns out to be damaged.

    Attributes
    ----------
    warning : str or None
        Why only a part of the recording can be read; None if it is whole.
    malformed, unstamped : Counter
        Messages that could not be decoded, and measurements without stamp, so far, by topic.
    dropped : Counter
        Measurements that did not become events so far, by reason.
    arrivals : dict of str to Arrivals
        When the measurements of the last :meth:`events` were received, by topic.
    contents : Contents
        What is known of its messages before they are used.

    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._source, self.warning = open_source(self.path)
        self.topics = self._source.topics
        self.contents = Contents(self._source)
        self.malformed: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self.unstamped: Counter[str] = Counter()
        self.arrivals: dict[str, Arrivals] = {}
        if self.message_count == 0:
            self.close()
            raise RecordingError(f'{path}: the recording is empty')

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._source.close()

    @property
    def loss(self) -> Loss:
        """What has been found damaged so far."""
        return self._source.loss

    @property
    def message_count(self) -> int:
        """Number of messages on all topics."""
        return sum(topic.count for topic in self.topics)

    @property
    def duration_s(self) -> float:
        """Seconds from the first message to the last, by receive time."""
        return to_s(self._source.end_ns - self._source.start_ns)

    @property
    def end_s(self) -> float:
        """When the last message was received, seconds."""
        return to_s(self._source.end_ns)

    def find_topics(
        self, names: TopicNames = TopicNames(), inputs: InputSettings = InputSettings()
    ) -> SelectedTopics:
        """Pick the topics of velocities, landmarks and truth, and an Imu's if it is used.

        What the user doesn't name is found by message type and name; see :func:`select_topics`.
        """
        contents = self.contents
        return select_topics(self.topics, names, inputs, contents.has_ids, contents.pose_frame)

    def event_count(self, selected: SelectedTopics) -> int:
        """Count the messages that :meth:`events` makes events of, for a progress bar."""
        return sum(topic.count for topic in selected.inputs)

    def events(
        self,
        selected: SelectedTopics,
        inputs: InputSettings = InputSettings(),
        velocity_timeout_s: float = Settings.velocity_timeout,
    ) -> Iterator[Event]:
        """Yield the events of :meth:`blocks` one by one."""
        for item in self.blocks(selected, inputs, velocity_timeout_s):
            if isinstance(item, VelocityBlock):
                yield from item.events()
            else:
                yield item

    def blocks(
        self,
        selected: SelectedTopics,
        inputs: InputSettings = InputSettings(),
        velocity_timeout_s: float = Settings.velocity_timeout,
    ) -> Iterator[Event | VelocityBlock]:
        """Yield velocities and observations in the base frame, as the live node makes them.

        Where velocities follow each other they come in blocks, which are cheaper to handle.
        They come in the order in which they were received; what waits for a transform on /tf
        comes when that has been received, or is dropped after the timeout. Stamps are in
        the messages' headers; an unstamped Twist has its receive time, and so has what leaves its
        stamp zero, which is counted in :attr:`unstamped`. Malformed messages are left out and
        counted in :attr:`malformed`, what was dropped in :attr:`dropped`; the first is logged.
        """
        transforms = self._static_transforms(selected.transforms, selected.cameras)
        base_frame = BaseFrame(inputs, transforms)
        if selected.cameras and self.contents.missing_tags(selected, inputs.tag_frame_prefix):
            base_frame.expect_no_poses()
        builder = EventBuilder(
            base_frame, inputs.transform_timeout, velocity_timeout_s, self._drop
        )
        decoders = input_decoders(selected, inputs)
        simulated = {
            topic for topic in decoders if self.contents.begins_at_zero(topic, decoders[topic])
        }
        self.arrivals = {topic.name: Arrivals(velocity_timeout_s) for topic in decoders}
        decode_block, moving = block_decoder(selected, inputs), selected.transforms.moving
        reading = _Reading(transforms, builder, decoders, decode_block, simulated, moving)
        for raw in self._source.blocks((*decoders, *moving), selected.velocity):
            if isinstance(raw, RawBlock) and (block := _velocities_of(raw, reading)) is not None:
                self.arrivals[raw.topic.name].add_all(raw.receive_stamps_ns, block.stamps_ns)
                yield block
                continue
            for message in raw.messages():
                yield from self._events_of(message, reading)
        yield from builder.retry(None)

    def _events_of(self, raw: RawMessage, reading: _Reading) -> Iterator[Event]:
        if raw.topic in reading.moving:
            self._insert(reading.transforms, raw, is_static=False)
        # What waited for a transform, then what has just come
        events = reading.builder.retry(raw.receive_stamp_ns)
        if raw.topic in reading.decoders:
            receive_ns = 0 if raw.topic in reading.simulated else raw.receive_stamp_ns
            for measured in self._decoded(raw, reading.decoders[raw.topic]) or ():
                timed = with_receive_time(measured, receive_ns)
                if timed is not measured:
                    self.unstamped[raw.topic.name] += 1
                self.arrivals[raw.topic.name].add(raw.receive_stamp_ns, timed.stamp_ns)
                events += reading.builder.add(timed, raw.receive_stamp_ns)
        for event in events:
            yield dataclasses.replace(event, receive_ns=raw.receive_stamp_ns)

    def copy_to(self, writer: RecordingWriter, selected: SelectedTopics) -> list[Topic]:
        """Write what was read, as it was received; return topics left out, of unknown types."""
        optional = (selected.pose_truth, selected.landmark_truth)
        topics = [
            *selected.inputs,
            *selected.transforms.static,
            *selected.transforms.moving,
            *selected.cameras,
            *(topic for topic in optional if topic is not None),
        ]
        return self._copy(writer, selected, topics)

    def copy_static_to(self, writer: RecordingWriter, selected: SelectedTopics) -> None:
        """Write the poses of sensors that were read, as they were received."""
        self._copy(writer, selected, selected.transforms.static)

    def _copy(
        self, writer: RecordingWriter, selected: SelectedTopics, topics: Sequence[Topic]
    ) -> list[Topic]:
        known = [topic for topic in topics if writer.knows(topic.message_type)]
        latched = (*selected.transforms.static, selected.landmark_truth)
        for raw in self._source.messages(known):
            topic = raw.topic
            writer.write(
                topic.name, topic.message_type, raw.data, raw.receive_stamp_ns, topic in latched
            )
        return [topic for topic in topics if topic not in known]

    def truth(self, selected: SelectedTopics, base_frame: str = '') -> Truth:
        """Read the true landmarks, and the true poses of the base frame.

        Poses of another frame are moved to it by /tf_static, or left as they are, with a warning.
        """
        topics = selected.pose_truth, selected.landmark_truth
        return self._truth(*topics, selected.transforms, base_frame)

    def trajectory(self, topic: Topic, base_frame: str = '') -> Trajectory:
        """Read the poses of a topic, as :meth:`truth` has them.

        A RecordingError says if there is none.
        """
        transforms = transform_topics(self.topics, (topic,))
        truth = self._truth(topic, None, transforms, base_frame)
        if not len(truth.stamps_ns):
            raise RecordingError(f'{self.path}: no message of {topic.name} has a pose')
        return Trajectory(truth.stamps_ns, truth.poses)

    def _truth(
        self,
        pose_topic: Topic | None,
        landmark_topic: Topic | None,
        transforms: TransformTopics,
        base_frame: str,
    ) -> Truth:
        poses = list(self._true_poses(pose_topic))
        base_in: dict[str, FloatArray] = {}
        if frames := other_frames(base_frame, poses):
            base_in = base_in_frames(frames, base_frame, self._static_transforms(transforms))
        landmarks = self._all_decoded(landmark_topic, decode_landmarks)
        return Truth.from_messages(poses, base_in, landmarks)

    def sensor_pose(
        self, selected: SelectedTopics, inputs: InputSettings, frame: str
    ) -> FloatArray | None:
        """Return the pose (4, 4) of the landmarks' sensor in the base frame; None if it moves.

        ``frame`` is the sensor's, '' for the base frame itself.
        """
        if any(inputs.sensor_pose):
            return se3.from_rpy(inputs.sensor_pose)
        if frame in ('', inputs.base_frame):
            return np.eye(4)
        try:
            return self._static_transforms(selected.transforms).lookup(inputs.base_frame, frame, 0)
        except TransformError:
            return None

    def _true_poses(self, topic: Topic | None) -> Iterator[PoseBlock]:
        for raw in self._source.blocks((topic,), topic) if topic else ():
            if isinstance(raw, RawBlock):
                try:
                    yield decode_pose_block(raw)
                    continue
                except MessageError:  # one of them needs a look for itself
                    pass
            for message in raw.messages():
                pose = self._decoded(message, decode_pose)
                if pose is not None:
                    yield PoseBlock.of(pose)

    def _static_transforms(
        self, topics: TransformTopics, cameras: Sequence[Topic] = ()
    ) -> TransformBuffer:
        transforms = TransformBuffer()
        for raw in self._source.messages(topics.static):
            self._insert(transforms, raw, is_static=True)
        for topic in cameras:
            first = next(self._all_decoded(topic, lambda raw: decode_camera_info(raw.data)), None)
            if first is not None:
                frame, camera = first
                transforms.cameras.setdefault(frame.lstrip('/'), camera)
        return transforms

    def _decoded(
        self, raw: RawMessage, decode: Callable[[RawMessage], _Decoded]
    ) -> _Decoded | None:
        try:
            return decode(raw)
        except MessageError as error:
            if raw.topic.name not in self.malformed:
                topic = f'{raw.topic.name} of {self.path}'
                logger.warning('%s', found('malformed_message', topic=topic, error=error))
            self.malformed[raw.topic.name] += 1
            return None

    def _all_decoded(
        self, topic: Topic | None, decode: Callable[[RawMessage], _Decoded]
    ) -> Iterator[_Decoded]:
        for raw in self._source.messages((topic,) if topic else ()):
            message = self._decoded(raw, decode)
            if message is not None:
                yield message

    def _insert(self, transforms: TransformBuffer, raw: RawMessage, *, is_static: bool) -> None:
        messages = self._decoded(raw, decode_transform_message)
        insert_transforms(transforms, messages or (), is_static=is_static)

    def _drop(self, error: DropError) -> None:
        reason = drop_reason(error)
        if not self.dropped[reason]:
            logger.warning('%s', found('dropped_message', reason=reason, error=error))
        self.dropped[reason] += 1


def _velocities_of(raw: RawBlock, reading: _Reading) -> VelocityBlock | None:
    """Return the velocities of messages; None if one of them needs a look for itself."""
    if reading.decode_block is None or len(raw.data) < FEWEST_IN_BLOCK:
        return None
    try:
        velocities = reading.decode_block(raw.data, raw.receive_stamps_ns)
    except MessageError:
        return None
    has_stamps = raw.topic in reading.simulated or velocities.stamps_ns.all()
    return (
        velocities if has_stamps and reading.builder.passes_on(velocities.sensor_frame) else None
    )
