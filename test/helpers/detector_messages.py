"""Builds what detectors publish, with the definitions of the optional packages."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import ros_messages as ros
from rosbags.typesys import get_types_from_msg

from slam_observer_ros.settings.input_settings import message_types

NO_TURN = np.array([0.0, 0.0, 0.0, 1.0])
for known in message_types('landmarks').values():
    if known.definition:
        ros.TYPESTORE.register(get_types_from_msg(known.definition, known.name))


def pose_array(
    points: Iterable[Sequence[float]],
    frame_id: str,
    stamp_ns: int = ros.STAMP_NS,
    quaternion: Sequence[float] = NO_TURN,
) -> object:
    """geometry_msgs/PoseArray, all of whose poses have one orientation."""
    poses = [ros.pose(point, quaternion) for point in points]
    return ros.make('geometry_msgs/msg/PoseArray', ros.header(frame_id, stamp_ns), poses)


def detection(
    name: str,
    class_id: str | None = None,
    covariance: np.ndarray | None = None,
    centre: Sequence[float] = (7.0, 8.0, 9.0),
    position: Sequence[float] = (1.0, 2.0, 3.0),
    quaternion: Sequence[float] = NO_TURN,
) -> object:
    """vision_msgs/Detection3D of a box, and of a result at ``position`` if it has a class.

    ``covariance`` is of the position (3, 3), or of the pose (6, 6), position first.
    """
    results = []
    if class_id is not None:
        hypothesis = ros.make('vision_msgs/msg/ObjectHypothesis', class_id, 0.9)
        whole = np.zeros((6, 6))
        if covariance is not None:
            whole[: len(covariance), : len(covariance)] = covariance
        pose = ros.make(
            'geometry_msgs/msg/PoseWithCovariance',
            ros.pose(position, quaternion),
            whole.ravel(),
        )
        results = [ros.make('vision_msgs/msg/ObjectHypothesisWithPose', hypothesis, pose)]
    box = ros.make(
        'vision_msgs/msg/BoundingBox3D',
        ros.pose(centre, NO_TURN),
        ros.vector((1.0, 1.0, 1.0)),
    )
    return ros.make('vision_msgs/msg/Detection3D', ros.header('camera'), results, box, name)


def detections(items: Iterable[object], frame_id: str, stamp_ns: int = ros.STAMP_NS) -> object:
    """vision_msgs/Detection3DArray."""
    header = ros.header(frame_id, stamp_ns)
    return ros.make('vision_msgs/msg/Detection3DArray', header, list(items))


def apriltags(
    tags: Iterable[tuple[str, int]], frame_id: str, stamp_ns: int = ros.STAMP_NS
) -> object:
    """apriltag_msgs/AprilTagDetectionArray of (family, id)."""
    point = ros.make('apriltag_msgs/msg/Point', 0.0, 0.0)
    seen = [
        ros.make('apriltag_msgs/msg/AprilTagDetection', family, number, 0, 1.0, 2.0, point,
                 [point] * 4, np.zeros(9))
        for family, number in tags
    ]  # fmt: skip
    header = ros.header(frame_id, stamp_ns)
    return ros.make('apriltag_msgs/msg/AprilTagDetectionArray', header, seen)


Markers = Iterable[tuple[int, Sequence[float], Sequence[float]]]
"""Of each its id, position and quaternion."""


def aruco_markers(
    markers: Markers,
    frame_id: str,
    stamp_ns: int = ros.STAMP_NS,
    package: str = 'ros2_aruco_interfaces',
) -> object:
    """ros2_aruco_interfaces/ArucoMarkers, or the same of another package."""
    ids, positions, quaternions = zip(*markers, strict=True) if markers else ((), (), ())
    poses = list(map(ros.pose, positions, quaternions))
    header = ros.header(frame_id, stamp_ns)
    return ros.make(f'{package}/msg/ArucoMarkers', header, np.array(ids, dtype=np.int64), poses)


def aruco_detection(
    markers: Markers, frame_id: str, stamp_ns: int = ros.STAMP_NS, boards: Sequence[str] = ()
) -> object:
    """aruco_opencv_msgs/ArucoDetection, with boards of these names."""
    package = 'aruco_opencv_msgs/msg'
    found = [
        ros.make(f'{package}/MarkerPose', number, ros.pose(position, quaternion))
        for number, position, quaternion in markers
    ]
    placed = [
        ros.make(f'{package}/BoardPose', name, ros.pose((9.0, 9.0, 9.0), NO_TURN))
        for name in boards
    ]
    header = ros.header(frame_id, stamp_ns)
    return ros.make(f'{package}/ArucoDetection', header, found, placed)


def isaac_apriltags(
    markers: Markers,
    frame_id: str,
    stamp_ns: int = ros.STAMP_NS,
    covariance: np.ndarray | None = None,
) -> object:
    """isaac_ros_apriltag_interfaces/AprilTagDetectionArray, of one pose covariance (6, 6)."""
    package = 'isaac_ros_apriltag_interfaces/msg'
    whole = np.zeros(36) if covariance is None else covariance.ravel()
    header, pixel = ros.header(frame_id, stamp_ns), ros.make('geometry_msgs/msg/Point', 1, 2, 0)
    seen = []
    for number, *where in markers:
        pose = ros.make('geometry_msgs/msg/PoseWithCovariance', ros.pose(*where), whole)
        stamped = ros.make('geometry_msgs/msg/PoseWithCovarianceStamped', header, pose)
        tag = 'tag36h11', number, pixel, [pixel] * 4, stamped
        seen.append(ros.make(f'{package}/AprilTagDetection', *tag))
    return ros.make(f'{package}/AprilTagDetectionArray', header, seen)


def landmark_list(
    entries: Iterable[tuple[str, Sequence[float], Sequence[float]]],
    frame_id: str,
    stamp_ns: int = ros.STAMP_NS,
    weights: tuple[float, float] = (0.0, 0.0),
) -> object:
    """cartographer_ros_msgs/LandmarkList of (id, position, quaternion), all of one weight."""
    package = 'cartographer_ros_msgs/msg'
    seen = [
        ros.make(f'{package}/LandmarkEntry', name, ros.pose(position, quaternion), *weights)
        for name, position, quaternion in entries
    ]
    return ros.make(f'{package}/LandmarkList', ros.header(frame_id, stamp_ns), seen)


def range_bearing(
    sensed: Iterable[tuple[int, float, float, float]],
    frame_id: str,
    stamp_ns: int = ros.STAMP_NS,
    deviations: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> object:
    """mrpt_msgs/ObservationRangeBearing of (id, range, yaw, pitch)."""
    package = 'mrpt_msgs/msg'
    seen = [
        ros.make(f'{package}/SingleRangeBearingObservation', *where, number)
        for number, *where in sensed
    ]
    header, pose = ros.header(frame_id, stamp_ns), ros.pose((0.0, 0.0, 0.0), NO_TURN)
    whole = header, pose, 0.0, 100.0, *deviations, seen
    return ros.make(f'{package}/ObservationRangeBearing', *whole)
