"""Builds what detectors publish, with the definitions of the optional packages."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import ros_messages as ros
from rosbags.typesys import get_types_from_msg

from slam_observer_ros.settings.node_settings import message_types

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


def boxes(
    seen: Iterable[tuple[str, Sequence[float]]], frame_id: str, stamp_ns: int = ros.STAMP_NS
) -> object:
    """vision_msgs/Detection2DArray of (id, pixel of the centre)."""
    package = 'vision_msgs/msg'
    found = []
    for name, pixel in seen:
        pose = ros.make(f'{package}/Pose2D', ros.make(f'{package}/Point2D', *pixel), 0.3)
        box = ros.make(f'{package}/BoundingBox2D', pose, 20.0, 10.0)
        found.append(ros.make(f'{package}/Detection2D', ros.header(frame_id), [], box, name))
    return ros.make(f'{package}/Detection2DArray', ros.header(frame_id, stamp_ns), found)


FOCAL_LENGTHS, CENTRE = (600.0, 610.0), (320.0, 240.0)


def camera_info(
    frame_id: str,
    model: str = 'plumb_bob',
    distortion: Sequence[float] = (),
    binning: tuple[int, int] = (0, 0),
    offset: tuple[int, int] = (0, 0),
    focal_lengths: tuple[float, float] = FOCAL_LENGTHS,
) -> object:
    """sensor_msgs/CameraInfo of 640 × 480 pixels; zeros are as of a camera not calibrated."""
    (fx, fy), (cx, cy) = focal_lengths, CENTRE
    K = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0])
    P = np.insert(K.reshape(3, 3), 3, 0.0, axis=1).ravel()
    part = ros.make('sensor_msgs/msg/RegionOfInterest', *offset, 0, 0, False)
    lens = 480, 640, model, np.array(distortion, dtype=float), K, np.eye(3).ravel(), P
    return ros.make('sensor_msgs/msg/CameraInfo', ros.header(frame_id), *lens, *binning, part)


def pixels_of(points: np.ndarray) -> np.ndarray:
    """Return where that camera shows points (m, 3) before it: pixels (m, 2)."""
    return points[:, :2] / points[:, 2:] * FOCAL_LENGTHS + CENTRE


def apriltags(
    tags: Iterable[tuple[str, int]],
    frame_id: str,
    stamp_ns: int = ros.STAMP_NS,
    centres: Sequence[Sequence[float]] | None = None,
) -> object:
    """apriltag_msgs/AprilTagDetectionArray of (family, id), and of the centres' pixels."""
    tags = list(tags)
    pixels = [(0.0, 0.0)] * len(tags) if centres is None else centres
    points = [ros.make('apriltag_msgs/msg/Point', *pixel) for pixel in pixels]
    seen = [
        ros.make('apriltag_msgs/msg/AprilTagDetection', family, number, 0, 1.0, 2.0, point,
                 [point] * 4, np.zeros(9))
        for (family, number), point in zip(tags, points, strict=True)
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


def range_beacon(
    sensed: Iterable[tuple[int, float]],
    frame_id: str,
    stamp_ns: int = ros.STAMP_NS,
    deviation: float = 0.0,
) -> object:
    """mrpt_msgs/ObservationRangeBeacon of (id, range)."""
    package = 'mrpt_msgs/msg'
    seen = [
        ros.make(f'{package}/SingleRangeBeaconObservation', distance, number)
        for number, distance in sensed
    ]
    header, pose = ros.header(frame_id, stamp_ns), ros.pose((0.0, 0.0, 0.0), NO_TURN)
    whole = header, pose, 0.0, 100.0, deviation, seen
    return ros.make(f'{package}/ObservationRangeBeacon', *whole)


def linktrack(
    frame: str,
    nodes: Iterable[tuple[float, ...]],
    frame_id: str | None = None,
    stamp_ns: int = ros.STAMP_NS,
) -> object:
    """A frame of LinkTrack of (id, distance[, angle]); without ``frame_id`` ROS 1's."""
    package = 'nlink_parser' if frame_id is None else 'nlink_parser_ros2_interfaces'
    head = [] if frame_id is None else [ros.header(frame_id, stamp_ns)]
    node = 'LinktrackAoaNode0' if 'Aoa' in frame else 'LinktrackNode2'
    seen = [
        ros.make(f'{package}/msg/{node}', 1, int(number), *measured, -80.0, -79.0)
        for number, *measured in nodes
    ]
    sizes = (3, 3, 3, 3, 4, 3, 3) if frame == 'LinktrackNodeframe2' else ()
    own = [np.full(size, 9.0, np.float32) for size in sizes]
    return ros.make(f'{package}/msg/{frame}', *head, 2, 0, 100, 200, 5.0, *own, seen)


def beacon_distance(
    beacon: int, distance: float, name: str = 'marvelmind_ros2_msgs/msg/BeaconDistance'
) -> object:
    """Distance from one of Marvelmind's beacons, as ROS 2 has it or ROS 1."""
    return ros.make(name, 5, beacon, distance)


def gtec(name: str, anchor: int, millimetres: int) -> object:
    """Ranging of gtec_msgs, all of whose other fields are 3."""
    fields = ros.TYPESTORE.fielddefs[f'gtec_msgs/msg/{name}'][1]
    others = [3.0 if what[1][0] == 'float64' else 3 for _, what in fields[3:]]
    return ros.make(f'gtec_msgs/msg/{name}', anchor, 1, millimetres, *others)


def one_range(frame_id: str, distance: float, variance: float = 0.0) -> object:
    """sensor_msgs/Range of a sensor that measures from 0.2 to 50 m."""
    limits = 0, 0.1, 0.2, 50.0
    return ros.make('sensor_msgs/msg/Range', ros.header(frame_id), *limits, distance, variance)


def ranges_of_packages(number: int = 7) -> list[object]:
    """A message of each type of packages for radios and beacons, 2 m from one landmark."""
    frames = 'LinktrackNodeframe2', 'LinktrackNodeframe3', 'LinktrackAoaNodeframe0'
    nodes = {frame: (number, 2.0, *([90.0] if 'Aoa' in frame else [])) for frame in frames}
    return [
        range_beacon([(number, 2.0)], 'camera'),
        *(linktrack(frame, [node]) for frame, node in nodes.items()),
        *(linktrack(frame, [node], 'camera') for frame, node in nodes.items()),
        beacon_distance(number, 2.0),
        beacon_distance(number, 2.0, 'marvelmind_nav/msg/beacon_distance'),
        *(gtec(name, number, 2000) for name in ('Ranging', 'GenericRanging')),
        *(gtec(name, number, 2000) for name in ('DWRanging', 'UWBRanging')),
    ]
