"""The paper's simulation (section VI) and variations of it, as a source of events.

A robot drives a circle of 5 m radius about the origin, 2 m above the ground, and sees four
landmarks. The command line and ``simulator_node`` draw from the same :class:`Simulation`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
import heapq
import math
from typing import TypeAlias

import numpy as np

from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND, to_ns, to_s
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.recordings.trajectory import LandmarkTruth, PoseTruth
from slam_observer_ros.settings.parameter_table import parameter

BODY_VELOCITY = (0.0, 0.0, 0.2, 1.0, 0.0, 0.0)  # section VI's (Ω, v), rad/s and m/s, body frame
LAP_S = 2.0 * math.pi / BODY_VELOCITY[2]  # duration of one lap of the circle, seconds

START_POSITION = (0.0, -BODY_VELOCITY[3] / BODY_VELOCITY[2], 2.0)
"""Start, metres; heading along +x from there, the circle is centred above the origin."""

PAPER_DIRECTIONS = ((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0))
"""Directions of section VI's four landmarks from the origin."""

LANDMARK_LOOP_RADIUS_M = 1.0  # radius of the horizontal circle on which a moving landmark runs


@dataclass(frozen=True, slots=True)
class Scenario:
    """What is simulated; the defaults are section VI. Each field is a row of a parameter table."""

    # fmt: off
    velocity_rate: float = parameter(
        50.0, 'Rate of the velocity messages and of the true pose',
        unit='Hz', minimum=0.1, maximum=1e5)
    observation_rate: float = parameter(
        50.0, 'Rate of the landmark observations', unit='Hz', minimum=0.1, maximum=1e5)
    duration: float = parameter(
        0.0, 'Simulated time after which it ends; 0 for no end',
        unit='s', minimum=0.0, maximum=1e7)
    laps: float = parameter(
        0.0, 'Laps after which it ends; 0 for no end', minimum=0.0, maximum=1e6)
    seed: int = parameter(
        0, 'Seed of everything random; the same seed gives the same run', minimum=0,
        maximum=2**62)
    initial_bias: float = parameter(
        0.5, "Length of the bias a_i of random direction on each landmark's first sighting",
        unit='m', minimum=0.0, maximum=1000.0)
    landmark_count: int = parameter(
        0, 'Landmarks in a random field; 0 for the four of the paper', minimum=0, maximum=10_000)
    landmark_distance: float = parameter(
        4.0, "Distance of every landmark from the circle's axis at z = 0",
        unit='m', minimum=0.0, maximum=1e5)
    landmark_speed: float = parameter(
        0.0, 'Speed at which each landmark runs a circle of 1 m radius',
        unit='m/s', minimum=0.0, maximum=1000.0)
    angular_velocity_noise: float = parameter(
        0.0, 'Standard deviation of each angular velocity component',
        unit='rad/s', minimum=0.0, maximum=1000.0)
    linear_velocity_noise: float = parameter(
        0.0, 'Standard deviation of each linear velocity component',
        unit='m/s', minimum=0.0, maximum=1000.0)
    point_noise: float = parameter(
        0.0, 'Standard deviation of each coordinate of an observed point',
        unit='m', minimum=0.0, maximum=1000.0)
    field_of_view: float = parameter(
        360.0, "Full angle of the cone about the body's x axis in which landmarks are seen",
        unit='deg', minimum=0.0, maximum=360.0)
    max_range: float = parameter(
        0.0, 'Distance up to which landmarks are seen; 0 for any',
        unit='m', minimum=0.0, maximum=1e6)
    drop_fraction: float = parameter(
        0.0, 'Fraction of the messages that never arrive', minimum=0.0, maximum=1.0)
    late_fraction: float = parameter(
        0.0, 'Fraction of the messages that arrive late', minimum=0.0, maximum=1.0)
    max_lateness: float = parameter(
        0.1, 'Longest delay of a late message; delays are uniform below it',
        unit='s', minimum=0.0, maximum=3600.0)
    # fmt: on

    @property
    def end_s(self) -> float:
        """Simulated time of the end, seconds; infinite if neither duration nor laps is set."""
        ends = (self.duration, self.laps * LAP_S)
        return min((end for end in ends if end > 0.0), default=math.inf)


SimulatedEvent: TypeAlias = VelocityEvent | ObservationEvent | PoseTruth


@dataclass(frozen=True, slots=True, order=True)
class Delivery:
    """An event, and the time at which it arrives: its own stamp unless it is late.

    ``number``, the position in the order of stamps, breaks ties between equal arrivals.
    """

    arrival_ns: int
    number: int
    event: SimulatedEvent = field(compare=False)


class Simulation:
    """A deterministic run of a scenario, whose first event is at ``start_ns``, nanoseconds."""

    def __init__(self, scenario: Scenario, start_ns: int = 0) -> None:
        self.scenario = scenario
        self.start_ns = start_ns
        # The noise has a seed of its own: no option of it moves landmarks.
        world_seed, self._noise_seed = np.random.SeedSequence(scenario.seed).spawn(2)
        world_rng, count = np.random.default_rng(world_seed), scenario.landmark_count
        directions = _random_directions(count, world_rng) if count else np.array(PAPER_DIRECTIONS)
        self._rest_points, count = scenario.landmark_distance * directions, len(directions)
        self.landmark_ids: IntArray = np.arange(count, dtype=np.int64)
        self._bias = scenario.initial_bias * _random_directions(count, world_rng)
        self._phases = world_rng.uniform(0.0, 2.0 * np.pi, count)
        self._start_pose = np.eye(4)
        self._start_pose[:3, 3] = START_POSITION

    def pose(self, stamp_ns: int | IntArray) -> FloatArray:
        """Return the true body-to-world poses (…, 4, 4) at stamps (…,)."""
        elapsed_s = self._elapsed_s(stamp_ns)
        result: FloatArray = self._start_pose @ se3.exp(
            elapsed_s[..., None] * np.asarray(BODY_VELOCITY)
        )
        return result

    def world_points(self, stamp_ns: int) -> FloatArray:
        """Return the true landmark positions (n, 3) at a stamp, world frame, metres."""
        if self.scenario.landmark_speed == 0.0:
            return self._rest_points
        angle = self._loop_angle(stamp_ns)
        circle = np.stack((np.cos(angle), np.sin(angle), np.zeros_like(angle)), axis=-1)
        return self._rest_points + LANDMARK_LOOP_RADIUS_M * circle

    def world_velocities(self, stamp_ns: int) -> FloatArray:
        """Return the true landmark velocities (n, 3) at a stamp, world frame, m/s."""
        angle = self._loop_angle(stamp_ns)
        tangent = np.stack((-np.sin(angle), np.cos(angle), np.zeros_like(angle)), axis=-1)
        return self.scenario.landmark_speed * tangent

    def landmark_truth(self, stamp_ns: int) -> LandmarkTruth:
        """Return ids and true positions of all landmarks at a stamp."""
        return LandmarkTruth(self.landmark_ids, self.world_points(stamp_ns))

    def deliveries(self) -> Iterator[Delivery]:
        """Yield events and true poses in the order in which they arrive.

        At equal stamps the truth comes first, then the velocity, then the observation. Each call
        yields the same run.
        """
        delayed: list[Delivery] = []
        for delivery in self._deliveries_in_stamp_order():
            heapq.heappush(delayed, delivery)
            while delayed and delayed[0].arrival_ns <= delivery.event.stamp_ns:
                yield heapq.heappop(delayed)
        while delayed:
            yield heapq.heappop(delayed)

    def _deliveries_in_stamp_order(self) -> Iterator[Delivery]:
        rng = np.random.default_rng(self._noise_seed)
        is_new = np.ones(len(self.landmark_ids), dtype=np.bool_)
        for number, (stamp_ns, kind) in enumerate(self._schedule()):
            if kind == 'truth':
                yield Delivery(stamp_ns, number, PoseTruth(stamp_ns, self.pose(stamp_ns)))
                continue
            if rng.random() < self.scenario.drop_fraction:
                continue
            event: VelocityEvent | ObservationEvent = (
                self._velocity(stamp_ns, rng)
                if kind == 'velocity'
                else self._observation(stamp_ns, rng, is_new)
            )
            is_late = rng.random() < self.scenario.late_fraction
            delay_ns = to_ns(rng.uniform(0.0, self.scenario.max_lateness)) if is_late else 0
            yield Delivery(stamp_ns + delay_ns, number, event)

    def _schedule(self) -> Iterator[tuple[int, str]]:
        """Yield (stamp, kind) in stamp order."""
        velocity_stamps = self._stamps(self.scenario.velocity_rate)
        observation_stamps = self._stamps(self.scenario.observation_rate)
        motion = (
            (stamp_ns, kind) for stamp_ns in velocity_stamps for kind in ('truth', 'velocity')
        )
        sightings = ((stamp_ns, 'observation') for stamp_ns in observation_stamps)
        return heapq.merge(motion, sightings, key=lambda entry: entry[0])

    def _stamps(self, rate_hz: float) -> Iterator[int]:
        end_ns = self.scenario.end_s * NANOSECONDS_PER_SECOND + 0.5  # as stamps are rounded
        step = 0
        while (elapsed_ns := round(step * NANOSECONDS_PER_SECOND / rate_hz)) <= end_ns:
            yield self.start_ns + elapsed_ns
            step += 1

    def _velocity(self, stamp_ns: int, rng: np.random.Generator) -> VelocityEvent:
        deviation = np.repeat(
            (self.scenario.angular_velocity_noise, self.scenario.linear_velocity_noise), 3
        )
        return VelocityEvent(stamp_ns, BODY_VELOCITY + deviation * rng.standard_normal(6))

    def _observation(
        self, stamp_ns: int, rng: np.random.Generator, is_new: BoolArray
    ) -> ObservationEvent:
        """Return what is seen at ``stamp_ns``; clears ``is_new`` (n,) of the landmarks seen."""
        pose = self.pose(stamp_ns)
        points = se3.transform(se3.inverse(pose), self.world_points(stamp_ns))
        is_seen = self._is_seen(points)
        points = points + self.scenario.point_noise * rng.standard_normal(points.shape)
        points[is_new] += self._bias[is_new]
        is_new &= ~is_seen
        velocities = None
        if self.scenario.landmark_speed > 0.0:
            velocities = (self.world_velocities(stamp_ns) @ pose[:3, :3])[is_seen]
        return ObservationEvent(
            stamp_ns, self.landmark_ids[is_seen], points[is_seen], velocities=velocities
        )

    def _is_seen(self, body_points: FloatArray) -> BoolArray:
        distances = np.linalg.norm(body_points, axis=-1)
        max_range_m = self.scenario.max_range or math.inf
        half_angle_rad = math.radians(self.scenario.field_of_view) / 2.0
        # A full sphere must not lose a point to the cosine's rounding.
        min_forward = -math.inf if half_angle_rad >= math.pi else math.cos(half_angle_rad)
        is_seen: BoolArray = (distances <= max_range_m) & (
            body_points[..., 0] >= min_forward * distances
        )
        return is_seen

    def _loop_angle(self, stamp_ns: int) -> FloatArray:
        rate = self.scenario.landmark_speed / LANDMARK_LOOP_RADIUS_M
        angle: FloatArray = self._phases + rate * self._elapsed_s(stamp_ns)
        return angle

    def _elapsed_s(self, stamp_ns: int | IntArray) -> FloatArray:
        return to_s(np.asarray(stamp_ns, dtype=np.int64) - self.start_ns)


def _random_directions(count: int, rng: np.random.Generator) -> FloatArray:
    """Return ``count`` unit vectors (count, 3), uniform over the sphere."""
    vectors = rng.standard_normal((count, 3))
    directions: FloatArray = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return directions
