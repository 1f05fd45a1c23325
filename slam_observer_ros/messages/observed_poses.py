"""Landmarks that a detector gives as poses."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.geometry import so3
from slam_observer_ros.messages.measurement import Measurement


def observed_poses(
    frame_id: str,
    stamp_ns: int,
    ids: IntArray,
    poses: FloatArray,
    pose_covariances: FloatArray | None = None,
) -> Measurement[ObservationEvent]:
    """Return landmarks at ``poses`` (m, 7), position first, seen in one frame.

    Of ``pose_covariances`` (m, 6, 6), zero where unknown, those of the positions are used if they
    are known of all.
    """
    covariances = turns = None
    if pose_covariances is not None:
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
    )
    is_measured: BoolArray = np.all(np.isfinite(event.points), axis=1)
    return Measurement(frame_id, event.select(is_measured))


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
