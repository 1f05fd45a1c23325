"""Landmark observations from messages of detectors: poses, boxes and fiducials.

Messages are read from their bytes, so that none of the packages that define them is needed here.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
import re

import numpy as np

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import MAX_ID, ObservationEvent, UNKNOWN_ID
from slam_observer_ros.messages.cdr import Buffer, CdrReader
from slam_observer_ros.messages.cloud_fields import skip_cloud
from slam_observer_ros.messages.measurement import Measurement
from slam_observer_ros.messages.observed_poses import observed_poses, orientations_of
from slam_observer_ros.messages.poses_and_velocities import PoseMessage

_POSE = 7
_COVARIANCE = 36
_SIZE = 3
_CORNERS = 10
_HOMOGRAPHY = 9
MAX_NAMES = 12  # names of frames that a log line lists

_TRAILING_NUMBER = re.compile(r'(?:.*\D)?(\d+)')
_HASH = re.compile(r'(?<![^\W_])(?=.*\d[a-f])[\da-f-]{8,}\Z', re.IGNORECASE)
"""A UUID, too. Names with a number, as ``facade12`` or ``b-000123``, have no letter after it."""
_HASH_LENGTH = 64  # no more of a name is searched: that takes the square of the length


@dataclass(frozen=True, slots=True)
class TagDetections:
    """Fiducials, of families such as ``tag36h11``, that a camera has seen; /tf has their poses."""

    stamp_ns: int
    frame_id: str
    ids: tuple[int, ...]
    families: tuple[str, ...]


def decode_pose_array(raw: Buffer, _receive_stamp_ns: int = 0) -> Measurement[ObservationEvent]:
    """Decode a geometry_msgs/PoseArray, whose landmarks have no ids."""
    reader = CdrReader(raw)
    stamp_ns, frame_id = reader.header()
    poses = reader.float64(_POSE * reader.uint32()).reshape(-1, _POSE)
    reader.finish()
    ids = np.full(len(poses), UNKNOWN_ID, dtype=np.int64)
    return observed_poses(frame_id, stamp_ns, ids, poses)


def decode_detections(raw: Buffer, _receive_stamp_ns: int = 0) -> Measurement[ObservationEvent]:
    """Decode a vision_msgs/Detection3DArray, since ROS 2 Galactic.

    The id of a landmark is the number that ends its detection's ``id``, or else its first
    result's ``class_id``: both are strings. No id are UUIDs, hashes, and numbers beyond
    ``MAX_ID``, as trackers give them. Its pose, with covariance if it is known of all, is that
    result's, or else, if that is missing or zero, that of the centre of the box.
    """
    return _decode_detections(raw, ('id',))


def decode_foxy_detections(
    raw: Buffer, _receive_stamp_ns: int = 0
) -> Measurement[ObservationEvent]:
    """Decode a vision_msgs/Detection3DArray of ROS 2 Dashing to Foxy, with ``tracking_id``."""
    return _decode_detections(raw, ('source_cloud', 'is_tracking', 'tracking_id'))


def decode_ros1_detections(
    raw: Buffer, _receive_stamp_ns: int = 0
) -> Measurement[ObservationEvent]:
    """Decode a vision_msgs/Detection3DArray of ROS 1, whose classes are numbers, made CDR."""
    return _decode_detections(raw, ('source_cloud',), has_numbers=True)


def _decode_detections(
    raw: Buffer, rest: Sequence[str], has_numbers: bool = False
) -> Measurement[ObservationEvent]:
    """Decode detections with these fields behind their box."""
    reader = CdrReader(raw)
    stamp_ns, frame_id = reader.header()
    detections = [_read_detection(reader, rest, has_numbers) for _ in range(reader.uint32())]
    reader.finish()
    ids = np.array([landmark_id for landmark_id, _, _ in detections], dtype=np.int64)
    poses = np.array([pose for _, pose, _ in detections]).reshape(-1, _POSE)
    covariances = np.array([covariance for _, _, covariance in detections]).reshape(-1, 6, 6)
    return observed_poses(frame_id, stamp_ns, ids, poses, covariances)


def decode_apriltags(raw: Buffer, _receive_stamp_ns: int = 0) -> TagDetections:
    """Decode an apriltag_msgs/AprilTagDetectionArray."""
    reader = CdrReader(raw)
    stamp_ns, frame_id = reader.header()
    tags = [_read_apriltag(reader) for _ in range(reader.uint32())]
    reader.finish()
    return TagDetections(
        stamp_ns, frame_id, tuple(number for number, _ in tags), tuple(name for _, name in tags)
    )


def observed_tags(
    transforms: Iterable[PoseMessage], tag_frame_prefix: str
) -> list[Measurement[ObservationEvent]]:
    """Return what of /tf are sightings of fiducials: transforms from a camera to a tag.

    A tag's frame is the prefix and its id, or, as apriltag_ros has it, ``family:id``. Those that
    are no transforms, which have NaN in them for example, are left out, and so are numbers beyond
    ``MAX_ID``. One measurement is returned for each camera and stamp.
    """
    # Other things have names with a colon, too, and longer numbers than a family has tags.
    pattern = re.compile(rf'{re.escape(tag_frame_prefix)}(\d+)|\w+:(\d{{1,9}})')
    seen = [
        (message, _landmark_id(match[1] or match[2]))
        for message in transforms
        if (match := pattern.fullmatch(message.child_frame_id)) and not message.problem
    ]
    seen = [sighting for sighting in seen if sighting[1] != UNKNOWN_ID]
    seen.sort(key=_camera_and_stamp)
    return [
        _observation(frame_id, stamp_ns, list(group))
        for (frame_id, stamp_ns), group in groupby(seen, key=_camera_and_stamp)
    ]


def no_tags(tag_frame_prefix: str, frames: Iterable[str]) -> str:
    """Say that none of the frames on /tf is that of a fiducial, and what to do."""
    names = sorted(frames)
    there = ', '.join(names[:MAX_NAMES]) + (', …' if len(names) > MAX_NAMES else '')
    return (
        f"no frame on /tf is named '{tag_frame_prefix}<id>' or '<family>:<id>' "
        f'(there are {there}): set tag_frame_prefix'
    )


def _landmark_id(digits: str) -> int:
    """Return the number as an id, or the unknown id if it is beyond the largest one."""
    significant = digits.lstrip('0') or '0'
    if len(significant) > len(str(MAX_ID)):  # Python converts no number of thousands of digits.
        return UNKNOWN_ID
    return int(significant) if int(significant) <= MAX_ID else UNKNOWN_ID


def _id_in_name(name: str) -> int:
    """Return the number that ends the name of a detection; the unknown id if none does."""
    match = _TRAILING_NUMBER.fullmatch(name)
    if match is None or _HASH.search(name[-_HASH_LENGTH:]):
        return UNKNOWN_ID
    return _landmark_id(match[1])


def _camera_and_stamp(sighting: tuple[PoseMessage, int]) -> tuple[str, int]:
    return sighting[0].frame_id, sighting[0].stamp_ns


def _observation(
    frame_id: str, stamp_ns: int, sightings: Sequence[tuple[PoseMessage, int]]
) -> Measurement[ObservationEvent]:
    ids = np.array([landmark_id for _, landmark_id in sightings], dtype=np.int64)
    points = np.array([message.position for message, _ in sightings])
    R = orientations_of(np.array([message.quaternion for message, _ in sightings]))
    return Measurement(frame_id, ObservationEvent(stamp_ns, ids, points, orientations=R))


def _read_detection(
    reader: CdrReader, rest: Sequence[str], has_numbers: bool
) -> tuple[int, FloatArray, FloatArray]:
    """Read a vision_msgs/Detection3D: id, position and quaternion (7,), covariance (6, 6)."""
    reader.header()
    results = [_read_result(reader, has_numbers) for _ in range(reader.uint32())]
    centre, name = reader.float64(_POSE + _SIZE)[:_POSE], ''
    for field in rest:
        if field == 'source_cloud':
            skip_cloud(reader)
        elif field == 'is_tracking':
            reader.uint8()
        else:
            name = reader.string()
    names = [name, *(class_id for class_id, _, _ in results[:1])]
    ids = (_id_in_name(name) for name in names)
    landmark_id = next((number for number in ids if number != UNKNOWN_ID), UNKNOWN_ID)
    if results and results[0][1][:3].any():
        _, pose, covariance = results[0]
        return landmark_id, pose, covariance
    # Detectors that fill in the box only leave the position of the result at zero.
    return landmark_id, centre, np.zeros((6, 6))


def _read_result(reader: CdrReader, has_numbers: bool) -> tuple[str, FloatArray, FloatArray]:
    """Read a vision_msgs/ObjectHypothesisWithPose: class, pose (7,), covariance (6, 6)."""
    name = str(reader.int64(1)[0]) if has_numbers else reader.string()
    values = reader.float64(1 + _POSE + _COVARIANCE)  # the score comes first
    covariance = values[1 + _POSE :].reshape(6, 6)
    if covariance[0, 0] < 0.0:  # unknown
        covariance = np.zeros((6, 6))
    return name, values[1 : 1 + _POSE], covariance


def _read_apriltag(reader: CdrReader) -> tuple[int, str]:
    """Read an apriltag_msgs/AprilTagDetection: id and family."""
    family = reader.string()
    landmark_id = reader.int32()
    reader.int32()  # hamming distance
    reader.float32(2)  # goodness, decision margin
    reader.float64(_CORNERS + _HOMOGRAPHY)
    if landmark_id < 0:
        raise MessageError(f'negative tag id {landmark_id}')
    return landmark_id, family
