"""Velocities, poses and transforms of ROS messages.

ROS puts linear before angular components; the paper's (9), and all arrays that leave this module,
put angular first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import AngularVelocityEvent, VelocityEvent
from slam_observer_ros.geometry import se3, so3
from slam_observer_ros.messages.cdr import Buffer, CdrReader
from slam_observer_ros.messages.measurement import Measurement

_ANGULAR_FIRST = np.array([3, 4, 5, 0, 1, 2])


@dataclass(frozen=True, slots=True)
class PoseMessage:
    """The pose of ``child_frame_id``, empty if the message doesn't name it, in ``frame_id``.

    Attributes
    ----------
    position : FloatArray
        (3,) metres.
    quaternion : FloatArray
        (4,) xyzw; of unit norm, but for transforms that say in ``problem`` that it isn't.
    covariance : FloatArray or None
        (6, 6) of rotation vector and position in the axes of ``frame_id``; None if unknown.

    """

    stamp_ns: int
    frame_id: str
    child_frame_id: str
    position: FloatArray
    quaternion: FloatArray
    covariance: FloatArray | None = None

    def with_stamp(self, stamp_ns: int) -> PoseMessage:
        """Return the same with another stamp, nanoseconds."""
        return replace(self, stamp_ns=stamp_ns)

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


def pose_stack(messages: Sequence[PoseMessage]) -> FloatArray:
    """Return the poses (m, 4, 4) of several messages, built at once."""
    positions = np.array([message.position for message in messages]).reshape(-1, 3)
    quaternions = np.array([message.quaternion for message in messages]).reshape(-1, 4)
    return pose_matrices(positions, quaternions)


def pose_matrices(positions: FloatArray, quaternions: FloatArray) -> FloatArray:
    """Return poses (..., 4, 4) of positions (..., 3), metres, and quaternions (..., 4) xyzw."""
    return se3.pose(so3.from_quaternion(quaternions), positions)


def decode_twist(raw: Buffer, receive_stamp_ns: int) -> Measurement[VelocityEvent]:
    """Decode a geometry_msgs/Twist, whose only time is that of its reception."""
    reader = CdrReader(raw)
    event = VelocityEvent(receive_stamp_ns, _read_twist(reader))
    reader.finish()
    return Measurement('', event)


def decode_twist_stamped(raw: Buffer, _receive_stamp_ns: int = 0) -> Measurement[VelocityEvent]:
    """Decode a geometry_msgs/TwistStamped."""
    reader = CdrReader(raw)
    stamp_ns, frame_id = reader.header()
    event = VelocityEvent(stamp_ns, _read_twist(reader))
    reader.finish()
    return Measurement(frame_id, event)


def decode_twist_with_covariance_stamped(
    raw: Buffer, _receive_stamp_ns: int = 0
) -> Measurement[VelocityEvent]:
    """Decode a geometry_msgs/TwistWithCovarianceStamped."""
    reader = CdrReader(raw)
    stamp_ns, frame_id = reader.header()
    event = VelocityEvent(stamp_ns, _read_twist(reader), _read_covariance(reader))
    reader.finish()
    return Measurement(frame_id, event)


def decode_odometry_twist(raw: Buffer, _receive_stamp_ns: int = 0) -> Measurement[VelocityEvent]:
    """Decode the twist of a nav_msgs/Odometry, which is in its child frame."""
    return decode_odometry(raw)[1]


def decode_odometry_pose(raw: Buffer, _receive_stamp_ns: int = 0) -> PoseMessage:
    """Decode the pose of a nav_msgs/Odometry."""
    return _checked(decode_odometry(raw)[0])


def decode_pose_stamped(raw: Buffer) -> PoseMessage:
    """Decode a geometry_msgs/PoseStamped."""
    reader = CdrReader(raw)
    message = PoseMessage(*reader.header(), '', *_read_pose(reader))
    reader.finish()
    return _checked(message)


def decode_pose_with_covariance_stamped(raw: Buffer) -> PoseMessage:
    """Decode a geometry_msgs/PoseWithCovarianceStamped."""
    reader = CdrReader(raw)
    message = PoseMessage(*reader.header(), '', *_read_pose(reader), _read_covariance(reader))
    reader.finish()
    return _checked(message)


def decode_transform_stamped(raw: Buffer) -> PoseMessage:
    """Decode a geometry_msgs/TransformStamped."""
    reader = CdrReader(raw)
    message = _read_transform(reader)
    reader.finish()
    return _checked(message)


def decode_transforms(raw: Buffer) -> list[PoseMessage]:
    """Decode a tf2_msgs/TFMessage, as on /tf and /tf_static.

    A bad transform says so in ``problem``: those beside it are of other frames, and good.
    """
    reader = CdrReader(raw)
    messages = [_read_transform(reader) for _ in range(reader.uint32())]
    reader.finish()
    return messages


def decode_imu(raw: Buffer, _receive_stamp_ns: int = 0) -> Measurement[AngularVelocityEvent]:
    """Decode the angular velocity of a sensor_msgs/Imu; MessageError if it has none (-1)."""
    reader = CdrReader(raw)
    stamp_ns, frame_id = reader.header()
    reader.float64(13)  # Orientation and its covariance.
    values = reader.float64(12)
    reader.float64(12)  # Linear acceleration and its covariance.
    reader.finish()
    angular_velocity, covariance = values[:3], values[3:].reshape(3, 3)
    if covariance[0, 0] == -1.0:
        raise MessageError('this Imu says that it measures no angular velocity')
    event = AngularVelocityEvent(stamp_ns, angular_velocity, _known(covariance))
    return Measurement(frame_id, event)


def _read_twist(reader: CdrReader) -> FloatArray:
    values = reader.float64(6)
    return np.concatenate((values[3:], values[:3]))


def _read_covariance(reader: CdrReader) -> FloatArray | None:
    """Read a 6 × 6 covariance; rotational part first."""
    covariance = _known(reader.float64(36).reshape(6, 6))
    return None if covariance is None else angular_first(covariance)


def angular_first(covariances: FloatArray) -> FloatArray:
    """Return covariances (…, 6, 6) as they are here, from ROS's order."""
    return covariances[..., _ANGULAR_FIRST[:, None], _ANGULAR_FIRST]


def _known(covariance: FloatArray) -> FloatArray | None:
    """Return None for the two ways in which ROS messages say 'unknown'."""
    if covariance[0, 0] == -1.0 or not covariance.any():
        return None
    return covariance


def _read_pose(reader: CdrReader) -> tuple[FloatArray, FloatArray]:
    values = reader.float64(7)
    return values[:3], values[3:]


def decode_odometry(raw: Buffer) -> tuple[PoseMessage, Measurement[VelocityEvent]]:
    """Decode pose, which may be none (``problem``), and twist of a nav_msgs/Odometry."""
    reader = CdrReader(raw)
    stamp_ns, frame_id = reader.header()
    child_frame_id = reader.string()
    pose = PoseMessage(
        stamp_ns, frame_id, child_frame_id, *_read_pose(reader), _read_covariance(reader)
    )
    velocity = VelocityEvent(stamp_ns, _read_twist(reader), _read_covariance(reader))
    reader.finish()
    return pose, Measurement(child_frame_id, velocity)


def _read_transform(reader: CdrReader) -> PoseMessage:
    return PoseMessage(*reader.header(), reader.string(), *_read_pose(reader))


def _checked(message: PoseMessage) -> PoseMessage:
    problem = _quaternion_problem(message.quaternion)
    if problem:
        raise MessageError(problem)
    return message


def _quaternion_problem(quaternion: FloatArray) -> str:
    """Return why a quaternion is no rotation; empty if it is one."""
    norm = math.hypot(*quaternion)  # which does not overflow
    # Written so that NaN is refused too.
    is_turn = abs(norm - 1.0) < so3.QUATERNION_NORM_TOLERANCE
    return '' if is_turn else f'quaternion of norm {norm:.3g}, not 1'
