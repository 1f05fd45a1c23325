"""The estimated state, serialised: what goes out most often, without an object for each part.

rclpy's publishers and recordings take these bytes as they are. Of each type all but the stamp and
a run of float64 is the same in every message, so that one is a copy of the one before with these
replaced. Stamps are nanoseconds, poses (4, 4), covariances (6, 6) ordered (rotation, position) and
body velocities (6,) ordered (Ω, v).
"""

from __future__ import annotations

from functools import lru_cache
import struct

import numpy as np

from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry import so3
from slam_observer_ros.messages.cdr import ENCAPSULATION_BYTES, encode_string

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
    """Return the (43,) numbers of a geometry_msgs/PoseWithCovariance; covariance None if unknown.

    It is along the map's axes, rad² and m².
    """
    return np.concatenate((*_position_and_quaternion(pose), _covariance(covariance)))


def encode_transform(stamp_ns: int, parent: str, child: str, pose: FloatArray) -> bytes:
    """Serialise a tf2_msgs/TFMessage of the pose of frame ``child`` in frame ``parent``."""
    return _transform_layout(parent, child).message(stamp_ns, *_position_and_quaternion(pose))


def _covariance(covariance: FloatArray | None) -> FloatArray:
    """Return 36 numbers, position first; −1 first, as in Imu, if the covariance is unknown."""
    if covariance is None:
        return _UNKNOWN
    numbers: FloatArray = covariance.ravel()[_COVARIANCE_ENTRIES]
    return numbers


def _position_and_quaternion(pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return position (3,) and quaternion (4,) xyzw."""
    return pose[:3, 3], so3.to_quaternion(pose[:3, :3])


@lru_cache(maxsize=8)
def _transform_layout(parent: str, child: str) -> _Layout:
    return _Layout((parent, child), POSE_NUMBERS, of_sequence=True)


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
