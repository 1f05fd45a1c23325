"""Time-stamped events: what the estimator takes in.

Their arrays are not copied: who has added an event must not change them any more.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray

UNKNOWN_ID = -1
"""Landmark id of a point that its sensor could not identify."""

MAX_ID = 2**32 - 2
"""Largest landmark id: those that go out are uint32, whose last one says that it is unknown."""

FIRST_AUTOMATIC_ID = 10_000_000
"""Landmarks whose sensor gives no ids are numbered from here on."""

LAST_AUTOMATIC_ID = 2**24 - 1
"""They are numbered up to here: float32, as in a PointCloud, has these numbers exactly."""

AGREEING_STAMPS = 5
"""How many stamps in a row must agree before a pause or a jump of the clock is believed."""

NEAR_NS = 1_000_000_000
"""Stamps nearer than this to the newest one tell of no pause or jump, nanoseconds."""


@dataclass(frozen=True, slots=True)
class VelocityEvent:
    """Body velocity, held from its stamp until the next one.

    Attributes
    ----------
    stamp_ns : int
        Time of validity, nanoseconds.
    body_velocity : FloatArray
        (6,) angular then linear velocity (Ω, v) as in the paper's (9), in the base frame,
        rad/s and m/s.
    covariance : FloatArray or None
        (6, 6) covariance of ``body_velocity``, same order and units squared; None if unknown. A
        part, angular or linear, of which it is all zero is unknown as well.
    receive_ns : int or None
        When it was received, by any clock that goes on steadily, nanoseconds; None if unknown.
    is_mean : bool
        Whether it is the mean velocity until the next one, as between two poses. Otherwise its
        error goes on while no other comes.

    """

    stamp_ns: int
    body_velocity: FloatArray
    covariance: FloatArray | None = None
    receive_ns: int | None = None
    is_mean: bool = False


@dataclass(frozen=True, slots=True)
class AngularVelocityEvent:
    """Angular velocity that takes the place of other velocities' angular part, as of an IMU.

    It does so from its stamp until the next one, for the settings' ``velocity_timeout`` at most.
    Where no :class:`VelocityEvent` is in force it says nothing.

    Attributes
    ----------
    stamp_ns : int
        Time of validity, nanoseconds.
    angular_velocity : FloatArray
        (3,) in the base frame, rad/s.
    covariance : FloatArray or None
        (3, 3) its covariance, rad²/s²; None, or all zero, if unknown.
    receive_ns : int or None
        When it was received, by any clock that goes on steadily, nanoseconds; None if unknown.

    """

    stamp_ns: int
    angular_velocity: FloatArray
    covariance: FloatArray | None = None
    receive_ns: int | None = None


@dataclass(frozen=True, slots=True)
class ObservationEvent:
    """Landmarks seen at one instant.

    Attributes
    ----------
    stamp_ns : int
        Time of validity, nanoseconds.
    ids : IntArray
        (m,) landmark ids, :data:`UNKNOWN_ID` where the sensor gives none.
    points : FloatArray
        (m, 3) positions in the base frame, metres.
    covariances : FloatArray or None
        (m, 3, 3) covariance of each point in the base frame, m²; None if unknown, and all zero
        for a point of which it is.
    velocities : FloatArray or None
        (m, 3) velocity of each landmark itself, expressed in the base frame, m/s (the paper's
        v_i (19)); None for static landmarks.
    sensor : FloatArray or None
        (m, 3) where each was measured from, in the base frame, metres: noise grows with the
        distance from there. None for the base itself.
    receive_ns : int or None
        When it was received, by any clock that goes on steadily, nanoseconds; None if unknown.

    """

    stamp_ns: int
    ids: IntArray
    points: FloatArray
    covariances: FloatArray | None = None
    velocities: FloatArray | None = None
    sensor: FloatArray | None = None
    receive_ns: int | None = None

    @property
    def lines_of_sight(self) -> FloatArray:
        """(m, 3) from the sensor to the points, metres, axes of the base frame."""
        return self.points if self.sensor is None else self.points - self.sensor

    def repeated_ids(self) -> list[int]:
        """Return the ids that more than one of the points has."""
        ids = [landmark_id for landmark_id in self.ids.tolist() if landmark_id != UNKNOWN_ID]
        if len(set(ids)) == len(ids):  # as nearly always
            return []
        return [landmark_id for landmark_id, count in Counter(ids).items() if count > 1]

    def select(self, mask: BoolArray) -> ObservationEvent:
        """Return the part of it that ``mask`` (m,) picks."""
        if mask.all():
            return self
        return replace(
            self,
            ids=self.ids[mask],
            points=self.points[mask],
            covariances=None if self.covariances is None else self.covariances[mask],
            velocities=None if self.velocities is None else self.velocities[mask],
            sensor=None if self.sensor is None else self.sensor[mask],
        )


Event: TypeAlias = VelocityEvent | AngularVelocityEvent | ObservationEvent
"""Anything that :meth:`slam_observer_ros.estimator.estimator.Estimator.add` takes."""


def is_automatic(ids: IntArray) -> BoolArray:
    """Return which ids (m,) were given to landmarks whose sensor gives none."""
    automatic: BoolArray = (ids >= FIRST_AUTOMATIC_ID) & (ids <= LAST_AUTOMATIC_ID)
    return automatic


def flatten(event: ObservationEvent) -> ObservationEvent:
    """Return the observation without what leaves the plane z = 0; lines of sight stay."""
    points = event.points * _PLANAR_POINT
    velocities = None if event.velocities is None else event.velocities * _PLANAR_POINT
    sensor = points - event.lines_of_sight if event.points[:, 2].any() else event.sensor
    return replace(event, points=points, velocities=velocities, sensor=sensor)


def flatten_velocities(body_velocities: FloatArray) -> FloatArray:
    """Return velocities (…, 6) without what leaves the plane z = 0 or turns out of it."""
    flat: FloatArray = body_velocities * _PLANAR_VELOCITY
    return flat


_PLANAR_VELOCITY = np.array([0.0, 0.0, 1.0, 1.0, 1.0, 0.0])
_PLANAR_POINT = np.array([1.0, 1.0, 0.0])
