"""How landmarks have passed in the robot's frame between two looks, and as odometry has it."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass
from functools import reduce

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.matrices import (
    mahalanobis,
    solve_symmetric,
    transpose,
    with_blocks,
)
from slam_observer_ros.sensor_models.integration import integrate
from slam_observer_ros.sensor_models.velocity_history import VelocityHistory
from slam_observer_ros.state.state import State

SLIPS = (np.zeros(6), np.repeat([1.0, 0.0], 3))
"""Shares (6,) of a motion that are made where wheels spin: nothing, or the turn alone."""

NOISE = 3.0
"""Standard deviations of the sensor within which a landmark is where it should be."""

MOVED = 2.0
"""Standard deviations from which on a landmark has hardly stood still."""

CLEAR = 6.0
"""Standard deviations from which on a motion, or a shift in the robot's frame, is clear."""

LEAST = 2
"""Landmarks that must agree on a slip: one alone may move as the robot does."""

MOST = 0.75
"""Share of the landmarks in view that stands for all of them: some points are false."""


@dataclass(frozen=True, slots=True)
class Look:
    """An observation, and how many of the remembered moves were before it."""

    event: ObservationEvent
    moves: int


@dataclass(frozen=True, slots=True)
class SeenTwice:
    """Landmarks (m,) that a sensor has seen twice, as points (m, 3) in the body frame."""

    event: ObservationEvent  # the later one …
    rows: list[int]  # … and which of its points these are
    ids: list[int]
    before: FloatArray  # where they were seen first
    points: FloatArray  # where they are seen now
    expected: FloatArray  # where they should be by odometry
    motion: FloatArray  # (4, 4) in between, by odometry
    since_ns: int

    @classmethod
    def of(cls, start: Look, now: Look, moved: list[FloatArray], but: Set[int]) -> SeenTwice:
        """Return the landmarks of two looks, without the ids ``but``.

        In between the robot has ``moved`` by odometry.
        """
        first = {i: row for row, i in enumerate(start.event.ids.tolist()) if i not in but}
        both = [(row, i) for row, i in enumerate(now.event.ids.tolist()) if i in first]
        rows, ids = [row for row, _ in both], [i for _, i in both]
        before = start.event.points[[first[i] for i in ids]]
        motion = product(moved)
        expected = (before - motion[:3, 3]).dot(motion[:3, :3])
        points = now.event.points[rows]
        return cls(now.event, rows, ids, before, points, expected, motion, start.event.stamp_ns)

    @property
    def lagging(self) -> list[int]:
        """Landmarks that have not gone half of the way that they should have gone."""
        way, made = self.expected - self.before, self.points - self.before
        ahead = np.einsum('ij,ij->i', made - 0.5 * way, way).tolist()
        return [i for i, much in zip(self.ids, ahead, strict=True) if much <= 0.0]

    @property
    def squared_way(self) -> float:
        """Sum of the squares of the ways that they should have gone, m²."""
        way = (self.expected - self.before).ravel()
        return float(way.dot(way))

    def after(self, share: FloatArray) -> FloatArray:
        """Return where (m, 3) they should be if a ``share`` (6,) of the motion was made."""
        back = se3.exp(-share * se3.log(self.motion))
        return se3.transform(back, self.before)


@dataclass(frozen=True, slots=True)
class View:
    """How landmarks (m,) have moved in the robot's frame, in standard deviations."""

    ids: list[int]
    shift: FloatArray  # how far each is from where it was
    way: FloatArray  # how far it should be from there by odometry, which may be off as well
    error: FloatArray  # how far it is from where it should be by odometry
    slipped: FloatArray  # (s, m) how far it is from where it should be by each of the SLIPS
    off: FloatArray  # (m, k) the error in metres, body frame
    noise: FloatArray  # (m, k, k) of the sensor in both observations, m²
    C: FloatArray  # (m, k, p) how the motion's error moves each
    motion_noise: FloatArray  # (p, p)

    @classmethod
    def of(cls, state: State, seen: list[SeenTwice], velocities: VelocityHistory) -> View:
        """Return the view of pairs of points of one sensor or several."""
        k, A = state.axes.point, state.observer.A
        noise = sensor_noise(state, seen)
        now = np.concatenate([pairs.points for pairs in seen])
        before = np.concatenate([pairs.before for pairs in seen])
        expected = np.concatenate([pairs.expected for pairs in seen])
        slipped = [np.concatenate([pairs.after(share) for pairs in seen]) for share in SLIPS]
        shifts = (now - np.array([before, *slipped]))[:, :, :k]
        squared = np.einsum('smi,mij,smj->sm', shifts, np.linalg.inv(noise), shifts)
        shift, *slips = np.sqrt(np.maximum(squared, 0.0))
        C = transpose(A[:k, :k]) @ state.axes.output_matrix(se3.transform(A, expected))
        longest = min(seen, key=lambda pairs: pairs.since_ns)
        motion_noise = _motion_noise(state, longest, velocities)
        S, way = noise + C @ motion_noise @ transpose(C), (expected - before)[:, :k]
        off = (now - expected)[:, :k]
        error, way = mahalanobis(off, S), mahalanobis(way, S)
        ids = [landmark_id for pairs in seen for landmark_id in pairs.ids]
        return cls(ids, shift, way, error, np.array(slips), off, noise, C, motion_noise)

    @property
    def passes(self) -> BoolArray:
        """Which landmarks (m,) have clearly moved, and are where odometry has them."""
        return (self.shift > CLEAR) & (2.0 * self.error < self.shift)

    @property
    def is_mixed(self) -> bool:
        """Whether most have neither stood nor gone as odometry says."""
        neither = (self.shift > MOVED) & (self.error > NOISE)
        return bool(2 * np.count_nonzero(neither) > len(neither))

    def shows(self, slipped: FloatArray, places: BoolArray) -> bool:
        """Return whether places clearly show a slip, which leaves landmarks ``slipped`` (m,) off.

        That odometry is off by its noise must not explain them as well.
        """
        gain, agree = self.error**2 - slipped**2, places & (slipped <= NOISE)
        differ = places & (slipped > NOISE) & (gain < -(NOISE**2))
        if (
            np.count_nonzero(agree & (gain > NOISE**2)) < LEAST
            or np.count_nonzero(agree) < MOST * np.count_nonzero(places)
            or differ.any()
        ):
            return False
        C, off = self.C[agree].reshape(-1, self.C.shape[-1]), self.off[agree].ravel()
        S = with_blocks(C @ self.motion_noise @ C.T, self.noise[agree])
        return bool(off @ solve_symmetric(S, off) - np.sum(slipped[agree] ** 2) > CLEAR**2)


def ids_of(looks: list[Look]) -> set[int]:
    """Return the ids of the points seen."""
    return {i for look in looks for i in look.event.ids.tolist() if i != UNKNOWN_ID}


def sensor_noise(state: State, seen: list[SeenTwice]) -> FloatArray:
    """Return the covariances (m, k, k) of both points of landmarks that stand, m²."""
    each = [state.observation_noise.covariances(pairs.event)[pairs.rows] for pairs in seen]
    both: FloatArray = 2.0 * np.concatenate(each)[:, : state.axes.point, : state.axes.point]
    return both


def product(moved: list[FloatArray]) -> FloatArray:
    """Return moves, one after the other, as one motion (4, 4), in the frame at their start."""
    return reduce(np.dot, moved, np.eye(4))


def _motion_noise(state: State, pairs: SeenTwice, velocities: VelocityHistory) -> FloatArray:
    """Return the covariance (p, p) of the motion between them, its bias included."""
    calibration, end_ns = state.calibration, pairs.event.stamp_ns
    # The velocities before are forgotten: they were off by as much.
    since_ns = max(pairs.since_ns, velocities.begins_ns or pairs.since_ns)
    start = state.observer.A.dot(se3.inverse(pairs.motion))
    motion = integrate(velocities, calibration, state.motion_noise, start, since_ns, end_ns, None)
    longer = (end_ns - pairs.since_ns) / max(end_ns - since_ns, 1)
    F = longer * motion.sensitivity
    # As it is stated: slips and carried landmarks themselves have made the factor larger.
    noise = longer / max(1.0, state.motion_noise.factors.applied.max()) * motion.noise
    total: FloatArray = noise + (F * state.gains.calibration_variances) @ F.T
    return total
