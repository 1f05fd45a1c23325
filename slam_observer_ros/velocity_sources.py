"""Velocities that no single message holds: from two poses, or from two sensors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam_observer_ros.events import VelocityEvent
from slam_observer_ros.geometry import se3
from slam_observer_ros.types import FloatArray


class PoseDifferences:
    """Turns poses of the base in a smooth frame, as odometry gives them, into velocities.

    The velocity from one pose to the next has the stamp of the first: held until the second, it
    leads exactly there. It is known one period late, which the reorder window must cover.

    Parameters
    ----------
    timeout_ns : int
        Poses further apart than this give no velocity, nanoseconds.

    """

    def __init__(self, timeout_ns: int) -> None:
        self._timeout_ns = timeout_ns
        self._last: tuple[int, FloatArray] | None = None

    def add(self, stamp_ns: int, pose: FloatArray) -> VelocityEvent | None:
        """Take a pose (4, 4); return the velocity since the one before, if there is one."""
        last, self._last = self._last, (stamp_ns, pose)
        if last is None or not 0 < stamp_ns - last[0] <= self._timeout_ns:
            return None
        motion = se3.log(se3.inverse(last[1]) @ pose)
        return VelocityEvent(last[0], motion / ((stamp_ns - last[0]) * 1e-9))


class AngularReplacement:
    """Joins one sensor's linear velocity with another's angular velocity, as wheels and an IMU.

    Each new message of either gives a velocity at its stamp, with the other's latest part; the
    second of two with the same stamp gives one a nanosecond later, which replaces the first's.

    Parameters
    ----------
    timeout_ns : int
        How old the other's part may be, nanoseconds. Without angular velocity in time a velocity
        stays as it is; without linear velocity there is none.

    """

    def __init__(self, timeout_ns: int) -> None:
        self._timeout_ns = timeout_ns
        self._velocity: VelocityEvent | None = None
        self._angular: VelocityEvent | None = None

    def add_velocity(self, event: VelocityEvent) -> VelocityEvent:
        """Take a velocity whose linear part counts; return it with the angular part in force."""
        self._velocity = event
        return self._joined(event.stamp_ns) or event

    def add_angular(
        self, stamp_ns: int, angular_velocity: FloatArray, covariance: FloatArray | None
    ) -> VelocityEvent | None:
        """Take an angular velocity; return it with the linear velocity in force, if any.

        Parameters
        ----------
        stamp_ns : int
            Time of validity, nanoseconds.
        angular_velocity : FloatArray
            (3,) in the base frame, rad/s.
        covariance : FloatArray or None
            (3, 3) its covariance, rad²/s²; None if unknown.

        """
        whole = None
        if covariance is not None:
            whole = np.zeros((6, 6))
            whole[:3, :3] = covariance
        angular = np.concatenate([angular_velocity, np.zeros(3)])
        self._angular = VelocityEvent(stamp_ns, angular, whole)
        return self._joined(stamp_ns)

    def _joined(self, stamp_ns: int) -> VelocityEvent | None:
        velocity, angular = self._velocity, self._angular
        if velocity is None or angular is None:
            return None
        if abs(velocity.stamp_ns - angular.stamp_ns) > self._timeout_ns:
            return None
        if velocity.stamp_ns == angular.stamp_ns:  # the estimator takes one velocity a stamp
            stamp_ns += 1
        return replace(
            velocity,
            stamp_ns=stamp_ns,
            body_velocity=np.concatenate([angular.body_velocity[:3], velocity.body_velocity[3:]]),
            covariance=_joined_covariance(velocity.covariance, angular.covariance),
        )


def _joined_covariance(linear: FloatArray | None, angular: FloatArray | None) -> FloatArray | None:
    """Return what is known of two independent parts; None unless both are known."""
    if linear is None or angular is None:
        return None
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = angular[:3, :3]
    covariance[3:, 3:] = linear[3:, 3:]
    return covariance
