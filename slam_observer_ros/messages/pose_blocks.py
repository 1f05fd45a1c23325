"""Poses of many messages of one type and size at once, as decoders have each of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry import so3
from slam_observer_ros.messages.cdr import CdrBlockReader
from slam_observer_ros.messages.message_types import ODOMETRY
from slam_observer_ros.messages.poses_and_velocities import pose_matrices, PoseMessage

_NEARLY = 1.0 - 1e-9
"""Of a limit: what is below that is below the limit, however it is rounded."""


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


def _poses(reader: CdrBlockReader) -> PoseBlock:
    stamps_ns, _ = reader.headers()
    return PoseBlock(stamps_ns, '', *_read_poses(reader))


def _with_covariance(reader: CdrBlockReader) -> PoseBlock:
    block = _poses(reader)
    reader.float64s(36)
    return block


def _transforms(reader: CdrBlockReader) -> PoseBlock:
    stamps_ns, _ = reader.headers()
    return PoseBlock(stamps_ns, reader.common_string(), *_read_poses(reader))


def _odometry(reader: CdrBlockReader) -> PoseBlock:
    block = _transforms(reader)
    reader.float64s(36 + 6 + 36)  # Covariance, velocity and its covariance.
    return block


_DECODERS: dict[str, Callable[[CdrBlockReader], PoseBlock]] = {
    'geometry_msgs/msg/PoseStamped': _poses,
    'geometry_msgs/msg/PoseWithCovarianceStamped': _with_covariance,
    'geometry_msgs/msg/TransformStamped': _transforms,
    ODOMETRY: _odometry,
}


def decode_poses(message_type: str, data: NDArray[np.uint8]) -> PoseBlock:
    """Decode messages (k, size) of a type.

    Raise a :class:`MessageError` if one is malformed, or they do not have all in common, or no
    blocks of the type are read.
    """
    if message_type not in _DECODERS:
        raise MessageError(f'{message_type} is read one by one')
    reader = CdrBlockReader(data)
    block = _DECODERS[message_type](reader)
    reader.finish()
    with np.errstate(over='ignore'):
        norms = np.sqrt((block.quaternions**2).sum(axis=1))
    # Written so that NaN is refused too.
    if not (np.abs(norms - 1.0) < _NEARLY * so3.QUATERNION_NORM_TOLERANCE).all():
        raise MessageError('a quaternion is no rotation, or nearly none')
    return block


def _read_poses(reader: CdrBlockReader) -> tuple[FloatArray, FloatArray]:
    values = reader.float64s(7)
    return values[:, :3], values[:, 3:]
