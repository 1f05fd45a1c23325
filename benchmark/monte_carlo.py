"""Consistency: whether the covariances that an estimator states match the errors it makes."""

from __future__ import annotations

from dataclasses import dataclass

from ekf_slam import EkfSlam
from estimators import EKF, observer
import numpy as np
from worlds import drive, Loop, simulated_settings, World

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.models.calibration import without_calibration
from slam_observer_ros.runs.metrics import (
    average_nees_band,
    normalised_squared_errors,
    pose_errors,
)

CHECKPOINT_S = 5

BATCH = 50
"""Runs of which a band is printed as well; over all runs it is narrower."""

LOOPS = {
    '3D stereo': Loop('stereo_inertial', 60.0, 100.0, 20, 6.0, 5),
    'wheeled': Loop('wheeled_bearing_range', 60.0, 100.0, 20, 6.0, 5),
}
"""Smaller loops, each closed after 60 s: 50 runs of the large ones would take too long."""

ESTIMATORS = ('riccati', EKF)


@dataclass(frozen=True, slots=True, eq=False)
class Consistency:
    """ANEES per degree of freedom over time, 1 where the covariances are honest.

    Attributes
    ----------
    times_s : FloatArray
        (c,) checkpoints.
    pose, landmarks : FloatArray
        (c,) mean over the runs of the pose's NEES and of the landmarks' mean NEES, each over
        its degrees of freedom.
    band : tuple of float
        95 % of an honest estimator's pose ANEES lie in it.
    batches : list of Consistency
        That of each :data:`BATCH` runs on their own; empty if there are no more than that.

    """

    times_s: FloatArray
    pose: FloatArray
    landmarks: FloatArray
    band: tuple[float, float]
    batches: list[Consistency]

    @property
    def inside(self) -> int:
        """How many of the pose's checkpoints are inside the band."""
        return int(np.sum((self.pose >= self.band[0]) & (self.pose <= self.band[1])))


def checkpoints_s(loop: Loop) -> FloatArray:
    """Return the (c,) times at which errors are compared with covariances, seconds."""
    return np.arange(CHECKPOINT_S, loop.duration_s + 1e-9, CHECKPOINT_S)


def run_once(loop_name: str, estimator_name: str, seed: int) -> FloatArray:
    """Return the NEES (c, 2) of pose and landmarks per degree of freedom, at each checkpoint.

    A checkpoint is the first observation from its time on. The robot moves as the model of all
    estimators has it, also between two velocities. The worlds have neither scale error
    nor bias, and nobody estimates them, so that all estimators are judged by the same model.
    """
    loop = LOOPS[loop_name]
    settings = without_calibration(simulated_settings(loop.config))
    world = drive(loop, settings, seed, jitters=True)
    estimator = EkfSlam(settings) if estimator_name == EKF else observer('riccati')(settings)
    due_ns = list(np.rint(checkpoints_s(loop) * 1e9))
    nees = []
    for event in world.events:
        estimator.add(event)
        while due_ns and isinstance(event, ObservationEvent) and event.stamp_ns >= due_ns[0]:
            nees.append(_nees(estimator, world, event.stamp_ns))
            due_ns.pop(0)
    return np.array(nees + [nees[-1]] * len(due_ns))


def summarise(loop_name: str, nees: FloatArray) -> Consistency:
    """Average the NEES (runs, c, 2) of all runs."""
    loop = LOOPS[loop_name]
    degrees_of_freedom = 3 if simulated_settings(loop.config).two_d_mode else 6
    mean = nees.mean(axis=0)
    band = average_nees_band(degrees_of_freedom, len(nees))
    starts = range(0, len(nees), BATCH) if len(nees) > BATCH else ()
    batches = [summarise(loop_name, nees[start : start + BATCH]) for start in starts]
    return Consistency(checkpoints_s(loop), mean[:, 0], mean[:, 1], band, batches)


def _nees(estimator: EkfSlam | Estimator, world: World, stamp_ns: int) -> tuple[float, float]:
    """Return the NEES of pose and landmarks per degree of freedom; NaN without covariances."""
    if estimator.pose_covariance is None or estimator.landmark_covariances is None:
        return float('nan'), float('nan')
    row = np.searchsorted(world.truth.stamps_ns, stamp_ns)
    pose_error = pose_errors(estimator.pose, world.truth.poses[row])
    point_errors = estimator.world_points - world.landmarks.world_points[estimator.landmark_ids]
    pose, pose_freedom = normalised_squared_errors(pose_error, estimator.pose_covariance)
    points, point_freedom = normalised_squared_errors(point_errors, estimator.landmark_covariances)
    return float(pose / pose_freedom), float(np.mean(points / point_freedom))
