"""Choice of the topics that a replay needs, by message type first and by name where two fit.

And which decoder reads a message of these, by how the recording defines its type: packages change,
and keep the names.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
import logging
from os.path import commonpath
from typing import Any, TYPE_CHECKING, TypeAlias

import numpy as np

from slam_observer_ros.common.errors import MessageError, RecordingError
from slam_observer_ros.common.findings import found
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.messages.cdr import Buffer
from slam_observer_ros.messages.clouds import CLOUDS, scan_problem
from slam_observer_ros.messages.detections import (
    CAMERA_INFO,
    decode_detections,
    DETECTIONS,
    IN_IMAGES,
    observed_tags,
    OTHER_DETECTIONS,
)
from slam_observer_ros.messages.poses import (
    decode_imu,
    decode_odometry_pose,
    decode_poses,
    decode_transforms,
    ODOMETRY,
    PoseBlock,
    PoseMessage,
    TRANSFORMS,
)
from slam_observer_ros.messages.registry import BlockDecoder, Decoder, decoders
from slam_observer_ros.messages.registry import Decode as DecodeOne
from slam_observer_ros.recordings.event_builder import Measured
from slam_observer_ros.recordings.opening import types_in
from slam_observer_ros.recordings.sources import last_part, RawBlock, RawMessage, Topic
from slam_observer_ros.settings.node_settings import (
    AUTO,
    InputSettings,
    message_types,
    ON_TF,
    POSE_DIFFERENCES,
)

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

TRUTH_NAMES = frozenset({'ground_truth', 'groundtruth', 'truth', 'gt'})
"""Topics with one of these between the slashes of their name hold truth, not measurements."""

ESTIMATE_NAMES = frozenset({'landmark_map', 'landmark_estimates', 'map'})
"""Landmarks that an observer publishes, and does not measure; ``map`` in older recordings."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class TopicNames:
    """Names that the user gives, with or without leading slash; None for topics to be found."""

    velocity: str | None = None
    landmarks: str | None = None
    pose_truth: str | None = None
    landmark_truth: str | None = None
    imu: str | None = None


@dataclass(frozen=True, slots=True)
class TransformTopics:
    """/tf_static and /tf, or a namespace's: each one topic, or none."""

    static: tuple[Topic, ...]
    moving: tuple[Topic, ...]


@dataclass(frozen=True, slots=True)
class SelectedTopics:
    """The topics of a replay: of measurements, of the truth, and of what places the sensors.

    Truth that is not recorded is None, and so is ``imu``, unless the angular velocity is its.
    """

    velocity: Topic
    landmarks: Topic
    pose_truth: Topic | None
    landmark_truth: Topic | None
    transforms: TransformTopics
    imu: Topic | None = None
    cameras: tuple[Topic, ...] = ()
    """CameraInfo, where landmarks are pixels or may be."""

    @property
    def inputs(self) -> tuple[Topic, ...]:
        """What the estimator takes in."""
        imu = () if self.imu is None else (self.imu,)
        return (self.velocity, self.landmarks, *imu)


@dataclass(frozen=True, slots=True)
class _Role:
    """What a topic is wanted for: its option, its types, and which name is preferred."""

    name: str
    option: str
    message_types: Collection[str]
    is_truth: bool
    rank: Callable[[str], int]
    types_by_name: Collection[str] = ()
    """Types that hold other things, too: taken only of a topic that the user names."""
    is_typed: bool = False
    """Whether the user names the type: clouds without ids are taken where there are no others."""

    @property
    def all_types(self) -> tuple[str, ...]:
        """All types that a topic may have which the user names."""
        return (*self.message_types, *self.types_by_name)


def select_topics(
    topics: Sequence[Topic],
    names: TopicNames,
    inputs: InputSettings,
    has_ids: Callable[[Topic], bool],
    pose_frame: Callable[[Topic], str],
) -> SelectedTopics:
    """Pick one topic for each purpose.

    Raises a RecordingError if none fits or two do: it lists them, and the option that decides.

    Parameters
    ----------
    topics, names, inputs
        All topics of a recording, the topics that the user chose, and what of them is used.
    has_ids : callable
        Whether the points of a cloud have ids. Clouds without them, such as a lidar's, are taken
        only if they are chosen by name or by their type, or are called ``landmarks``.
    pose_frame : callable
        The frame of an odometry's poses. Where it is the map's, the velocity is an estimate,
        as an observer's own, and taken only if there is no other.

    """
    used = [topic for topic in topics if topic.count > 0]
    choice = _Choice(topics, used, inputs.map_frame, has_ids, pose_frame)
    wanted = ('velocity', '--velocity-topic', tuple(message_types('velocity')))
    if inputs.velocity_source == POSE_DIFFERENCES:
        wanted = ('odometry', '--velocity-topic', (ODOMETRY,))
    velocity = choice.require(_Role(*wanted, False, _velocity_rank), names.velocity)
    imu = _Role('Imu', '--imu', tuple(message_types('angular velocity')), False, lambda _: 0)
    landmarks = choice.require(*_of_landmarks(names.landmarks, inputs.landmarks_type))
    selected = SelectedTopics(
        velocity,
        landmarks,
        choice.pick(_of_true_poses(), names.pose_truth),
        choice.pick(_LANDMARK_TRUTH, names.landmark_truth),
        transform_topics(topics, (velocity, landmarks)),
        choice.require(imu, names.imu) if inputs.use_imu else None,
        tuple(topic for topic in used if topic.message_type == CAMERA_INFO)
        if landmarks.message_type in IN_IMAGES
        else (),
    )
    poses = message_types('pose')
    unread = [
        topic
        for topic in used
        if _is_truth(topic.name) and topic.message_type not in (*poses, *CLOUDS)
    ]
    if unread and selected.pose_truth is None:
        finding = found('unread_truth', types=_join(poses), topics=_join(unread))
        logger.warning('%s', finding)
    return selected


def pose_topic(topics: Sequence[Topic], name: str | None) -> Topic:
    """Return the topic of that name, which has poses, or else the true poses' topic.

    Raises a RecordingError that lists the topics if there is none, or several could be meant.
    """
    role = replace(_of_true_poses(), option='--topic')
    if name is not None:
        return _named(topics, role, name)
    used = [topic for topic in topics if topic.count > 0]
    fitting = [t for t in used if _is_truth(t.name) and t.message_type in role.message_types]
    return _required(_best(fitting, role), role, used)


@dataclass(frozen=True, slots=True)
class _Choice:
    """The topics of a recording, which have messages, and what to choose them by."""

    topics: Sequence[Topic]
    used: Sequence[Topic]
    map_frame: str
    has_ids: Callable[[Topic], bool]
    pose_frame: Callable[[Topic], str]

    def require(self, role: _Role, name: str | None) -> Topic:
        return _required(self.pick(role, name), role, self.used)

    def pick(self, role: _Role, name: str | None) -> Topic | None:
        if name is not None:
            return _named(self.topics, role, name)
        right = [topic for topic in self.used if _is_truth(topic.name) == role.is_truth]
        fitting = [topic for topic in right if self._fits(topic, role)]
        if len(fitting) > 1 and not role.is_truth:
            fitting = [
                topic
                for topic in fitting
                if topic.message_type != ODOMETRY or self.pose_frame(topic) != self.map_frame
            ] or fitting
        found = _best(fitting, role)
        if found is None and role.is_typed:
            return _best([t for t in right if t.message_type in role.message_types], role)
        return found

    def _fits(self, topic: Topic, role: _Role) -> bool:
        if not role.is_truth and last_part(topic.name) == 'landmarks':
            return topic.message_type in role.all_types
        if topic.message_type not in role.message_types:
            return False
        return topic.message_type not in CLOUDS or self.has_ids(topic)


def transform_topics(topics: Sequence[Topic], inputs: Sequence[Topic]) -> TransformTopics:
    """Pick the /tf and the /tf_static of the robot whose measurements are replayed.

    Robots in namespaces may each have their own, with the same names of frames. First comes
    the namespace that the inputs share, then each one further out, /tf at last. Where none
    of these is recorded, another namespace's are taken if there is only one.
    """
    trees = [
        topic
        for topic in topics
        if topic.message_type == TRANSFORMS
        and topic.count
        and last_part(topic.name) in ('tf', 'tf_static')
    ]
    shared = commonpath([_namespace(topic) for topic in inputs])
    fitting = [t for t in trees if commonpath([_namespace(t), shared]) == _namespace(t)]
    if not fitting and len({_namespace(tree) for tree in trees}) == 1:
        fitting = trees
    if trees and not fitting:
        topics_of_trees = ', '.join(tree.name for tree in trees)
        shared_by = ' and '.join(topic.name for topic in inputs)
        finding = found('several_robots', topics=topics_of_trees, inputs=shared_by)
        logger.warning('%s', finding)
    innermost_last = sorted(fitting, key=lambda tree: len(_namespace(tree)))
    chosen = {last_part(tree.name): (tree,) for tree in innermost_last}
    return TransformTopics(chosen.get('tf_static', ()), chosen.get('tf', ()))


def _namespace(topic: Topic) -> str:
    return '/' + topic.name.strip('/').rpartition('/')[0]


def _velocity_rank(name: str) -> int:
    """Prefer ``twist``; put commands behind measurements."""
    if last_part(name) == 'twist':
        return 0
    return 2 if 'cmd' in name or 'command' in name else 1


def _landmark_rank(name: str) -> int:
    """Prefer ``landmarks``; put an observer's own estimates last."""
    if last_part(name) == 'landmarks':
        return 0
    return 2 if last_part(name) in ESTIMATE_NAMES else 1


def _of_landmarks(name: str | None, landmarks_type: str) -> tuple[_Role, str | None]:
    """Return which types landmarks may have, and the name of their topic if it is known."""
    types = message_types('landmarks').values()
    wanted = tuple(known.name for known in types if not known.is_ambiguous)
    by_name = (*(known.name for known in types if known.is_ambiguous), TRANSFORMS)
    if landmarks_type == ON_TF:
        wanted, name = (TRANSFORMS,), name or '/tf'
    elif landmarks_type != AUTO:
        wanted = tuple(known.name for known in types if known.short_name == landmarks_type)
    is_typed = landmarks_type != AUTO
    by_name = () if is_typed else by_name
    role = _Role('landmark', '--landmarks-topic', wanted, False, _landmark_rank, by_name, is_typed)
    return role, name


def _of_true_poses() -> _Role:
    types = tuple(message_types('pose'))
    return _Role(
        'true pose', '--pose-truth-topic', types, True, lambda name: last_part(name) != 'pose'
    )


_LANDMARK_TRUTH = _Role('true landmark', '--landmark-truth-topic', CLOUDS, True, _landmark_rank)


def _is_truth(name: str) -> bool:
    return not TRUTH_NAMES.isdisjoint(name.lower().split('/'))


def _named(topics: Sequence[Topic], role: _Role, name: str) -> Topic:
    same_name = [topic for topic in topics if topic.name.strip('/') == name.strip('/')]
    fitting = [topic for topic in same_name if topic.message_type in role.all_types]
    if fitting:
        return fitting[0]
    if same_name:
        raise RecordingError(
            f'{same_name[0]} can not be the {role.name} topic, '
            f'which is one of {_join(role.all_types)}'
        )
    raise RecordingError(f'no topic {name}; the recording holds {_join(topics)}')


def _best(fitting: Sequence[Topic], role: _Role) -> Topic | None:
    if not fitting:
        return None
    first = min(role.rank(topic.name) for topic in fitting)
    best = [topic for topic in fitting if role.rank(topic.name) == first]
    if len(best) > 1:
        raise RecordingError(
            f'{len(best)} topics could be the {role.name} topic: {_join(best)}; '
            f'choose one with {role.option}'
        )
    return best[0]


def _required(topic: Topic | None, role: _Role, topics: Sequence[Topic]) -> Topic:
    if topic is not None:
        return topic
    with_ids = ' with ids' if any(name in CLOUDS for name in role.message_types) else ''
    possible = [
        topic.name
        for topic in topics
        if topic.message_type in role.all_types
        and _is_truth(topic.name) == role.is_truth
        and last_part(topic.name) != 'tf_static'
    ]
    # Nearly every recording has /tf, most of them without landmarks.
    possible.sort(key=lambda name: last_part(name) == 'tf')
    advice = f'may name {_join(possible)}' if possible else 'names another'
    raise RecordingError(
        f'no {role.name} topic: none of type {_join(role.message_types)}{with_ids}; '
        f'{role.option} {advice}; the recording holds {_join(topics)}'
    )


def _join(items: Iterable[object]) -> str:
    return ', '.join(map(str, items)) or 'nothing'


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
            return partial(_from_release, *OTHER_DETECTIONS[names[3:]])
    raise _other_release(['vision_msgs/msg/Detection3D'])


def _of_galactic_or_foxy(raw: Buffer, receive_ns: int) -> ObservationEvent:
    """Decode detections of a recording that does not say how: Foxy's never do."""
    try:
        return decode_detections(raw, receive_ns)
    except MessageError:
        with suppress(MessageError):
            return next(iter(OTHER_DETECTIONS.values()))[1](raw, receive_ns)
        raise


def _from_release(
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
