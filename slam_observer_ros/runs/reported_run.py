"""What a report is made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import CalibrationEstimate
from slam_observer_ros.evaluation.metrics import pose_errors, TrajectoryErrors
from slam_observer_ros.evaluation.run_record import Innovations, Instant, LandmarkTruth
from slam_observer_ros.evaluation.trajectory import interpolate, Trajectory
from slam_observer_ros.geometry import se3
from slam_observer_ros.recording.recorded_truth import Truth
from slam_observer_ros.settings.estimator_settings import Settings

MIN_GAP_S = 3.0
"""Shortest stretch without a used landmark that is marked."""


@dataclass(frozen=True, slots=True, eq=False)
class ReportedRun:
    """A replay with what was recorded of it, from ``start_ns`` on.

    ``trajectory`` is the online one and ``errors`` its errors; ``dead_reckoning`` is that of the
    velocities alone; ``anees`` is that of the pose. Both are None where there is no truth.
    """

    settings: Settings
    start_ns: int
    trajectory: Trajectory
    dead_reckoning: Trajectory
    in_known_map: bool
    truth: Truth
    errors: TrajectoryErrors | None
    anees: float | None
    instants: Sequence[Instant]
    innovations: Innovations

    def seconds(self, stamps_ns: IntArray) -> FloatArray:
        """Return times since the first event of the run, seconds."""
        seconds: FloatArray = (stamps_ns - self.start_ns) / 1e9
        return seconds

    @property
    def instants_s(self) -> FloatArray:
        """(i,) times of the instants, seconds."""
        return self.seconds(self._instants_ns)

    @property
    def _instants_ns(self) -> IntArray:
        return np.array([instant.stamp_ns for instant in self.instants], dtype=np.int64)

    @property
    def calibration(self) -> Sequence[CalibrationEstimate]:
        """What was found out about the velocity in the end."""
        return self.instants[-1].calibration if self.instants else ()

    def calibration_over_time(self, name: str) -> tuple[FloatArray, list[CalibrationEstimate]]:
        """Return when a property was estimated, seconds, and what was known of it at each time.

        That of a sensor begins where the sensor is heard first.
        """
        known = [
            (row, part)
            for row, instant in enumerate(self.instants)
            for part in instant.calibration
            if part.name == name
        ]
        return self.instants_s[[row for row, _ in known]], [part for _, part in known]

    @property
    def used_s(self) -> FloatArray:
        """(u,) times at which landmarks were used, seconds."""
        innovations = self.innovations
        return np.unique(self.seconds(innovations.stamps_ns[innovations.weights > 0.0]))

    @property
    def gaps_s(self) -> FloatArray:
        """(g, 2) beginnings and ends of the stretches in which no landmark was used, seconds."""
        edges_s = np.concatenate([[0.0], self.used_s, self.instants_s[-1:]])
        is_gap = np.diff(edges_s) >= MIN_GAP_S
        return np.column_stack([edges_s[:-1][is_gap], edges_s[1:][is_gap]])

    @property
    def aligned_landmarks(self) -> LandmarkTruth | None:
        """The true landmarks where the estimate should have them; None without truth."""
        truth = self.truth.landmarks
        if truth is None or self.errors is None:
            return None
        return LandmarkTruth(truth.ids, self.errors.in_estimate(truth.world_points))

    def anchored_errors(self) -> tuple[FloatArray, IntArray] | None:
        """Return pose errors (a, 6) from the first pose on, and the rows (a,) of their instants.

        The covariance is of these: it counts from the first pose. None where there is no truth, or
        the pose is that in a loaded map.
        """
        if self.errors is None or self.in_known_map:
            return None
        true_poses, covered = interpolate(
            Trajectory(self.truth.stamps_ns, self.truth.poses), self._instants_ns
        )
        rows = np.flatnonzero(covered).astype(np.int64)
        if not len(rows):
            return None
        poses = np.array([self.instants[row].pose for row in rows.tolist()])
        anchored = poses[0] @ se3.inverse(true_poses[rows[0]]) @ true_poses[rows]
        return pose_errors(poses, anchored), rows
