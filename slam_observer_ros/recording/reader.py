"""Recordings as events for the estimator, and as truth to compare its estimate with."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
import logging
from pathlib import Path
from types import TracebackType
from typing import TypeVar

import numpy as np

from slam_observer_ros.errors import MessageError, RecordingError, TransformError
from slam_observer_ros.events import Event, LandmarkTruth, UNKNOWN_ID
from slam_observer_ros.recording.detections import observed_tags
from slam_observer_ros.recording.frames import event_in_frame, insert_transforms
from slam_observer_ros.recording.messages import (
    decode_transforms,
    LANDMARK_DECODERS,
    POSE_DECODERS,
    pose_matrices,
    PoseMessage,
    VELOCITY_DECODERS,
    VelocityMessage,
)
from slam_observer_ros.recording.point_clouds import has_ids, ObservationMessage
from slam_observer_ros.recording.sources import open_source, RawMessage, Topic
from slam_observer_ros.recording.topics import (
    select_topics,
    SelectedTopics,
    TopicNames,
    TRANSFORMS_TYPE,
)
from slam_observer_ros.transform_buffer import TransformBuffer
from slam_observer_ros.types import FloatArray, IntArray

TAG_FRAME_PREFIX = 'tag_'
"""What a fiducial's frame is called before its id; ``family:id`` is known, too."""

_NANOSECOND = 1e-9
_logger = logging.getLogger(__name__)
_Decoded = TypeVar('_Decoded')


@dataclass(frozen=True, slots=True)
class Truth:
    """What the estimate is compared with, in the axes of the recording's world frame.

    Attributes
    ----------
    stamps_ns : IntArray
        (k,) strictly increasing stamps of the true poses, nanoseconds.
    poses : FloatArray
        (k, 4, 4) true poses, body to world; k is 0 if the recording has none.
    landmarks : LandmarkTruth or None
        True landmark positions; None if the recording has none.

    """

    stamps_ns: IntArray
    poses: FloatArray
    landmarks: LandmarkTruth | None


class Recording:
    """An open recording; :func:`open_recording` makes one. Close it, or use it in ``with``.

    Attributes
    ----------
    path : Path
        The file or directory.
    topics : tuple of Topic
        All topics, with types and message counts.
    warning : str or None
        Why only a part of the recording can be read; None if it is whole.
    malformed : Counter
        Messages that could not be decoded so far, by topic; the first of each is logged.

    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._source, self.warning = open_source(path)
        self.topics = self._source.topics
        self.malformed: Counter[str] = Counter()
        if self.message_count == 0:
            self.close()
            raise RecordingError(f'{path}: the recording is empty')

    def __enter__(self) -> Recording:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._source.close()

    @property
    def message_count(self) -> int:
        """Number of messages on all topics."""
        return sum(topic.count for topic in self.topics)

    @property
    def duration_s(self) -> float:
        """Seconds from the first message to the last, by receive time."""
        return (self._source.end_ns - self._source.start_ns) * _NANOSECOND

    def find_topics(self, names: TopicNames | None = None) -> SelectedTopics:
        """Pick the velocity, landmark and truth topics.

        Parameters
        ----------
        names : TopicNames or None
            What the user chose; the rest is found by message type and name.

        Raises
        ------
        RecordingError
            If no topic fits, or two do; it lists them, and names the option that decides.

        """
        return select_topics(self.topics, names or TopicNames(), self._identifies)

    def event_count(self, selected: SelectedTopics) -> int:
        """Count the messages that :meth:`events` reads, for a progress bar."""
        return selected.velocity.count + selected.landmarks.count

    def events(
        self,
        selected: SelectedTopics,
        base_frame: str = '',
        tag_frame_prefix: str = TAG_FRAME_PREFIX,
    ) -> Iterator[Event]:
        """Yield velocities and observations in the order in which they were received.

        Stamps are those of the messages' headers; an unstamped Twist has its receive time.
        Malformed messages are left out and counted in :attr:`malformed`. What is measured in
        other frames than the base's is brought into it where /tf_static connects the two.

        Parameters
        ----------
        selected : SelectedTopics
            From :meth:`find_topics`.
        base_frame : str
            Frame of the robot; empty to leave all as it was measured.
        tag_frame_prefix : str
            Where landmarks come from /tf: name of a fiducial's frame before its id.

        Raises
        ------
        RecordingError
            If the file turns out to be damaged.

        """
        transforms = self._static_transforms() if base_frame else TransformBuffer()
        for raw in self._source.messages((selected.velocity, selected.landmarks)):
            messages = self._decoded(raw, lambda raw: _decode_events(raw, tag_frame_prefix))
            for message in messages or ():
                yield event_in_frame(base_frame, message, transforms)

    def frames(
        self, selected: SelectedTopics, tag_frame_prefix: str = TAG_FRAME_PREFIX
    ) -> tuple[str, str]:
        """Give the frames of the first velocity and of the first observation.

        A frame is empty if the message names none, as a Twist.
        """
        velocity_frame = self._frame(selected.velocity, tag_frame_prefix)
        return velocity_frame, self._frame(selected.landmarks, tag_frame_prefix)

    def connects(self, frame: str, other_frame: str) -> bool:
        """Tell whether /tf_static says where one frame is in the other."""
        try:
            self._static_transforms().lookup(frame, other_frame, 0)
        except TransformError:
            return False
        return True

    def truth(self, selected: SelectedTopics) -> Truth:
        """Read the true poses and landmarks.

        Parameters
        ----------
        selected : SelectedTopics
            From :meth:`find_topics`.

        Raises
        ------
        RecordingError
            If the file turns out to be damaged.

        """
        stamps_ns, poses = self._true_poses(selected.pose_truth)
        return Truth(stamps_ns, poses, self._true_landmarks(selected.landmark_truth))

    def _decoded(
        self, raw: RawMessage, decode: Callable[[RawMessage], _Decoded]
    ) -> _Decoded | None:
        try:
            return decode(raw)
        except MessageError as error:
            if raw.topic.name not in self.malformed:
                _logger.warning('%s: malformed message on %s: %s', self.path, raw.topic, error)
            self.malformed[raw.topic.name] += 1
            return None

    def _first(self, topic: Topic, decode: Callable[[RawMessage], _Decoded]) -> _Decoded | None:
        """Decode the first message of a topic that isn't malformed."""
        for raw in self._source.messages((topic,)):
            with suppress(MessageError):
                return decode(raw)
        return None

    def _identifies(self, topic: Topic) -> bool:
        return self._first(topic, lambda raw: has_ids(raw.data, topic.message_type)) or False

    def _frame(self, topic: Topic, tag_frame_prefix: str) -> str:
        for raw in self._source.messages((topic,)):
            with suppress(MessageError):
                for message in _decode_events(raw, tag_frame_prefix):
                    return message.frame_id
        return ''

    def _static_transforms(self) -> TransformBuffer:
        buffer = TransformBuffer()
        topics = [
            topic
            for topic in self.topics
            if topic.message_type == TRANSFORMS_TYPE and topic.name.endswith('/tf_static')
        ]
        for raw in self._source.messages(topics):
            messages = self._decoded(raw, lambda raw: decode_transforms(raw.data))
            insert_transforms(buffer, messages or (), is_static=True)
        return buffer

    def _true_poses(self, topic: Topic | None) -> tuple[IntArray, FloatArray]:
        messages: list[PoseMessage] = []
        for raw in self._source.messages((topic,) if topic else ()):
            message = self._decoded(raw, _decode_pose)
            if message is not None:
                messages.append(message)
        stamps_ns, order = np.unique(
            np.array([message.stamp_ns for message in messages], dtype=np.int64),
            return_index=True,
        )
        positions = np.array([message.position for message in messages]).reshape(-1, 3)
        quaternions = np.array([message.quaternion for message in messages]).reshape(-1, 4)
        return stamps_ns, pose_matrices(positions[order], quaternions[order])

    def _true_landmarks(self, topic: Topic | None) -> LandmarkTruth | None:
        """Gather the last known position of each landmark."""
        positions: dict[int, FloatArray] = {}
        for raw in self._source.messages((topic,) if topic else ()):
            message = self._decoded(raw, _decode_observation)
            if message is not None:
                positions |= zip(message.event.ids.tolist(), message.event.points, strict=True)
        positions.pop(UNKNOWN_ID, None)
        if not positions:
            return None
        ids = np.array(sorted(positions), dtype=np.int64)
        return LandmarkTruth(ids, np.array([positions[landmark_id] for landmark_id in ids]))


def open_recording(path: Path | str) -> Recording:
    """Open an MCAP file, a rosbag2 (directory or bare .db3), or a ROS 1 .bag.

    A truncated MCAP file is read up to the damage; :attr:`Recording.warning` says so.

    Parameters
    ----------
    path : Path or str
        The file or directory.

    Raises
    ------
    RecordingError
        If there is nothing to read; one line that says what to do.

    """
    return Recording(Path(path))


def _decode_events(
    raw: RawMessage, tag_frame_prefix: str
) -> Sequence[VelocityMessage | ObservationMessage]:
    if raw.topic.message_type == TRANSFORMS_TYPE:
        return observed_tags(decode_transforms(raw.data), tag_frame_prefix)
    decoder = VELOCITY_DECODERS.get(raw.topic.message_type)
    if decoder is None:
        return [_decode_observation(raw)]
    return [decoder(raw.data, raw.receive_stamp_ns)]


def _decode_observation(raw: RawMessage) -> ObservationMessage:
    return LANDMARK_DECODERS[raw.topic.message_type](raw.data, raw.receive_stamp_ns)


def _decode_pose(raw: RawMessage) -> PoseMessage:
    return POSE_DECODERS[raw.topic.message_type](raw.data)
