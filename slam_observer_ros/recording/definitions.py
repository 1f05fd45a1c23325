"""How a recording defines the messages of detectors: packages change, and keep the names."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache, partial
from typing import Any, TYPE_CHECKING, TypeAlias

from slam_observer_ros.common.errors import MessageError, RecordingError
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.messages.cdr import Buffer
from slam_observer_ros.messages.detections import (
    decode_detections,
    decode_foxy_detections,
    decode_ros1_detections,
)
from slam_observer_ros.messages.measurement import Measurement
from slam_observer_ros.recording.ros1 import types_in

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

Decoder: TypeAlias = Callable[[Buffer, int], Measurement[ObservationEvent]]

DETECTIONS = 'vision_msgs/msg/Detection3DArray'

_ARUCO_MARKERS = 'std_msgs/Header header\nint64[] marker_ids\ngeometry_msgs/Pose[] poses\n'
_TAG_DETECTIONS = 'std_msgs/Header header\nAprilTagDetection[] detections\n'

DEFINITIONS = {
    'vision_msgs/msg/ObjectHypothesis': 'string class_id\nfloat64 score\n',
    'vision_msgs/msg/ObjectHypothesisWithPose': (
        'ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n'
    ),
    'vision_msgs/msg/BoundingBox3D': 'geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n',
    'vision_msgs/msg/Detection3D': (
        'std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox3D bbox\n'
        'string id\n'
    ),
    DETECTIONS: 'std_msgs/Header header\nDetection3D[] detections\n',
    'apriltag_msgs/msg/Point': 'float64 x\nfloat64 y\n',
    'apriltag_msgs/msg/AprilTagDetection': (
        'string family\nint32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\n'
        'Point centre\nPoint[4] corners\nfloat64[9] homography\n'
    ),
    'apriltag_msgs/msg/AprilTagDetectionArray': _TAG_DETECTIONS,
    'isaac_ros_apriltag_interfaces/msg/AprilTagDetection': (
        'string family\nint32 id\ngeometry_msgs/Point center\ngeometry_msgs/Point[4] corners\n'
        'geometry_msgs/PoseWithCovarianceStamped pose\n'
    ),
    'isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray': _TAG_DETECTIONS,
    'aruco_opencv_msgs/msg/MarkerPose': 'uint16 marker_id\ngeometry_msgs/Pose pose\n',
    'aruco_opencv_msgs/msg/BoardPose': 'string board_name\ngeometry_msgs/Pose pose\n',
    'aruco_opencv_msgs/msg/ArucoDetection': (
        'std_msgs/Header header\nMarkerPose[] markers\nBoardPose[] boards\n'
    ),
    'aruco_interfaces/msg/ArucoMarkers': _ARUCO_MARKERS,
    'ros2_aruco_interfaces/msg/ArucoMarkers': _ARUCO_MARKERS,
}
"""What is read here of packages beyond ROS's common interfaces."""


@cache
def decoder_of_other_fields(message_type: str, definition: str) -> Decoder | None:
    """Return what decodes a type that may have other fields than usual; None if it has not.

    Raises a RecordingError if nothing does.
    """
    if message_type not in DEFINITIONS:
        return None
    defined = types_in(definition, message_type)
    if message_type == DETECTIONS:
        return _decoder_of_detections(defined)
    if message_type not in defined:
        return None
    known = {
        name: what
        for key, text in DEFINITIONS.items()
        for name, what in types_in(text, key).items()
    }
    right, there = _typestore(known), _typestore(known | defined)
    changed = [
        name for name in defined if name in known and _layout(right, name) != _layout(there, name)
    ]
    if changed:
        raise _other_release(changed)
    return None


def _other_release(changed: Sequence[str]) -> RecordingError:
    names = ', '.join(name.rpartition('/')[2] for name in changed)
    package = changed[0].partition('/')[0]
    return RecordingError(
        f'{names} of {package} has other fields in this recording than in the releases that are '
        'read; record it with another one, or leave the topic out'
    )


def _decoder_of_detections(defined: dict[str, Any]) -> Decoder | None:
    detection = defined.get('vision_msgs/msg/Detection3D')
    if detection is None:
        return _of_galactic_or_foxy
    known: dict[tuple[str, ...], Decoder | None] = {
        ('id',): None,
        ('source_cloud', 'is_tracking', 'tracking_id'): partial(
            _named, 'Foxy', decode_foxy_detections
        ),
        ('source_cloud',): partial(_named, 'ROS 1', decode_ros1_detections),
    }
    names = tuple(name for name, _ in detection[1])
    if names[:3] != ('header', 'results', 'bbox') or names[3:] not in known:
        raise _other_release(['vision_msgs/msg/Detection3D'])
    return known[names[3:]]


def _of_galactic_or_foxy(raw: Buffer, receive_stamp_ns: int) -> Measurement[ObservationEvent]:
    """Decode detections of a recording that does not say how: Foxy's never do."""
    try:
        return decode_detections(raw, receive_stamp_ns)
    except MessageError:
        with suppress(MessageError):
            return decode_foxy_detections(raw, receive_stamp_ns)
        raise


def _named(
    release: str, decode: Decoder, raw: Buffer, receive_stamp_ns: int
) -> Measurement[ObservationEvent]:
    try:
        return decode(raw, receive_stamp_ns)
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
