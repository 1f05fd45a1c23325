"""Landmarks that a detector gives as poses: fiducials of ArUco packages and of Isaac ROS.

Messages are read from their bytes, so that none of the packages that define them is needed here.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.events import MAX_ID, ObservationEvent, UNKNOWN_ID
from slam_observer_ros.geometry import so3
from slam_observer_ros.messages.cdr import CdrReader
from slam_observer_ros.messages.clouds import is_measured
from slam_observer_ros.messages.registry import reads

_POSE = 7
_COVARIANCE = 36
_CENTRE_AND_CORNERS = 15
NESTED = f'{"=" * 80}\nMSG: '
"""What comes before the name of a nested type in a definition."""


@reads(
    'isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray',
    role='landmarks',
    package='isaac_ros_apriltag',
    definition=(
        'std_msgs/Header header\nAprilTagDetection[] detections\n'
        f'{NESTED}isaac_ros_apriltag_interfaces/AprilTagDetection\n'
        'string family\nint32 id\ngeometry_msgs/Point center\ngeometry_msgs/Point[4] corners\n'
        'geometry_msgs/PoseWithCovarianceStamped pose\n'
    ),
)
def decode_isaac_apriltags(reader: CdrReader) -> ObservationEvent:
    """Read an AprilTagDetectionArray of isaac_ros_apriltag_interfaces, which has the poses."""
    stamp_ns, frame_id = reader.header()
    tags = [_read_isaac_apriltag(reader) for _ in range(reader.uint32())]
    ids = np.array([tag_id for tag_id, _ in tags], dtype=np.int64)
    values = np.array([pose for _, pose in tags]).reshape(-1, _POSE + _COVARIANCE)
    covariances = values[:, _POSE:].reshape(-1, 6, 6)
    return observed_poses(frame_id, stamp_ns, _usable(ids), values[:, :_POSE], covariances)


@reads(
    'aruco_opencv_msgs/msg/ArucoDetection',
    role='landmarks',
    package='aruco_opencv',
    definition=(
        'std_msgs/Header header\nMarkerPose[] markers\nBoardPose[] boards\n'
        f'{NESTED}aruco_opencv_msgs/MarkerPose\nuint16 marker_id\ngeometry_msgs/Pose pose\n'
        f'{NESTED}aruco_opencv_msgs/BoardPose\nstring board_name\ngeometry_msgs/Pose pose\n'
    ),
)
def decode_aruco_detection(reader: CdrReader) -> ObservationEvent:
    """Read the markers of an aruco_opencv_msgs/ArucoDetection; boards have no id to go by."""
    stamp_ns, frame_id = reader.header()
    markers = [(reader.uint16(), reader.float64(_POSE)) for _ in range(reader.uint32())]
    for _ in range(reader.uint32()):
        reader.string()
        reader.float64(_POSE)
    ids = np.array([marker_id for marker_id, _ in markers], dtype=np.int64)
    poses = np.array([pose for _, pose in markers]).reshape(-1, _POSE)
    return observed_poses(frame_id, stamp_ns, ids, poses)


@reads(
    'ros2_aruco_interfaces/msg/ArucoMarkers',
    'aruco_interfaces/msg/ArucoMarkers',
    role='landmarks',
    package='ros2_aruco',
    definition='std_msgs/Header header\nint64[] marker_ids\ngeometry_msgs/Pose[] poses\n',
)
def decode_aruco_markers(reader: CdrReader) -> ObservationEvent:
    """Read an ArucoMarkers of aruco_interfaces or ros2_aruco_interfaces."""
    stamp_ns, frame_id = reader.header()
    ids = reader.int64(reader.uint32())
    poses = reader.float64(_POSE * reader.uint32()).reshape(-1, _POSE)
    if len(ids) != len(poses):
        raise MessageError(f'{len(ids)} marker ids for {len(poses)} poses')
    return observed_poses(frame_id, stamp_ns, _usable(ids), poses)


def observed_poses(
    frame_id: str,
    stamp_ns: int,
    ids: IntArray,
    poses: FloatArray,
    pose_covariances: FloatArray | None = None,
) -> ObservationEvent:
    """Return landmarks at ``poses`` (m, 7), position first, seen in one frame.

    Of ``pose_covariances`` (m, 6, 6), zero where unknown, those of the positions are used if they
    are known of all.
    """
    covariances = turns = None
    if pose_covariances is not None:
        of_positions, of_turns = pose_covariances[:, :3, :3], pose_covariances[:, 3:, 3:]
        is_known = len(ids) > 0 and bool(of_positions.any(axis=(1, 2)).all())
        covariances = of_positions if is_known else None
        turns = of_turns if of_turns.any() else None
    event = ObservationEvent(
        stamp_ns,
        ids,
        poses[:, :3],
        covariances,
        orientations=orientations_of(poses[:, 3:]),
        orientation_covariances=turns,
        sensor_frame=frame_id,
    )
    return event.select(is_measured(event.points))


def orientations_of(quaternions: FloatArray) -> FloatArray | None:
    """Return rotations (m, 3, 3) of quaternions (m, 4) xyzw, zero where they are unknown.

    So is one that is exactly no turn, as messages have it that nobody filled in. None if all are.
    """
    with np.errstate(invalid='ignore', over='ignore'):
        norms = np.linalg.norm(quaternions, axis=1)
        is_turn = np.abs(norms - 1.0) < so3.QUATERNION_NORM_TOLERANCE
    known = is_turn & quaternions[:, :3].any(axis=1)
    if not known.any():
        return None
    R = np.zeros((len(quaternions), 3, 3))
    R[known] = so3.from_quaternion(quaternions[known])
    return R


def _read_isaac_apriltag(reader: CdrReader) -> tuple[int, FloatArray]:
    """Read an AprilTagDetection: id, and pose with covariance (43,) in the frame of the array."""
    reader.string()  # family
    tag_id = reader.int32()
    reader.float64(_CENTRE_AND_CORNERS)
    reader.header()
    return tag_id, reader.float64(_POSE + _COVARIANCE)


def _usable(ids: IntArray) -> IntArray:
    """Return the unknown id in place of any that could not be published."""
    return np.where((ids >= 0) & (ids <= MAX_ID), ids, UNKNOWN_ID)
