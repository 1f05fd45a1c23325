"""Time-stamped events, metres and radians: what messages measure, and the estimator takes in.

Each has ``stamp_ns``, its time of validity, ``receive_ns``, when it was received by any clock
that goes on steadily, or None, and ``sensor_frame``, the frame in which decoders give it.
``moved`` brings it into another frame; the estimator wants the base frame. A covariance is along
the axes of the same frame; if it is None, or all zero, it is unknown. Arrays are not copied: who
has added an event must not change them any more.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar, TypeAlias

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.lie import se3
from slam_observer_ros.lie.matrices import limited, MAX_DEVIATION
from slam_observer_ros.lie.sensor_mounting import Sensed

UNKNOWN_ID = -1  # landmark id of a point that its sensor could not identify
IMPOSSIBLE_ID = -(2**31)  # landmark id of a point whose message has no possible one: not used

POINT, BEARING, RANGE, AZIMUTH, AZIMUTH_RANGE = range(5)
"""What is measured of a landmark: all; its direction; its distance; or its direction about the
base's z, alone or with the distance. What is not measured is no part of the event."""

RANGES = RANGE, AZIMUTH_RANGE  # half points with a distance, as radios measure it
MAX_ID = 2**32 - 2  # largest landmark id: they go out as uint32, whose last one is 'unknown'


@dataclass(frozen=True, slots=True)
class VelocityEvent:
    """Body velocity (Ω, v) as in the paper's (9), held from its stamp until the next one.

    Attributes
    ----------
    covariance : FloatArray or None
        A part of it, angular or linear, that is all zero is unknown as well.
    is_mean : bool
        Whether it is the mean velocity until the next one, as between two poses. Otherwise its
        error goes on while no other comes.

    """

    kind: ClassVar = 'velocity'
    stamp_ns: int
    body_velocity: FloatArray  # (6,)
    covariance: FloatArray | None = None  # (6, 6)
    receive_ns: int | None = None
    is_mean: bool = False
    sensor_frame: str = ''

    def moved(self, pose: FloatArray) -> VelocityEvent:
        """Return the velocity of the base, in which this event's frame has ``pose`` T (4, 4).

        Both move as one rigid body, V_base = Ad_T V: where the frame turns off the base's origin,
        the linear velocity has a lever arm.
        """
        Ad = se3.adjoint(pose)
        covariance = self.covariance
        if covariance is not None:
            is_linear_known = covariance[3:, 3:].any()
            covariance = _turned(covariance, Ad)
            if not is_linear_known:  # the lever arm's part would pass for all of it
                covariance[3:] = covariance[:, 3:] = 0.0
        return replace(self, body_velocity=Ad @ self.body_velocity, covariance=covariance)


@dataclass(slots=True, eq=False)  # not frozen, which would take a microsecond more
class VelocityBlock:
    """k velocity events that came one after the other, as arrays; they share ``is_mean``."""

    kind: ClassVar = VelocityEvent.kind
    stamps_ns: IntArray  # (k,)
    body_velocities: FloatArray  # (k, 6)
    covariances: FloatArray | None = None  # (k, 6, 6), all of them stated
    receive_ns: IntArray | None = None  # (k,)
    sensor_frame: str = ''
    is_mean: bool = False

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def stamp_ns(self) -> int:
        """The stamp of the first one."""
        return int(self.stamps_ns[0])

    def part(self, rows: slice) -> VelocityBlock:
        """Return some of them."""
        return VelocityBlock(
            self.stamps_ns[rows],
            self.body_velocities[rows],
            None if self.covariances is None else self.covariances[rows],
            None if self.receive_ns is None else self.receive_ns[rows],
            self.sensor_frame,
            self.is_mean,
        )

    def events(self) -> Iterator[VelocityEvent]:
        """Yield them as events."""
        received = [None] * len(self) if self.receive_ns is None else self.receive_ns.tolist()
        covariances = [None] * len(self) if self.covariances is None else self.covariances
        for columns in zip(
            self.stamps_ns.tolist(), self.body_velocities, covariances, received, strict=True
        ):
            yield VelocityEvent(*columns, self.is_mean, self.sensor_frame)


@dataclass(frozen=True, slots=True)
class AngularVelocityEvent:
    """Angular velocity in place of other velocities' angular part, as of an IMU.

    Held from its stamp until the next one, for the settings' ``velocity_timeout`` at most; where
    no :class:`VelocityEvent` is in force it says nothing.
    """

    kind: ClassVar = 'angular velocity'
    stamp_ns: int
    angular_velocity: FloatArray  # (3,)
    covariance: FloatArray | None = None  # (3, 3)
    receive_ns: int | None = None
    sensor_frame: str = ''

    def moved(self, pose: FloatArray) -> AngularVelocityEvent:
        """Return it along the axes of the frame in which its own has ``pose`` (4, 4)."""
        R, covariance = pose[:3, :3], self.covariance
        return replace(
            self,
            angular_velocity=R @ self.angular_velocity,
            covariance=None if covariance is None else _turned(covariance, R),
        )


@dataclass(frozen=True, slots=True)
class ObservationEvent:
    """Landmarks seen at one instant.

    Of a half point (``kinds``) the line of sight, from ``sensor`` to ``points``, has only what
    was measured: a unit vector for its direction, or the distance in any direction. A stated
    covariance is along and across that line, in rad² across a unit vector.
    """

    kind: ClassVar = 'observation'
    stamp_ns: int
    ids: IntArray  # (m,) UNKNOWN_ID where the sensor gives none
    points: FloatArray  # (m, 3)
    covariances: FloatArray | None = None  # (m, 3, 3) of each point
    velocities: FloatArray | None = None  # (m, 3) of each landmark itself (the paper's v_i (19))
    # (m, 3) where each was measured from, by default from the base: noise grows with the distance.
    sensor: FloatArray | None = None
    receive_ns: int | None = None
    # (m, 3, 3) of each landmark's own axes; all zero where unknown, as of a point
    orientations: FloatArray | None = None
    orientation_covariances: FloatArray | None = None  # (m, 3, 3) of rotation vectors, rad²
    sensor_frame: str = ''  # of the sensor that saw them; each has a calibration of its own
    sensor_axis: FloatArray | None = None  # (3,) along which it looks, x by default
    sensed: Sensed | None = None  # as the sensor showed them, where they have been corrected
    # (m,) such as tag36h11, of fiducials whose poses are on /tf: points are NaN until looked up.
    families: tuple[str, ...] | None = None
    kinds: IntArray | None = None  # (m,) POINT to AZIMUTH_RANGE; None where all are whole points
    # (m, 3, 3) unit vectors along which completed points are measured, as rows, others zero
    directions: FloatArray | None = None
    # (m, 2) where an image shows them: points are NaN until the camera is looked up.
    pixels: FloatArray | None = None

    def moved(self, pose: FloatArray) -> ObservationEvent:
        """Return it in the frame in which its own has ``pose`` (4, 4)."""
        R = pose[:3, :3]
        sensor = np.zeros_like(self.points) if self.sensor is None else self.sensor
        return replace(
            self,
            points=se3.transform(pose, self.points),
            covariances=None if self.covariances is None else _turned(self.covariances, R),
            directions=None if self.directions is None else self.directions @ R.T,
            velocities=None if self.velocities is None else se3.rotate(pose, self.velocities),
            sensor=se3.transform(pose, sensor),
            sensor_axis=None if self.sensor_axis is None else R @ self.sensor_axis,
            orientations=None if self.orientations is None else R @ self.orientations,
            orientation_covariances=None
            if self.orientation_covariances is None
            else _turned(self.orientation_covariances, R),
        )

    @property
    def lines_of_sight(self) -> FloatArray:
        """(m, 3) from the sensor to the points."""
        return self.points if self.sensor is None else self.points - self.sensor

    def repeated_ids(self) -> list[int]:
        """Return the ids that more than one of the points has."""
        ids = [landmark_id for landmark_id in self.ids.tolist() if landmark_id >= 0]
        if len(set(ids)) == len(ids):  # as nearly always
            return []
        return [landmark_id for landmark_id, count in Counter(ids).items() if count > 1]

    def of_points(self) -> dict[str, Any]:
        """Return the arrays (m, …) of which each point has an entry, by name."""
        stated = {name: getattr(self, name) for name in _OF_POINTS}
        return {name: array for name, array in stated.items() if array is not None}

    def select(self, mask: BoolArray | IntArray) -> ObservationEvent:
        """Return the points that ``mask`` (m,), or rows, pick."""
        if mask.dtype == np.bool_ and mask.all():
            return self
        picked = {name: array[mask] for name, array in self.of_points().items()}
        sensed = None if self.sensed is None else self.sensed.select(mask)
        return replace(self, sensed=sensed, **picked)


Event: TypeAlias = VelocityEvent | AngularVelocityEvent | ObservationEvent
"""Anything that :meth:`slam_observer_ros.estimator.estimator.Estimator.add` takes."""


MeasuredVelocity: TypeAlias = VelocityEvent | VelocityBlock | AngularVelocityEvent
"""One velocity, or several that follow each other."""

Queued: TypeAlias = MeasuredVelocity | ObservationEvent  # as it is put in order of stamps


def flatten(event: ObservationEvent) -> ObservationEvent:
    """Return the observation in the plane z = 0; lines of sight stay."""
    points = event.points * _PLANAR_POINT
    velocities = None if event.velocities is None else event.velocities * _PLANAR_POINT
    sensor = points - event.lines_of_sight if event.points[:, 2].any() else event.sensor
    return replace(event, points=points, velocities=velocities, sensor=sensor)


def flatten_velocities(body_velocities: FloatArray) -> FloatArray:
    """Return velocities (…, 6) in the plane z = 0."""
    flat: FloatArray = body_velocities * _PLANAR_VELOCITY
    return flat


def _turned(covariances: FloatArray, R: FloatArray) -> FloatArray:
    """Return R C Rᵀ of covariances (…, d, d), and no larger than unknown ones."""
    largest = np.full(len(R), MAX_DEVIATION)
    turned: FloatArray = R @ limited(covariances, largest) @ R.T
    return turned


_OF_POINTS = (
    'ids', 'points', 'covariances', 'velocities', 'sensor', 'orientations',
    'orientation_covariances', 'kinds', 'directions', 'pixels',
)  # fmt: skip
_PLANAR_VELOCITY = np.array([0.0, 0.0, 1.0, 1.0, 1.0, 0.0])
_PLANAR_POINT = np.array([1.0, 1.0, 0.0])
