"""Fiducials with their poses in one message, as ArUco packages and Isaac ROS publish them.

Messages are read from their bytes, so that none of the packages that define them is needed here.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.events import MAX_ID, ObservationEvent, UNKNOWN_ID
from slam_observer_ros.messages.cdr import Buffer, CdrReader
from slam_observer_ros.messages.measurement import Measurement
from slam_observer_ros.messages.observed_poses import observed_poses

_POSE = 7
_COVARIANCE = 36
_CENTRE_AND_CORNERS = 15


def decode_aruco_markers(raw: Buffer, _receive_stamp_ns: int = 0) -> Measurement[ObservationEvent]:
    """Decode an ArucoMarkers of aruco_interfaces or ros2_aruco_interfaces."""
    reader = CdrReader(raw)
    stamp_ns, frame_id = reader.header()
    ids = reader.int64(reader.uint32())
    poses = reader.float64(_POSE * reader.uint32()).reshape(-1, _POSE)
    reader.finish()
    if len(ids) != len(poses):
        raise MessageError(f'{len(ids)} marker ids for {len(poses)} poses')
    return observed_poses(frame_id, stamp_ns, _usable(ids), poses)


def decode_aruco_detection(
    raw: Buffer, _receive_stamp_ns: int = 0
) -> Measurement[ObservationEvent]:
    """Decode the markers of an aruco_opencv_msgs/ArucoDetection; boards have no id to go by."""
    reader = CdrReader(raw)
    stamp_ns, frame_id = reader.header()
    markers = [(reader.uint16(), reader.float64(_POSE)) for _ in range(reader.uint32())]
    for _ in range(reader.uint32()):
        reader.string()
        reader.float64(_POSE)
    reader.finish()
    ids = np.array([marker_id for marker_id, _ in markers], dtype=np.int64)
    poses = np.array([pose for _, pose in markers]).reshape(-1, _POSE)
    return observed_poses(frame_id, stamp_ns, ids, poses)


def decode_isaac_apriltags(
    raw: Buffer, _receive_stamp_ns: int = 0
) -> Measurement[ObservationEvent]:
    """Decode an AprilTagDetectionArray of isaac_ros_apriltag_interfaces, which has the poses."""
    reader = CdrReader(raw)
    stamp_ns, frame_id = reader.header()
    tags = [_read_isaac_apriltag(reader) for _ in range(reader.uint32())]
    reader.finish()
    ids = np.array([tag_id for tag_id, _ in tags], dtype=np.int64)
    values = np.array([pose for _, pose in tags]).reshape(-1, _POSE + _COVARIANCE)
    covariances = values[:, _POSE:].reshape(-1, 6, 6)
    return observed_poses(frame_id, stamp_ns, _usable(ids), values[:, :_POSE], covariances)


def _read_isaac_apriltag(reader: CdrReader) -> tuple[int, FloatArray]:
    """Read an AprilTagDetection: id, and pose with covariance (43,) in the frame of the array."""
    reader.string()  # family
    tag_id = reader.int32()
    reader.float64(_CENTRE_AND_CORNERS)
    reader.header()
    return tag_id, reader.float64(_POSE + _COVARIANCE)


def _usable(ids: IntArray) -> IntArray:
    """Return the unknown id in place of those that could not be published."""
    return np.where((ids >= 0) & (ids <= MAX_ID), ids, UNKNOWN_ID)
