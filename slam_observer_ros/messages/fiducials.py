"""Landmarks as packages give them: fiducials, Cartographer's and MRPT's, ranges of radios.

Messages are read from their bytes, so that none of the packages that define them is needed here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from hashlib import sha256
import re

import numpy as np

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.events import AZIMUTH_RANGE, MAX_ID, ObservationEvent, UNKNOWN_ID
from slam_observer_ros.lie import so3
from slam_observer_ros.messages.cdr import CdrReader
from slam_observer_ros.messages.clouds import is_measured, observed_ranges
from slam_observer_ros.messages.registry import reads

_POSE = 7
_COVARIANCE = 36
_CENTRE_AND_CORNERS = 15
NESTED = f'{"=" * 80}\nMSG: '  # what comes before the name of a nested type in a definition


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
    tags = []
    for _ in range(reader.uint32()):
        reader.string()  # family
        number = reader.int32()
        reader.float64(_CENTRE_AND_CORNERS)
        reader.header()
        tags.append((number, reader.float64(_POSE + _COVARIANCE)))
    ids, values = as_arrays(tags, _POSE + _COVARIANCE)
    return observed_poses(frame_id, stamp_ns, _usable(ids), values)


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
    return observed_poses(frame_id, stamp_ns, *as_arrays(markers, _POSE))


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


def as_arrays(
    entries: Sequence[tuple[int, FloatArray]], width: int
) -> tuple[IntArray, FloatArray]:
    """Return ids (m,) and values (m, width) of entries that each have an id and its values."""
    ids = np.array([number for number, _ in entries], dtype=np.int64)
    return ids, np.array([values for _, values in entries]).reshape(-1, width)


def observed_poses(
    frame_id: str, stamp_ns: int, ids: IntArray, values: FloatArray
) -> ObservationEvent:
    """Return landmarks seen in one frame, at poses (m, 7), position first, or with more (m, 43).

    Covariances (6, 6) are behind the poses then, or zero: positions' are used if all are known.
    """
    poses, covariances, turns = values[:, :_POSE], None, None
    if values.shape[1] > _POSE:
        pose_covariances = values[:, _POSE:].reshape(-1, 6, 6)
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


def _usable(ids: IntArray) -> IntArray:
    """Return the unknown id in place of any that could not be published."""
    return np.where((ids >= 0) & (ids <= MAX_ID), ids, UNKNOWN_ID)


FIRST_NAMED_ID = 2**31  # names have ids from here on: people give landmarks smaller numbers
MAX_NAMES = 10_000  # names in a run: more are ids that change with each message, as of a tracker


class LandmarkNames:
    """Gives landmarks whose id is a text their number: the same in every run, as maps need it.

    A text that is a number is that number, and any other one has 31 bits of its SHA-256. Whether
    two have the same is known of those that came in this process.
    """

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}
        self._names: dict[int, str] = {}

    def number_of(self, name: str) -> int:
        """Return the id of a landmark; MessageError if another one has it already."""
        if name in ('', '-1'):
            return UNKNOWN_ID
        if name in self._numbers:
            return self._numbers[name]
        number = FIRST_NAMED_ID + _hash_of(name)
        if name.isascii() and name.isdigit() and len(name) <= len(str(MAX_ID)):
            # With zeros before the number it is a name.
            number = int(name) if str(int(name)) == name and int(name) <= MAX_ID else number
        if number < FIRST_NAMED_ID:
            return number
        if number in self._names:
            raise MessageError(
                f"the landmarks '{self._names[number]}' and '{name}' both have the number "
                f'{number}: rename one of them'
            )
        if len(self._numbers) == MAX_NAMES:
            raise MessageError(
                f"more than {MAX_NAMES} names of landmarks, the last one '{name}': each needs the "
                'same id whenever it is seen'
            )
        self._numbers[name], self._names[number] = number, name
        return number


NAMES = LandmarkNames()  # the names of all landmarks that have been read in this process


@reads(
    'cartographer_ros_msgs/msg/LandmarkList',
    role='landmarks',
    package='drivers for Cartographer',
    definition=(
        'std_msgs/Header header\nLandmarkEntry[] landmarks\n'
        f'{NESTED}cartographer_ros_msgs/LandmarkEntry\n'
        'string id\ngeometry_msgs/Pose tracking_from_landmark_transform\n'
        'float64 translation_weight\nfloat64 rotation_weight\n'
    ),
)
def decode_landmark_list(reader: CdrReader) -> ObservationEvent:
    """Read a cartographer_ros_msgs/LandmarkList, whose poses are in the frame of its header.

    Cartographer's residuals are errors times their weight, so standard deviations are 1/weight.
    With a translation's weight of zero that is unknown; with a rotation's the rotation is unused.
    """
    stamp_ns, frame_id = reader.header()
    entries = [(reader.string(), reader.float64(_POSE + 2)) for _ in range(reader.uint32())]
    ids, values = as_arrays([(NAMES.number_of(name), each) for name, each in entries], _POSE + 2)
    with np.errstate(divide='ignore', over='ignore', invalid='ignore'):
        variances = values[:, _POSE:] ** -2.0
    variances[~np.isfinite(variances)] = 0.0
    poses = values[:, :_POSE]
    poses[variances[:, 1] == 0.0, 3:] = 0.0
    covariances = np.repeat(variances, 3, axis=1)[:, :, None] * np.eye(6)
    both = np.concatenate([poses, covariances.reshape(-1, _COVARIANCE)], axis=1)
    return observed_poses(frame_id, stamp_ns, ids, both)


@reads(
    'mrpt_msgs/msg/ObservationRangeBearing',
    role='landmarks',
    package='mrpt_slam',
    definition=(
        'std_msgs/Header header\ngeometry_msgs/Pose sensor_pose_on_robot\n'
        'float64 min_sensor_distance\nfloat64 max_sensor_distance\n'
        'float64 sensor_std_range\nfloat64 sensor_std_yaw\nfloat64 sensor_std_pitch\n'
        'SingleRangeBearingObservation[] sensed_data\n'
        f'{NESTED}mrpt_msgs/SingleRangeBearingObservation\n'
        'float64 range\nfloat64 yaw\nfloat64 pitch\nint32 id\n'
    ),
)
def decode_range_bearing(reader: CdrReader) -> ObservationEvent:
    """Read an mrpt_msgs/ObservationRangeBearing, whose pitch is positive downwards, about y.

    The sensor is where its frame is on /tf; ``sensor_pose_on_robot`` says the same without the
    name of the base's frame, and is not used.
    """
    stamp_ns, frame_id = reader.header()
    reader.float64(_POSE + 2)  # the sensor's pose, and its least and largest range
    deviations = reader.float64(3)
    sensed = [(reader.float64(3), reader.int32()) for _ in range(reader.uint32())]
    numbers, measured = as_arrays([(number, value) for value, number in sensed], 3)
    usable = is_measured(measured) & (measured[:, 0] > 0.0)
    ids: IntArray = np.where(numbers >= 0, numbers, UNKNOWN_ID)[usable]
    points, axes = _along_and_across(measured[usable])
    covariances = _polar_covariances(measured[usable, 0], axes, deviations)
    return ObservationEvent(stamp_ns, ids, points, covariances, sensor_frame=frame_id)


def _hash_of(name: str) -> int:
    digest = int.from_bytes(sha256(name.encode()).digest()[:8], 'big')
    return digest % (MAX_ID + 1 - FIRST_NAMED_ID)


def _along_and_across(measured: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return points (m, 3) of range, yaw and pitch, and axes (m, 3, 3): along, yaw, pitch."""
    yaw, pitch = measured[:, 1], measured[:, 2]
    zero = np.zeros_like(yaw)
    level = np.stack([np.cos(yaw), np.sin(yaw), zero], axis=1)
    left = np.stack([-np.sin(yaw), np.cos(yaw), zero], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    cosines, sines = np.cos(pitch)[:, None], np.sin(pitch)[:, None]
    along = cosines * level - sines * up
    down = -sines * level - cosines * up
    return measured[:, :1] * along, np.stack([along, left, down], axis=2)


def _polar_covariances(
    ranges: FloatArray, axes: FloatArray, deviations: FloatArray
) -> FloatArray | None:
    """Return covariances (m, 3, 3) of range, yaw and pitch (0: as the yaw); None if unknown."""
    of_range, of_yaw, of_pitch = deviations
    if not (np.isfinite(deviations).all() and of_range > 0.0 and of_yaw > 0.0):
        return None
    across = ranges[:, None] * [of_yaw, of_pitch if of_pitch > 0.0 else of_yaw]
    scaled = axes * np.insert(across, 0, of_range, axis=1)[:, None, :]
    with np.errstate(over='ignore', invalid='ignore'):
        covariances: FloatArray = scaled @ scaled.swapaxes(1, 2)
    return covariances if np.isfinite(covariances).all() else None


@reads(
    'mrpt_msgs/msg/ObservationRangeBeacon',
    role='landmarks',
    package='mrpt_slam',
    definition=(
        'std_msgs/Header header\ngeometry_msgs/Pose sensor_pose_on_robot\n'
        'float64 min_sensor_distance\nfloat64 max_sensor_distance\nfloat64 sensor_std_range\n'
        'SingleRangeBeaconObservation[] sensed_data\n'
        f'{NESTED}mrpt_msgs/SingleRangeBeaconObservation\nfloat64 range\nint32 id\n'
    ),
)
def decode_range_beacon(reader: CdrReader) -> ObservationEvent:
    """Read an mrpt_msgs/ObservationRangeBeacon, placed as an ObservationRangeBearing is."""
    stamp_ns, frame_id = reader.header()
    deviation_m = float(reader.float64(_POSE + 3)[-1])
    sensed = [(reader.float64(1), reader.int32()) for _ in range(reader.uint32())]
    ids, ranges = as_arrays([(number, value) for value, number in sensed], 1)
    variance = deviation_m * deviation_m if deviation_m > 0.0 else 0.0
    variances = np.full(len(ids), variance if np.isfinite(variance) else 0.0)
    return observed_ranges(frame_id, stamp_ns, _usable(ids), ranges[:, 0], variances)


def _register_linktrack(frame: str, own: str, own_numbers: int, node: str, angle: str) -> None:
    """Read a frame of LinkTrack by the driver's package and by its port, which adds a header.

    ``own`` are ``own_numbers`` fields of the receiver itself. The ids of nodes start again in each
    role. The direction, if ``angle`` is measured, is in degrees from x towards y.
    """
    for package, header in (
        ('nlink_parser', ''),
        ('nlink_parser_ros2_interfaces', 'std_msgs/Header header\n'),
    ):

        @reads(
            f'{package}/msg/{frame}',
            role='landmarks',
            package='LinkTrack',
            definition=(
                f'{header}uint8 role\nuint8 id\nuint32 local_time\nuint32 system_time\n'
                f'float32 voltage\n{own}{node}[] nodes\n{NESTED}{package}/{node}\n'
                f'uint8 role\nuint8 id\nfloat32 dis\n{angle}float32 fp_rssi\nfloat32 rx_rssi\n'
            ),
        )
        def decode(reader: CdrReader, has_header: bool = bool(header)) -> ObservationEvent:
            stamp_ns, frame_id = reader.header() if has_header else (reader.receive_ns, '')
            for read in (reader.uint8, reader.uint8, reader.uint32, reader.uint32):
                read()
            reader.float32(1 + own_numbers)
            seen = [
                (reader.uint8(), reader.uint8(), *reader.float32(4 if angle else 3))
                for _ in range(reader.uint32())
            ]
            nodes = np.array(seen).reshape(-1, 6 if angle else 5)
            if angle:
                nodes = nodes[is_measured(nodes[:, 2:4])]
            ids, ranges = nodes[:, 1].astype(np.int64), nodes[:, 2]
            event = observed_ranges(frame_id, stamp_ns, ids, ranges)
            if not angle:
                return event
            turns = np.deg2rad(nodes[ranges > 0.0, 3])
            directions = np.stack([np.cos(turns), np.sin(turns), 0.0 * turns], axis=1)
            points = np.linalg.norm(event.points, axis=1)[:, None] * directions
            return replace(event, points=points, kinds=np.full(len(points), AZIMUTH_RANGE))


_register_linktrack(
    'LinktrackNodeframe2',
    'float32[3] pos_3d\nfloat32[3] eop_3d\nfloat32[3] vel_3d\nfloat32[3] angle_3d\n'
    'float32[4] quaternion\nfloat32[3] imu_gyro_3d\nfloat32[3] imu_acc_3d\n',
    22,
    'LinktrackNode2',
    '',
)
_register_linktrack('LinktrackNodeframe3', '', 0, 'LinktrackNode2', '')
_register_linktrack('LinktrackAoaNodeframe0', '', 0, 'LinktrackAoaNode0', 'float32 angle\n')


@reads(
    'marvelmind_ros2_msgs/msg/BeaconDistance',
    'marvelmind_nav/msg/beacon_distance',
    role='landmarks',
    package='Marvelmind',
    definition='uint8 address_hedge\nuint8 address_beacon\nfloat64 distance_m\n',
)
def decode_beacon_distance(reader: CdrReader) -> ObservationEvent:
    """Read a BeaconDistance of marvelmind_ros2_msgs, or of ROS 1: one of a stationary beacon."""
    reader.uint8()  # the mobile beacon
    beacon = np.array([reader.uint8()], dtype=np.int64)
    return observed_ranges('', reader.receive_ns, beacon, reader.float64(1))


_GTEC_RADIO = (
    'int32 max_noise\nint32 std_noise\nint32 first_path_amp1\nint32 first_path_amp2\n'
    'int32 first_path_amp3\nint32 max_growth_cir\nint32 rx_pream_count\nint32 first_path\n'
    'float64 channel\nint32 prf\nfloat64 datarate\nint32 preamble_length\nint32 pac_size\n'
)
# Fields behind the range, by type.
_GTEC = {
    'Ranging': 'int32 seq\nfloat64 rss\nfloat64 error_estimation\n',
    'GenericRanging': 'int32 seq\nfloat64 rx_power\n',
    'DWRanging': f'int32 rawrange\nint32 seq\n{_GTEC_RADIO}',
    'UWBRanging': (
        f'int32 rawrange\nint32 bias_correction\nint32 seq\n{_GTEC_RADIO}'
        'float64 error_estimation\n'
    ),
}


def _register_gtec(name: str, rest: str) -> None:
    @reads(
        f'gtec_msgs/msg/{name}',
        role='landmarks',
        package='GTEC',
        definition=f'int16 anchor_id\nint16 tag_id\nint32 range\n{rest}',
    )
    def decode(reader: CdrReader) -> ObservationEvent:
        """Read the distance of one anchor, whose message has millimetres."""
        anchor = np.array([reader.uint16()], dtype=np.int64)  # as radios have 16 bits of it
        reader.uint16()  # tag
        ranges = np.array([reader.int32() / 1e3])
        for field in rest.splitlines():
            if field.startswith('int32'):
                reader.int32()
            else:
                reader.float64(1)
        return observed_ranges('', reader.receive_ns, anchor, ranges)


for _name, _rest in _GTEC.items():
    _register_gtec(_name, _rest)


@reads('sensor_msgs/msg/Range', role='landmarks', is_ambiguous=True)
def decode_range(reader: CdrReader) -> ObservationEvent:
    """Read a sensor_msgs/Range within its limits, of the id that ends the frame's name."""
    stamp_ns, frame_id = reader.header()
    reader.uint8()  # radiation
    _, nearest, furthest, measured = reader.float32(4)
    variances = reader.float32(1) if reader.bytes_left else None
    number = re.search(r'\d{1,9}\Z', frame_id, re.ASCII)
    seen = nearest <= measured <= furthest
    ids = np.array([UNKNOWN_ID if number is None else int(number[0])], dtype=np.int64)
    ranges = np.array([measured if seen else np.nan])
    return observed_ranges(frame_id, stamp_ns, ids, ranges, variances)
