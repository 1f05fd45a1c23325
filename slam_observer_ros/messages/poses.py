"""Poses, transforms and velocities of ROS messages.

ROS puts linear before angular components; (9) and all arrays that leave here put angular first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import cast

import numpy as np
from numpy.typing import NDArray

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.events import AngularVelocityEvent, VelocityEvent
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.messages.cdr import CdrReader
from slam_observer_ros.messages.registry import Decoder, reads

TRANSFORMS = 'tf2_msgs/msg/TFMessage'  # poses of sensors, and landmarks if they are fiducials
_ANGULAR_FIRST = np.array([3, 4, 5, 0, 1, 2])
_NEARLY = 1.0 - 1e-9  # of a limit: what is below that is below the limit, however it is rounded


@dataclass(frozen=True, slots=True)
class PoseMessage:
    """The pose of ``child_frame_id``, empty if the message doesn't name it, in ``frame_id``."""

    stamp_ns: int
    frame_id: str
    child_frame_id: str
    position: FloatArray  # (3,) metres
    quaternion: FloatArray  # (4,) xyzw, of unit norm unless ``problem`` says that it isn't
    # (6, 6) of rotation vector and position in the axes of ``frame_id``; None if unknown
    covariance: FloatArray | None = None

    @property
    def sensor_frame(self) -> str:
        """The frame by which events distinguish sensors."""
        return self.frame_id

    @property
    def pose(self) -> FloatArray:
        """(4, 4) transform that takes points from ``child_frame_id`` to ``frame_id``."""
        return pose_matrices(self.position, self.quaternion)

    @property
    def problem(self) -> str:
        """Why it is no pose; empty if it is one."""
        if np.isfinite(self.position).all():
            return _quaternion_problem(self.quaternion)
        return 'a coordinate is NaN or infinite'


@dataclass(frozen=True, slots=True, eq=False)
class PoseBlock:
    """Poses of ``child_frame_id``, empty if messages don't name it; see :class:`.PoseMessage`."""

    stamps_ns: IntArray  # (k,)
    child_frame_id: str
    positions: FloatArray  # (k, 3)
    quaternions: FloatArray  # (k, 4)

    @classmethod
    def of(cls, message: PoseMessage) -> PoseBlock:
        """Return the pose of one message."""
        stamps_ns = np.array([message.stamp_ns], dtype=np.int64)
        positions, quaternions = message.position[None], message.quaternion[None]
        return cls(stamps_ns, message.child_frame_id, positions, quaternions)

    @property
    def poses(self) -> FloatArray:
        """(k, 4, 4) as :attr:`.PoseMessage.pose`."""
        return pose_matrices(self.positions, self.quaternions)


def decode_poses(
    decode: Decoder[PoseMessage], rows: NDArray[np.uint8], receive_ns: IntArray
) -> PoseBlock:
    """Decode messages (k, size) received at times (k,); MessageError if not all are alike."""
    read = decode.block(rows, receive_ns)
    stamps_ns = cast('IntArray', read.stamp_ns)
    return PoseBlock(stamps_ns, read.child_frame_id, read.position, read.quaternion)


def pose_stack(messages: Sequence[PoseMessage]) -> FloatArray:
    """Return the poses (m, 4, 4) of several messages, built at once."""
    positions = np.array([message.position for message in messages]).reshape(-1, 3)
    quaternions = np.array([message.quaternion for message in messages]).reshape(-1, 4)
    return pose_matrices(positions, quaternions)


def pose_matrices(positions: FloatArray, quaternions: FloatArray) -> FloatArray:
    """Return poses (..., 4, 4) of positions (..., 3), metres, and quaternions (..., 4) xyzw."""
    return se3.pose(so3.from_quaternion(quaternions), positions)


@reads('geometry_msgs/msg/PoseStamped', role='pose')
def decode_pose_stamped(reader: CdrReader) -> PoseMessage:
    """Read a geometry_msgs/PoseStamped."""
    return checked_pose(PoseMessage(*reader.header(), '', *read_pose(reader)))


@reads('geometry_msgs/msg/PoseWithCovarianceStamped', role='pose')
def decode_pose_with_covariance_stamped(reader: CdrReader) -> PoseMessage:
    """Read a geometry_msgs/PoseWithCovarianceStamped."""
    stamp_ns, frame_id = reader.header()
    pose, covariance = read_pose(reader), read_covariance(reader)
    return checked_pose(PoseMessage(stamp_ns, frame_id, '', *pose, covariance))


@reads('geometry_msgs/msg/TransformStamped', role='pose')
def decode_transform_stamped(reader: CdrReader) -> PoseMessage:
    """Read a geometry_msgs/TransformStamped."""
    return checked_pose(_read_transform(reader))


@Decoder
def decode_transforms(reader: CdrReader) -> list[PoseMessage]:
    """Read a tf2_msgs/TFMessage, whose bad transforms say so in ``problem``: others are good."""
    return [_read_transform(reader) for _ in range(reader.uint32())]


def _read_transform(reader: CdrReader) -> PoseMessage:
    return PoseMessage(*reader.header(), reader.string(), *read_pose(reader))


def read_pose(reader: CdrReader) -> tuple[FloatArray, FloatArray]:
    """Read a geometry_msgs/Pose or Transform: position (..., 3) and quaternion (..., 4) xyzw."""
    values = reader.float64(7)
    return values[..., :3], values[..., 3:]


def read_covariance(reader: CdrReader, size: int = 6) -> FloatArray | None:
    """Read covariances (..., size, size), of six rows angular first; None if they are unknown.

    There are two ways in which ROS messages say that. Some of a block may not be: MessageError.
    """
    values = reader.float64(size * size)
    covariances = values.reshape(*values.shape[:-1], size, size)
    is_unknown = (covariances[..., 0, 0] == -1.0) | ~values.any(axis=-1)
    if is_unknown.all():
        return None
    if is_unknown.any():
        raise MessageError('some of the covariances are unknown')
    if size == len(_ANGULAR_FIRST):
        return covariances[..., _ANGULAR_FIRST[:, None], _ANGULAR_FIRST]
    return covariances


def checked_pose(message: PoseMessage) -> PoseMessage:
    """Return a message, or one of a block; raise a MessageError if a quaternion is no rotation."""
    problem = _quaternion_problem(message.quaternion)
    if problem:
        raise MessageError(problem)
    return message


def _quaternion_problem(quaternion: FloatArray) -> str:
    """Return why a quaternion, or one of (k, 4), is no rotation; empty if it is one."""
    if quaternion.ndim > 1:
        with np.errstate(over='ignore'):
            norms = np.sqrt((quaternion**2).sum(axis=1))
        # Written so that NaN is refused too.
        are_turns = (np.abs(norms - 1.0) < _NEARLY * so3.QUATERNION_NORM_TOLERANCE).all()
        return '' if are_turns else 'a quaternion is no rotation, or nearly none'
    norm = math.hypot(*quaternion)  # which does not overflow
    is_turn = abs(norm - 1.0) < so3.QUATERNION_NORM_TOLERANCE
    return '' if is_turn else f'quaternion of norm {norm:.3g}, not 1'


ODOMETRY = 'nav_msgs/msg/Odometry'  # a velocity and a pose


@reads('geometry_msgs/msg/TwistStamped', role='velocity')
def decode_twist_stamped(reader: CdrReader) -> VelocityEvent:
    """Read a geometry_msgs/TwistStamped."""
    stamp_ns, frame_id = reader.header()
    return VelocityEvent(stamp_ns, _read_twist(reader), sensor_frame=frame_id)


@reads('geometry_msgs/msg/TwistWithCovarianceStamped', role='velocity')
def decode_twist_with_covariance_stamped(reader: CdrReader) -> VelocityEvent:
    """Read a geometry_msgs/TwistWithCovarianceStamped."""
    stamp_ns, frame_id = reader.header()
    velocity, covariance = _read_twist(reader), read_covariance(reader)
    return VelocityEvent(stamp_ns, velocity, covariance, sensor_frame=frame_id)


@reads('geometry_msgs/msg/Twist', role='velocity')
def decode_twist(reader: CdrReader) -> VelocityEvent:
    """Read a geometry_msgs/Twist, whose only time is when it was received."""
    return VelocityEvent(reader.receive_ns, _read_twist(reader))


@reads(ODOMETRY, role='velocity')
def decode_odometry_twist(reader: CdrReader) -> VelocityEvent:
    """Read the twist of a nav_msgs/Odometry, which is in its child frame."""
    stamp_ns, _ = reader.header()
    child_frame_id = reader.string()
    reader.float64(7 + 36)  # The pose and its covariance.
    velocity, covariance = _read_twist(reader), read_covariance(reader)
    return VelocityEvent(stamp_ns, velocity, covariance, sensor_frame=child_frame_id)


@reads(ODOMETRY, role='pose')
def decode_odometry_pose(reader: CdrReader) -> PoseMessage:
    """Read the pose of a nav_msgs/Odometry."""
    return checked_pose(_read_odometry(reader)[0])


@reads('sensor_msgs/msg/Imu', role='angular velocity')
def decode_imu(reader: CdrReader) -> AngularVelocityEvent:
    """Read the angular velocity of a sensor_msgs/Imu; MessageError if it has none (-1)."""
    stamp_ns, frame_id = reader.header()
    reader.float64(13)  # Orientation and its covariance.
    values = reader.float64(12)
    reader.float64(12)  # Linear acceleration and its covariance.
    covariance = values[3:].reshape(3, 3)
    if covariance[0, 0] == -1.0:
        raise MessageError('this Imu says that it measures no angular velocity')
    known = covariance if covariance.any() else None
    return AngularVelocityEvent(stamp_ns, values[:3], known, sensor_frame=frame_id)


def _read_odometry(reader: CdrReader) -> tuple[PoseMessage, VelocityEvent]:
    """Read pose, which may be none (``problem``), and twist of a nav_msgs/Odometry."""
    stamp_ns, frame_id = reader.header()
    child_frame_id = reader.string()
    pose = PoseMessage(
        stamp_ns, frame_id, child_frame_id, *read_pose(reader), read_covariance(reader)
    )
    velocity, covariance = _read_twist(reader), read_covariance(reader)
    return pose, VelocityEvent(stamp_ns, velocity, covariance, sensor_frame=child_frame_id)


decode_odometry = Decoder(_read_odometry)


def _read_twist(reader: CdrReader) -> FloatArray:
    values = reader.float64(6)
    return np.concatenate((values[..., 3:], values[..., :3]), axis=-1)
