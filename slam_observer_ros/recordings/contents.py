"""What the messages of a recording hold, before any is used, and when they were received."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
import dataclasses
from itertools import islice, pairwise
from typing import TypeVar

import numpy as np

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.common.stamps import is_of_1970, to_ns, to_s
from slam_observer_ros.common.types import IntArray
from slam_observer_ros.events import AngularVelocityEvent, VelocityEvent
from slam_observer_ros.messages.clouds import CLOUDS, ID_NAME, missing_ids, read_fields
from slam_observer_ros.messages.detections import APRILTAGS, no_tags, observed_tags, POSE_ARRAY
from slam_observer_ros.messages.poses import decode_odometry, ODOMETRY, TRANSFORMS
from slam_observer_ros.recordings.event_builder import OdometryCheck
from slam_observer_ros.recordings.sources import MessageSource, RawMessage, Topic
from slam_observer_ros.recordings.topics import (
    Decode,
    decode_pose,
    decode_transform_message,
    input_decoders,
    SelectedTopics,
)
from slam_observer_ros.settings.node_settings import InputSettings

MAX_EMPTY_CLOUDS = 1000
"""Most clouds of a topic that are looked at for one with points, which shows the ids."""

MAX_COMPARED = 5000  # most messages of an odometry whose twist is compared with its pose

MAX_CHANGES = 10
"""Changes of the frame of velocities up to which a driver may have been started again."""

MAX_BACK = 0.1  # share of the stamps that may be before the last one's
FEWEST_COMPARED = 100  # messages without which nothing is said of who published them

_Decoded = TypeVar('_Decoded')


class Contents:
    """Frames, ids and clocks of an open recording, from as few of its messages as show them.

    Malformed messages are passed over.
    """

    def __init__(self, source: MessageSource) -> None:
        self._source = source

    def frames(
        self, selected: SelectedTopics, inputs: InputSettings = InputSettings()
    ) -> tuple[str, str]:
        """Return the frames of the first velocity and of the first observation.

        A frame is empty if the message names none, as a Twist.
        """
        decoders = input_decoders(selected, dataclasses.replace(inputs, velocity_source='twist'))
        velocity_frame = self._frame(selected.velocity, decoders[selected.velocity])
        return velocity_frame, self._frame(selected.landmarks, decoders[selected.landmarks])

    def pose_frame(self, odometry: Topic) -> str:
        """Return the frame that the poses of an odometry are in."""
        return self._frame(odometry, lambda raw: [decode_pose(raw)]).lstrip('/')

    def has_parent_of(self, frame: str, topics: Sequence[Topic]) -> bool:
        """Return whether a transform on some topics places a frame in another one."""
        return any(child == frame for _, child in self._transforms(topics))

    def has_transform_of(self, frame: str, selected: SelectedTopics) -> bool:
        """Return whether a transform on /tf_static or /tf is from or to a frame."""
        topics = (*selected.transforms.static, *selected.transforms.moving)
        return any(frame in ends for ends in self._transforms(topics))

    def _transforms(self, topics: Sequence[Topic]) -> Iterator[tuple[str, str]]:
        """Yield parent and child of each transform."""
        for message in self._decoded(topics, decode_transform_message):
            for transform in message:
                yield transform.frame_id.lstrip('/'), transform.child_frame_id.lstrip('/')

    def has_ids(self, cloud: Topic) -> bool:
        """Return whether the points of a PointCloud or PointCloud2 have ids."""
        return ID_NAME in self._field_names(cloud)

    def missing_ids(self, topic: Topic) -> str:
        """Return what a landmark topic's points have in place of ids; empty if they have ids."""
        if topic.message_type == POSE_ARRAY:
            return 'without ids'
        if topic.message_type not in CLOUDS:
            return ''
        return missing_ids(self._field_names(topic), topic.message_type)

    def missing_tags(self, selected: SelectedTopics, tag_frame_prefix: str) -> str:
        """Return why no frame on /tf is a fiducial's; empty if one is, or none is wanted."""
        topics: dict[str, Sequence[Topic]] = {
            TRANSFORMS: (selected.landmarks,),
            APRILTAGS: selected.transforms.moving,
        }
        if selected.landmarks.message_type not in topics:
            return ''
        frames: set[str] = set()
        of_tags = topics[selected.landmarks.message_type]
        for transforms in self._decoded(of_tags, decode_transform_message):
            if observed_tags(transforms, tag_frame_prefix):
                return ''
            frames |= {transform.child_frame_id for transform in transforms}
        if not frames:
            return 'fiducials are where /tf has them, which was not recorded'
        return no_tags(tag_frame_prefix, frames)

    def poses_move(self, topic: Topic) -> bool:
        """Return whether a topic holds an odometry's poses, and they are not all the same."""
        if topic.message_type != ODOMETRY:
            return False
        poses = (message.pose for message in self._decoded((topic,), decode_pose))
        return any(not np.array_equal(pose, after) for pose, after in pairwise(poses))

    def twist_problem(self, topic: Topic, uses_turn: bool) -> str:
        """Return what an odometry's twist is, if it is not how its poses move; else empty."""
        check = OdometryCheck(uses_turn)
        if topic.message_type == ODOMETRY:
            decoded = self._decoded((topic,), lambda raw: decode_odometry(raw.data))
            for pose, measured in islice(decoded, MAX_COMPARED):
                check.add(pose, measured)
                if check.is_decided:
                    break
        return check.problem

    def signs_of_rivals(self, topic: Topic, decode: Decode) -> str:
        """Return what shows that two publish velocities on one topic; empty if nothing does.

        A recording does not say who published. But what one publishes is of one frame, and its
        stamps increase; nor is every second message its own, in velocity and in time.
        """
        first = islice(self._decoded((topic,), decode), MAX_COMPARED)
        measured = [
            (
                each.stamp_ns,
                each.body_velocity if isinstance(each, VelocityEvent) else each.angular_velocity,
                each.sensor_frame,
            )
            for events in first
            for each in events
            if isinstance(each, VelocityEvent | AngularVelocityEvent)
        ]
        if len(measured) < FEWEST_COMPARED:
            return ''
        frames = [frame for *_, frame in measured]
        if sum(frame != after for frame, after in pairwise(frames)) > MAX_CHANGES:
            return f'of the frames {", ".join(sorted(set(frames)))}'
        stamps_ns = np.array([stamp_ns for stamp_ns, *_ in measured])
        if np.mean(np.diff(stamps_ns) < 0) > MAX_BACK:
            return 'their stamps go back and forth'
        # In a simulation both have the same stamp, and come in any order.
        speeds = np.array([each for _, each, _ in measured])
        order = np.lexsort((np.linalg.norm(speeds, axis=1), stamps_ns))
        V, steps_ns = speeds[order], np.diff(stamps_ns[order])
        next_V, second_V = (float(((V[k:] - V[:-k]) ** 2).sum()) for k in (1, 2))
        next_ns, second_ns = (np.median(np.abs(steps_ns[k:] - steps_ns[:-k])) for k in (1, 2))
        if second_V < next_V / 2.0 and second_ns < next_ns / 2.0:
            return 'every second message is of another velocity than those between'
        return ''

    def begins_at_zero(self, topic: Topic, decode: Decode) -> bool:
        """Return whether the stamps are of a simulated clock, which begins at zero."""
        has_begun = False
        for raw in self._source.messages((topic,)):
            with suppress(MessageError):
                for measured in decode(raw):
                    if has_begun:
                        # Else the first message alone has no stamp, as before a clock is set.
                        return 0 < measured.stamp_ns < raw.receive_stamp_ns // 2
                    if measured.stamp_ns:
                        return False
                    has_begun = True
        return False

    def _field_names(self, cloud: Topic) -> tuple[str, ...]:
        names: tuple[str, ...] = ()
        for raw in islice(self._source.messages((cloud,)), MAX_EMPTY_CLOUDS):
            with suppress(MessageError):  # Empty clouds often come without any fields.
                names, points = read_fields(raw.data, cloud.message_type)
                if ID_NAME in names or points:
                    break
        return names

    def _frame(self, topic: Topic, decode: Decode) -> str:
        for measured in self._decoded((topic,), decode):
            for first in measured:
                return first.sensor_frame
        return ''

    def _decoded(
        self, topics: Collection[Topic], decode: Callable[[RawMessage], _Decoded]
    ) -> Iterator[_Decoded]:
        for raw in self._source.messages(topics):
            with suppress(MessageError):
                yield decode(raw)


MOST_SAMPLES = 8192
"""How many delays are kept; then every second one is left out, of those to come as well."""


class Arrivals:
    """When the measurements of a topic came, in memory that does not grow with their number.

    Attributes
    ----------
    first_s, last_s : float
        When the first and the last so far were received, seconds.

    """

    def __init__(self, timeout_s: float) -> None:
        self.first_s = self.last_s = 0.0
        self._timeout_s = timeout_s
        self._silence_s = 0.0
        self._count = 0
        self._every = 1
        self._received_s = array('d')
        self._delays_s = array('d')

    def __len__(self) -> int:
        """Return how many measurements there were."""
        return self._count

    def add(self, received_ns: int, stamp_ns: int) -> None:
        """Note when a measurement was received and what stamp it has, nanoseconds."""
        received_s = to_s(received_ns)
        if self._count:
            self._silence_s += max(received_s - self.last_s - self._timeout_s, 0.0)
        else:
            self.first_s = received_s
        if self._count % self._every == 0:
            self._received_s.append(received_s)
            self._delays_s.append(to_s(received_ns - stamp_ns))
        if len(self._received_s) > MOST_SAMPLES:
            del self._received_s[1::2], self._delays_s[1::2]
            self._every *= 2
        self.last_s = received_s
        self._count += 1

    def add_all(self, received_ns: IntArray, stamps_ns: IntArray) -> None:
        """Note the same of several measurements (k,)."""
        # Integers of Python, as NumPy's lose digits on their way to a quotient.
        received_s = np.array([to_s(received) for received in received_ns.tolist()])
        if not self._count:
            self.first_s = self.last_s = float(received_s[0])
        pauses_s = np.diff(received_s, prepend=self.last_s) - self._timeout_s
        self._silence_s += float(np.maximum(pauses_s, 0.0).sum())
        numbers = self._count + np.arange(len(received_s))
        kept = numbers % self._every == 0
        self._received_s.extend(received_s[kept].tolist())
        self._delays_s.extend(map(to_s, (received_ns - stamps_ns)[kept].tolist()))
        while len(self._received_s) > MOST_SAMPLES:
            del self._received_s[1::2], self._delays_s[1::2]
            self._every *= 2
        self.last_s = float(received_s[-1])
        self._count += len(received_s)

    def silence_s(self, start_s: float, end_s: float) -> float:
        """Return for how long nothing was known, as each measurement holds until the timeout."""
        before_s = max(self.first_s - start_s - self._timeout_s, 0.0)
        after_s = max(end_s - self.last_s - self._timeout_s, 0.0)
        return before_s + self._silence_s + after_s

    @property
    def ahead_s(self) -> float:
        """How far the stamps are ahead of when they were received, seconds, in the median."""
        return -float(np.median(self._delays_s)) if self._delays_s else 0.0

    @property
    def counts_from_start(self) -> bool:
        """Whether the stamps are of 1970, and the messages were not received then."""
        if not self._delays_s:
            return False
        received_s = self._received_s[0]
        stamp_s = received_s - float(np.median(self._delays_s))
        return is_of_1970(to_ns(stamp_s)) and not is_of_1970(to_ns(received_s))

    def behind_s(self, other: Arrivals) -> float:
        """Return how far the stamps are behind another topic's, seconds.

        That is the median, each compared with the other topic's at its time: a simulated clock
        that is slower than the recorder's is no offset. It is zero if they have no time in common.
        """
        others_s = np.interp(
            self._received_s, other._received_s, other._delays_s, left=np.nan, right=np.nan
        )
        differences_s = self._delays_s - others_s
        known_s = differences_s[np.isfinite(differences_s)]
        return float(np.median(known_s)) if len(known_s) else 0.0
