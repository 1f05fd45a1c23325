"""Velocities of many messages of one type and size at once, as decoders have each of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.events import VelocityBlock
from slam_observer_ros.messages.cdr import CdrBlockReader
from slam_observer_ros.messages.message_types import ODOMETRY
from slam_observer_ros.messages.poses_and_velocities import angular_first

BlockDecoder: TypeAlias = Callable[[NDArray[np.uint8], IntArray], tuple[str, VelocityBlock]]
"""From bytes (k, size) and receive times (k,) to frame and velocities.

Raises a :class:`MessageError` if one of them is malformed, or they do not have all in common.
"""


def _twists(data: NDArray[np.uint8], receive_ns: IntArray) -> tuple[str, VelocityBlock]:
    reader = CdrBlockReader(data)
    velocities = _read_twists(reader)
    reader.finish()
    return '', VelocityBlock(receive_ns, velocities, None, receive_ns)


def _stamped(data: NDArray[np.uint8], receive_ns: IntArray) -> tuple[str, VelocityBlock]:
    reader = CdrBlockReader(data)
    stamps_ns, frame_id = reader.headers()
    velocities = _read_twists(reader)
    reader.finish()
    return frame_id, VelocityBlock(stamps_ns, velocities, None, receive_ns)


def _with_covariance(data: NDArray[np.uint8], receive_ns: IntArray) -> tuple[str, VelocityBlock]:
    reader = CdrBlockReader(data)
    stamps_ns, frame_id = reader.headers()
    velocities, covariances = _read_twists(reader), _read_covariances(reader)
    reader.finish()
    return frame_id, VelocityBlock(stamps_ns, velocities, covariances, receive_ns)


def _odometry(data: NDArray[np.uint8], receive_ns: IntArray) -> tuple[str, VelocityBlock]:
    reader = CdrBlockReader(data)
    stamps_ns, _ = reader.headers()
    child_frame_id = reader.common_string()
    reader.float64s(7 + 36)  # The pose and its covariance.
    velocities, covariances = _read_twists(reader), _read_covariances(reader)
    reader.finish()
    return child_frame_id, VelocityBlock(stamps_ns, velocities, covariances, receive_ns)


BLOCK_DECODERS: dict[str, BlockDecoder] = {
    'geometry_msgs/msg/TwistStamped': _stamped,
    'geometry_msgs/msg/TwistWithCovarianceStamped': _with_covariance,
    'geometry_msgs/msg/Twist': _twists,
    ODOMETRY: _odometry,
}
"""By the type of the messages; those of other types are decoded one by one."""


def _read_twists(reader: CdrBlockReader) -> FloatArray:
    values = reader.float64s(6)
    return np.concatenate((values[:, 3:], values[:, :3]), axis=1)


def _read_covariances(reader: CdrBlockReader) -> FloatArray | None:
    """Read covariances (k, 6, 6), rotational part first; None if all are unknown."""
    covariances = reader.float64s(36).reshape(-1, 6, 6)
    is_unknown = (covariances[:, 0, 0] == -1.0) | ~covariances.any(axis=(1, 2))
    if is_unknown.all():
        return None
    if is_unknown.any():
        raise MessageError('some of the covariances are unknown')
    return angular_first(covariances)
