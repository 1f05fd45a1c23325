"""Numpy arrays to ROS messages, each laid out once for what is published and what is recorded.

Stamps are nanoseconds, positions metres, poses (4, 4), body velocities (6,) ordered (Ω, v) in
rad/s and m/s, covariances (6, 6) ordered (rotation, position), ids (n,), points (n, 3).
Markers are for RViz and Foxglove. The state itself goes out most often, so it is serialised
without an object for each part: rclpy's publishers and recordings take these bytes as they are. Of
each type all but the stamp and a run of float64 is the same in every message, so one is a copy
of the one before with these replaced.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
import struct
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import Update
from slam_observer_ros.events import AZIMUTH, BEARING, MAX_ID, POINT, RANGE, UNKNOWN_ID
from slam_observer_ros.lie import so3
from slam_observer_ros.messages.cdr import ENCAPSULATION_BYTES, encode_string
from slam_observer_ros.messages.clouds import (
    COVARIANCE_NAMES,
    FLOAT32_ID_LIMIT,
    ID_NAME,
    NO_RANGE_NAME,
    POINT_FIELD_FLOAT32,
    POINT_FIELD_UINT32,
    POINT_NAMES,
    RANGE_NAME,
    RANGE_VARIANCE_NAME,
    UNKNOWN_UINT32_ID,
    VELOCITY_NAMES,
)

_MATRIX_TO_UPPER_TRIANGLE = [0, 1, 2, 4, 5, 8]
_PACK_STAMP = struct.Struct('<BBBBiI')


class OutgoingMessages:
    """Makes messages of rclpy's classes or of rosbags', which have the same fields.

    Every float field gets a Python float: rclpy does not check that. ``class_of`` returns the
    class of a type such as ``geometry_msgs/msg/Pose``, ``octets`` bytes as a field ``uint8[]``.
    """

    def __init__(
        self, class_of: Callable[[str], Callable[..., Any]], octets: Callable[[bytes], Any]
    ) -> None:
        self._class_of, self.octets = class_of, octets

    def time(self, stamp_ns: int) -> Any:
        """Make a builtin_interfaces/Time."""
        seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS_PER_SECOND)
        return self.make('builtin_interfaces/msg/Time', sec=seconds, nanosec=nanoseconds)

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        """Make a std_msgs/Header."""
        return self.make('std_msgs/msg/Header', stamp=self.time(stamp_ns), frame_id=frame_id)

    def point(self, position: FloatArray) -> Any:
        """Make a geometry_msgs/Point of a position (3,)."""
        x, y, z = position.tolist()
        return self.make('geometry_msgs/msg/Point', x=x, y=y, z=z)

    def vector(self, components: FloatArray) -> Any:
        """Make a geometry_msgs/Vector3 of its components (3,)."""
        x, y, z = components.tolist()
        return self.make('geometry_msgs/msg/Vector3', x=x, y=y, z=z)

    def quaternion(self, rotation: FloatArray) -> Any:
        """Make a geometry_msgs/Quaternion of a rotation matrix (3, 3)."""
        x, y, z, w = so3.to_quaternion(rotation).tolist()
        return self.make('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w)

    def pose(self, pose: FloatArray) -> Any:
        """Make a geometry_msgs/Pose."""
        position, orientation = self.point(pose[:3, 3]), self.quaternion(pose[:3, :3])
        return self.make('geometry_msgs/msg/Pose', position=position, orientation=orientation)

    def pose_stamped(self, stamp_ns: int, frame_id: str, pose: FloatArray) -> Any:
        """Make a geometry_msgs/PoseStamped."""
        header = self.header(stamp_ns, frame_id)
        return self.make('geometry_msgs/msg/PoseStamped', header=header, pose=self.pose(pose))

    def transform_stamped(self, stamp_ns: int, parent: str, child: str, pose: FloatArray) -> Any:
        """Make a geometry_msgs/TransformStamped of the pose of ``child`` in ``parent``."""
        transform = self.make(
            'geometry_msgs/msg/Transform',
            translation=self.vector(pose[:3, 3]),
            rotation=self.quaternion(pose[:3, :3]),
        )
        return self.make(
            'geometry_msgs/msg/TransformStamped',
            header=self.header(stamp_ns, parent),
            child_frame_id=child,
            transform=transform,
        )

    def twist(self, body_velocity: FloatArray) -> Any:
        """Make a geometry_msgs/Twist."""
        angular, linear = self.vector(body_velocity[:3]), self.vector(body_velocity[3:])
        return self.make('geometry_msgs/msg/Twist', linear=linear, angular=angular)

    def twist_stamped(self, stamp_ns: int, frame_id: str, body_velocity: FloatArray) -> Any:
        """Make a geometry_msgs/TwistStamped."""
        header, twist = self.header(stamp_ns, frame_id), self.twist(body_velocity)
        return self.make('geometry_msgs/msg/TwistStamped', header=header, twist=twist)

    def point_cloud2(
        self,
        stamp_ns: int,
        frame_id: str,
        ids: IntArray,
        points: FloatArray,
        covariances: FloatArray | None = None,
        velocities: FloatArray | None = None,
        kinds: IntArray | None = None,
    ) -> Any:
        """Make a sensor_msgs/PointCloud2: x y z float32, id uint32, and what else is given.

        RViz and Foxglove display these fields. Covariances are (n, 3, 3), m², and velocities of
        the landmarks themselves (n, 3), m/s. ``UNKNOWN_ID`` becomes 2³² - 1; any other id that
        doesn't fit into a uint32 raises a MessageError. Of half points, ``kinds`` (n,), a cloud
        holds ranges alone, or bearings among whole points: others raise a MessageError, too.
        """
        if kinds is not None and len(kinds) and (kinds == RANGE).all():
            columns = _of_ranges(ids, points, covariances)
        else:
            columns = _of_points(ids, points, covariances, velocities, kinds)
        # One record a point, little endian, every field of four bytes
        dtype = [(name, '<u4' if name in _INTEGERS else '<f4') for name in columns]
        records: NDArray[np.void] = np.empty(len(ids), dtype=dtype)
        for name, column in columns.items():
            records[name] = column
        fields = [
            self.make(
                'sensor_msgs/msg/PointField',
                name=name,
                offset=4 * index,
                datatype=POINT_FIELD_UINT32 if name in _INTEGERS else POINT_FIELD_FLOAT32,
                count=1,
            )
            for index, name in enumerate(columns)
        ]
        return self.make(
            'sensor_msgs/msg/PointCloud2',
            header=self.header(stamp_ns, frame_id),
            height=1,
            width=len(records),
            fields=fields,
            is_bigendian=False,
            point_step=records.itemsize,
            row_step=records.nbytes,
            data=self.octets(records.tobytes()),
            is_dense=True,
        )

    def make(self, type_name: str, **fields: Any) -> Any:
        """Make a message of a type such as ``geometry_msgs/msg/Pose`` from all its fields."""
        return self._class_of(type_name)(**fields)


def encode_point_cloud(stamp_ns: int, frame_id: str, ids: IntArray, points: FloatArray) -> bytes:
    """Serialise a sensor_msgs/PointCloud with a channel ``id`` as little-endian CDR.

    An rclpy publisher sends such bytes as they are, without an object per point. Raises a
    MessageError if an id isn't exact in float32.
    """
    if np.any((ids < UNKNOWN_ID) | (ids >= FLOAT32_ID_LIMIT)):
        raise MessageError(f'landmark ids in a PointCloud must lie between -1 and {2**24 - 1}')
    seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS_PER_SECOND)
    count = struct.pack('<I', len(points))
    return b''.join(
        (
            _PACK_STAMP.pack(0, 1, 0, 0, seconds, nanoseconds),
            encode_string(frame_id),
            count,
            points.astype('<f4').tobytes(),
            struct.pack('<I', 1),
            encode_string(ID_NAME),
            count,
            ids.astype('<f4').tobytes(),
        )
    )


_INTEGERS = (ID_NAME, NO_RANGE_NAME)  # fields that are uint32; the others are float32
_Columns: TypeAlias = dict[str, FloatArray | IntArray]


def _of_ids(ids: IntArray) -> _Columns:
    if np.any((ids < UNKNOWN_ID) | (ids > MAX_ID)):
        raise MessageError('landmark ids must lie between 0 and 2³² - 2, or be -1 for unknown')
    return {ID_NAME: ids & UNKNOWN_UINT32_ID}


def _of_points(
    ids: IntArray,
    points: FloatArray,
    covariances: FloatArray | None,
    velocities: FloatArray | None,
    kinds: IntArray | None,
) -> _Columns:
    """Return the fields of whole points, and of bearings among them."""
    columns: _Columns = dict(zip(POINT_NAMES, points.T, strict=True))
    columns |= _of_ids(ids)
    if covariances is not None:
        upper_triangles = covariances.reshape(-1, 9)[:, _MATRIX_TO_UPPER_TRIANGLE]
        columns |= zip(COVARIANCE_NAMES, upper_triangles.T, strict=True)
    if velocities is not None:
        columns |= zip(VELOCITY_NAMES, velocities.T, strict=True)
    if kinds is not None:
        if not np.isin(kinds, (POINT, BEARING)).all():
            raise MessageError('a cloud has no fields for ranges or azimuths beside other points')
        columns[NO_RANGE_NAME] = kinds == BEARING
    return columns


def _of_ranges(ids: IntArray, points: FloatArray, covariances: FloatArray | None) -> _Columns:
    """Return the fields of ranges alone, whose covariance is along their line of sight."""
    ranges = np.linalg.norm(points, axis=1)
    columns: _Columns = _of_ids(ids) | {RANGE_NAME: ranges}
    if covariances is not None:
        along = points / np.maximum(ranges, np.finfo(np.float64).tiny)[:, None]
        columns[RANGE_VARIANCE_NAME] = np.einsum('mi,mij,mj->m', along, covariances, along)
    return columns


PATH_SPACING_NS = 100_000_000  # least time between two poses of the path, nanoseconds
POINT_SIZE_M = 0.2
TEXT_HEIGHT_M = 0.3
LINE_WIDTH_M = 0.03
ARROW_LENGTH_M, ARROW_WIDTH_M = 1.0, 0.15
GREEN = (0.0, 0.62, 0.45, 1.0)  # red, green, blue, opacity
WHITE = (1.0, 1.0, 1.0, 1.0)
PALE_GREEN = (0.0, 0.62, 0.45, 0.3)
ORANGE = (0.84, 0.37, 0.0, 1.0)
PINK = (0.8, 0.47, 0.65, 1.0)
SKY = (0.34, 0.71, 0.91, 0.8)
MAX_RINGS = 20  # of 36 lines each
RING = np.linspace(0.0, 2.0 * np.pi, 37)
MAX_LABELS = 200  # more could not be read, and each is a message of its own
ELLIPSOID_SIGMAS = 3.0  # half axes, in standard deviations
MIN_SIZE_M = 1e-3  # RViz complains about markers without a size

# Of visualization_msgs/Marker
ADD, DELETEALL = 0, 3
ARROW, SPHERE, LINE_LIST, SPHERE_LIST, TEXT_VIEW_FACING = 0, 2, 5, 7, 9


def half_sights(
    update: Update, ids: IntArray, points: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return what was measured of landmarks ``ids`` (n,) at ``points`` (n, 3) by half, metres.

    Of distances (r, 3): x, y of the landmark and the radius, in the plane, of a circle on which
    the robot is. Of directions (b, 3): the point in that direction that is as far as the landmark.
    """
    if update.kinds is None:
        return np.empty((0, 3)), np.empty((0, 3))
    _, seen, rows = np.intersect1d(update.ids, ids, return_indices=True)
    kinds, centres = update.kinds[seen], points[rows]
    ends = centres + update.residuals[seen]
    radii = np.linalg.norm((ends - update.pose[:3, 3])[:, :2], axis=1)
    is_range = kinds == RANGE
    rings = np.column_stack([centres[is_range, :2], radii[is_range]])
    return rings, ends[np.isin(kinds, (BEARING, AZIMUTH))]


class EstimateMessages:
    """Makes what says where the robot was and its landmarks are, in ``map_frame``.

    Stamps are nanoseconds, poses (4, 4); ids (n,), points (n, 3) in metres and covariances
    (n, 3, 3) in m², None if unknown. Markers are of the classes that ``messages`` makes.
    """

    def __init__(self, messages: OutgoingMessages, map_frame: str) -> None:
        self._messages, self._map_frame = messages, map_frame

    def path_pose(self, stamp_ns: int, pose: FloatArray) -> Any:
        """Make one pose of the path."""
        return self._messages.pose_stamped(stamp_ns, self._map_frame, pose)

    def path(self, stamp_ns: int, poses: Sequence[Any]) -> Any:
        """Make a nav_msgs/Path of what :meth:`path_pose` has made."""
        header = self._messages.header(stamp_ns, self._map_frame)
        return self._messages.make('nav_msgs/msg/Path', header=header, poses=list(poses))

    def landmarks(
        self,
        stamp_ns: int,
        ids: IntArray,
        world_points: FloatArray,
        covariances: FloatArray | None,
        velocities: FloatArray,
    ) -> Any:
        """Make a sensor_msgs/PointCloud2 of landmarks; with velocities if one of them moves."""
        moving = velocities if velocities.any() else None
        return self._messages.point_cloud2(
            stamp_ns, self._map_frame, ids, world_points, covariances, moving
        )

    def value(self, value: float) -> Any:
        """Make a std_msgs/Float64."""
        return self._messages.make('std_msgs/msg/Float64', data=float(value))

    def markers(
        self,
        stamp_ns: int,
        ids: IntArray,
        points: FloatArray,
        covariances: FloatArray | None,
        update: Update | None,
        doubted_ids: IntArray,
    ) -> Any:
        """Make a MarkerArray that replaces all earlier markers.

        They are points, those in doubt in another colour, ids, the last residuals, distances and
        directions, and, where covariances are known, ellipsoids.
        """
        header = self._messages.header(stamp_ns, self._map_frame)
        if not len(points):
            return self._replacing(header, [])
        spheres, in_doubt = [], np.isin(ids, doubted_ids)
        for namespace, color, rows in (
            ('landmarks', GREEN, ~in_doubt),
            ('in doubt', PINK, in_doubt),
        ):
            if namespace == 'landmarks' or rows.any():
                marker = self._marker(header, namespace, SPHERE_LIST, color, POINT_SIZE_M)
                marker.points = [self._messages.point(point) for point in points[rows]]
                spheres.append(marker)
        # From each landmark just seen to where it was seen
        lines = self._marker(header, 'residuals', LINE_LIST, ORANGE, LINE_WIDTH_M)
        halves: list[Any] = []
        if update is not None:
            _, seen, at = np.intersect1d(update.ids, ids, return_indices=True)
            ends = np.stack((points[at], points[at] + update.residuals[seen]), axis=1)
            lines.points = [self._messages.point(point) for point in ends.reshape(-1, 3)]
            halves = self._halves(header, ids, points, update)
        ellipsoids = self._ellipsoids(header, points, covariances)
        labels = []
        for number, landmark_id in enumerate(ids[:MAX_LABELS].tolist()):
            label = self._marker(header, 'ids', TEXT_VIEW_FACING, WHITE, TEXT_HEIGHT_M)
            label.id, label.text = number, str(landmark_id)
            label.pose.position = self._messages.point(points[number] + [0.0, 0.0, TEXT_HEIGHT_M])
            labels.append(label)
        return self._replacing(header, [*spheres, lines, *halves, *ellipsoids, *labels])

    def no_markers(self, stamp_ns: int) -> Any:
        """Make what removes all earlier markers."""
        return self._replacing(self._messages.header(stamp_ns, self._map_frame), [])

    def places(self, stamp_ns: int, poses: FloatArray) -> Any:
        """Make arrows, in place of all earlier markers, at poses (q, 4, 4) of a lost robot."""
        header = self._messages.header(stamp_ns, self._map_frame)
        arrows = []
        for number, pose in enumerate(poses[:MAX_LABELS]):
            arrow = self._marker(header, 'possible places', ARROW, ORANGE, ARROW_WIDTH_M)
            arrow.id = number
            arrow.pose = self._messages.pose(pose)
            arrow.scale.x = ARROW_LENGTH_M
            arrows.append(arrow)
        return self._replacing(header, arrows)

    def _replacing(self, header: Any, markers: list[Any]) -> Any:
        removal = self._marker(header, '', 0, WHITE, 0.0, action=DELETEALL)
        array = 'visualization_msgs/msg/MarkerArray'
        return self._messages.make(array, markers=[removal, *markers])

    def _ellipsoids(
        self, header: Any, points: FloatArray, covariances: FloatArray | None
    ) -> list[Any]:
        """Return an ellipsoid for each of the first landmarks; none if no covariance is known."""
        if covariances is None:
            return []
        variances, axes = np.linalg.eigh(covariances[:MAX_LABELS])
        axes *= np.linalg.det(axes)[:, None, None]  # a rotation, not a reflection
        sizes_m = 2.0 * ELLIPSOID_SIGMAS * np.sqrt(np.maximum(variances, 0.0))
        markers = []
        for number, (point, size, turn) in enumerate(zip(points, sizes_m, axes, strict=False)):
            marker = self._marker(header, 'uncertainties', SPHERE, PALE_GREEN, MIN_SIZE_M)
            marker.id = number
            marker.pose.position = self._messages.point(point)
            marker.pose.orientation = self._messages.quaternion(turn)
            marker.scale = self._messages.vector(np.maximum(size, MIN_SIZE_M))
            markers.append(marker)
        return markers

    def _halves(self, header: Any, ids: IntArray, points: FloatArray, update: Update) -> list[Any]:
        """Return circles of distances about their landmarks, and lines in directions, if any."""
        rings, ends = half_sights(update, ids, points)
        robot = update.pose[:3, 3]
        around = np.column_stack([np.cos(RING), np.sin(RING)])
        circles = [
            np.column_stack([ring[:2] + ring[2] * around, np.full(len(RING), robot[2])])
            for ring in rings[:MAX_RINGS]
        ]
        pairs = {
            'ranges': [np.stack([circle[:-1], circle[1:]], axis=1) for circle in circles],
            'bearings': [np.stack([np.tile(robot, (len(ends), 1)), ends], axis=1)],
        }
        markers = []
        for namespace, lines in pairs.items():
            marker = self._marker(header, namespace, LINE_LIST, SKY, LINE_WIDTH_M)
            joined = np.concatenate([np.empty((0, 3)), *(each.reshape(-1, 3) for each in lines)])
            marker.points = [self._messages.point(point) for point in joined]
            if marker.points:
                markers.append(marker)
        return markers

    def _marker(
        self,
        header: Any,
        namespace: str,
        kind: int,
        color: tuple[float, ...],
        size_m: float,
        action: int = ADD,
    ) -> Any:
        make, messages = self._messages.make, self._messages
        red, green, blue, opacity = color
        return make(
            'visualization_msgs/msg/Marker',
            header=header,
            ns=namespace,
            id=0,
            type=kind,
            action=action,
            pose=messages.pose(np.eye(4)),
            scale=messages.vector(np.full(3, size_m)),
            color=make('std_msgs/msg/ColorRGBA', r=red, g=green, b=blue, a=opacity),
            lifetime=make('builtin_interfaces/msg/Duration', sec=0, nanosec=0),
            frame_locked=False,
            points=[],
            colors=[],
            texture_resource='',
            texture=make(
                'sensor_msgs/msg/CompressedImage',
                header=messages.header(0, ''),
                format='',
                data=messages.octets(b''),
            ),
            uv_coordinates=[],
            text='',
            mesh_resource='',
            mesh_file=make(
                'visualization_msgs/msg/MeshFile', filename='', data=messages.octets(b'')
            ),
            mesh_use_embedded_materials=False,
        )


LITTLE_ENDIAN = bytes((0, 1, 0, 0))
POSE_NUMBERS, TWIST_NUMBERS, COVARIANCE_NUMBERS = 7, 6, 36
UNCERTAIN_NUMBERS = POSE_NUMBERS + COVARIANCE_NUMBERS
_STAMP = struct.Struct('<iI')
_LINEAR_FIRST = np.array([3, 4, 5, 0, 1, 2])
_UNKNOWN = np.array([-1.0] + [0.0] * 35)
_COVARIANCE_ENTRIES = (6 * _LINEAR_FIRST[:, None] + _LINEAR_FIRST).ravel()


class StateMessages:
    """Makes messages of the base's pose in the map; as bytes, by the names of their frames."""

    def __init__(self, map_frame: str, base_frame: str) -> None:
        self._pose = _Layout((map_frame,), UNCERTAIN_NUMBERS)
        self._odometry = _Layout(
            (map_frame, base_frame), UNCERTAIN_NUMBERS + TWIST_NUMBERS + COVARIANCE_NUMBERS
        )

    def pose(self, stamp_ns: int, uncertain: FloatArray) -> bytes:
        """Make a geometry_msgs/PoseWithCovarianceStamped of what ``uncertain_pose`` returns."""
        return self._pose.message(stamp_ns, uncertain)

    def odometry(
        self,
        stamp_ns: int,
        uncertain: FloatArray,
        body_velocity: FloatArray,
        covariance: FloatArray | None,
    ) -> bytes:
        """Make a nav_msgs/Odometry of the same and a velocity; its covariance None if unknown."""
        velocity = body_velocity[_LINEAR_FIRST]
        return self._odometry.message(stamp_ns, uncertain, velocity, _covariance(covariance))


def uncertain_pose(pose: FloatArray, covariance: FloatArray | None) -> FloatArray:
    """Return a PoseWithCovariance's (43,) numbers; its covariance along map axes, or None."""
    return np.concatenate((*_position_and_quaternion(pose), _covariance(covariance)))


def encode_transform(stamp_ns: int, parent: str, child: str, pose: FloatArray) -> bytes:
    """Serialise a tf2_msgs/TFMessage of the pose of frame ``child`` in frame ``parent``."""
    layout = _kept_layout((parent, child), POSE_NUMBERS, of_sequence=True)
    return layout.message(stamp_ns, *_position_and_quaternion(pose))


def _covariance(covariance: FloatArray | None) -> FloatArray:
    """Return 36 numbers, position first; −1 first, as in Imu, if the covariance is unknown."""
    if covariance is None:
        return _UNKNOWN
    numbers: FloatArray = covariance.ravel()[_COVARIANCE_ENTRIES]
    return numbers


def _position_and_quaternion(pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return position (3,) and quaternion (4,) xyzw."""
    return pose[:3, 3], so3.to_quaternion(pose[:3, :3])


class _Layout:
    """A little-endian message of a stamp, strings that never change and then float64 alone."""

    def __init__(self, strings: tuple[str, ...], numbers: int, of_sequence: bool = False) -> None:
        count = struct.pack('<I', 1) if of_sequence else b''
        self._stamp_at = ENCAPSULATION_BYTES + len(count)
        head = LITTLE_ENDIAN + count + bytes(_STAMP.size)
        head += b''.join(encode_string(string) for string in strings)
        head += bytes((ENCAPSULATION_BYTES - len(head)) % 8)
        self._bytes = bytearray(head + bytes(8 * numbers))
        self._numbers = np.frombuffer(self._bytes, '<f8', offset=len(head))

    def message(self, stamp_ns: int, *numbers: FloatArray) -> bytes:
        """Return the message with this stamp and these numbers, one part after the other."""
        _STAMP.pack_into(self._bytes, self._stamp_at, *divmod(stamp_ns, NANOSECONDS_PER_SECOND))
        np.concatenate(numbers, out=self._numbers)
        return bytes(self._bytes)


_kept_layout = lru_cache(maxsize=8)(_Layout)
