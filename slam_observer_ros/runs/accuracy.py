"""How good estimates are: by their errors where the truth is known, else by their likelihood.

How likely what was seen is by what the filter expected measures its noise, without truth. Each
residual r of a known landmark, given those before it, is N(0, S) with the S that the filter
states, or else an outlier, anywhere in view. As both densities are normalised, no noise is good
for all: too large a one spreads them out (log det S), too small a one leaves r in their tails, and
what the filter rejects is paid for as an outlier.
"""

from __future__ import annotations

from dataclasses import dataclass
import logging
import math

import numpy as np

from slam_observer_ros.common.errors import EvaluationError, significant
from slam_observer_ros.common.findings import found
from slam_observer_ros.common.stamps import to_ns, to_s
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray, is_automatic
from slam_observer_ros.estimates import Smoothed, Update
from slam_observer_ros.estimator.estimate import Estimate
from slam_observer_ros.lie import se3
from slam_observer_ros.models.calibration import (
    DELAY,
    MOVES,
    OF_VELOCITY,
    stated_of_velocity,
)
from slam_observer_ros.recordings.trajectory import filled, Trajectory, Truth
from slam_observer_ros.runs.consistency import anchored_average_nees
from slam_observer_ros.runs.metrics import (
    ConfigurationError,
    landmark_errors,
    trajectory_errors,
    TrajectoryErrors,
)

logger = logging.getLogger(__name__)

STILL = 1e-12
"""Change of a pose, m and rad, below which it is rounding: a robot at rest has no bias."""


@dataclass(frozen=True, slots=True, eq=False)
class Accuracy:
    """Errors of a replay; None where the truth that it takes is not in the recording.

    Poses, dead reckoning and the map are each compared after one rigid alignment of
    their own; the configuration (:class:`.ConfigurationError`) takes none. ``anees`` of the pose
    is also None where the gains know no covariance, and where no pose is certain to which the
    truth could be moved: in a known map, or if the truth begins too late. ``configuration_anees``
    needs no certain pose, but a joint covariance.
    """

    pose_errors: TrajectoryErrors | None
    dead_reckoning_errors: TrajectoryErrors | None
    landmark_rmse_m: float | None
    configuration_rmse_m: float | None
    anees: float | None
    configuration_anees: float | None


def measure(
    trajectory: Trajectory,
    pose_covariances: FloatArray | None,
    dead_reckoning: Trajectory,
    landmarks: tuple[IntArray, FloatArray],
    configuration: ConfigurationError,
    truth: Truth,
) -> Accuracy:
    """Compare what came of a replay with the truth.

    ``pose_covariances`` (k, 6, 6) of the trajectory are None where no pose is certain;
    ``landmarks`` are ids (n,) and positions (n, 3), metres.
    """
    pose_truth = Trajectory(truth.stamps_ns, truth.poses)
    return Accuracy(
        _pose_errors('trajectory', trajectory, pose_truth),
        _pose_errors('dead reckoning', dead_reckoning, pose_truth),
        _landmark_rmse_m(*landmarks, truth),
        configuration.rmse_m,
        _anees(trajectory, pose_covariances, pose_truth),
        configuration.anees,
    )


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedAccuracy:
    """Errors of what was smoothed, as :class:`Accuracy` has them, and of what it was before."""

    pose_errors: TrajectoryErrors | None
    online_errors: TrajectoryErrors | None  # at the same stamps
    landmark_rmse_m: float | None


def measure_smoothed(
    smoothed: Smoothed, trajectory: Trajectory, online: Trajectory, truth: Truth
) -> SmoothedAccuracy:
    """Compare what was smoothed, with its trajectory at some of the online one's stamps."""
    pose_truth = Trajectory(truth.stamps_ns, truth.poses)
    same = np.isin(online.stamps_ns, trajectory.stamps_ns)
    before = Trajectory(online.stamps_ns[same], online.poses[same])
    return SmoothedAccuracy(
        _pose_errors('smoothed trajectory', trajectory, pose_truth),
        _pose_errors('trajectory before smoothing', before, pose_truth),
        _landmark_rmse_m(smoothed.ids, smoothed.world_points, truth),
    )


def smoothed_trajectory(
    smoothed: Smoothed,
    stamps_ns: IntArray,
    dead_reckoning: Trajectory,
    estimator: Estimate,
) -> Trajectory:
    """Return the smoothed poses at any stamps (m,), such as the online trajectory's.

    Between observations, and beyond the first and last one, the robot moved as the velocities
    have it by the calibration of an ``estimator``.
    """
    estimate = Trajectory.from_samples(smoothed.stamps_ns.tolist(), list(smoothed.poses))
    return filled(estimate, _calibrated(dead_reckoning, estimator), stamps_ns)


def _calibrated(motion: Trajectory, estimator: Estimate) -> Trajectory:
    """Return dead reckoning as it is with the scales, biases and the delay of the velocities."""
    if len(motion) < 2:
        return motion
    values = stated_of_velocity(estimator.settings)
    found = {estimate.name: estimate.value for estimate in estimator.calibration}
    for entry in OF_VELOCITY:
        values[entry.place] = found.get(entry.name, values[entry.place])
    rates = values[:DELAY].reshape(6, 7)
    dt_s = to_s(np.diff(motion.stamps_ns))[:, None]
    twists = se3.log(se3.inverse(motion.poses[:-1]) @ motion.poses[1:])
    moves = np.abs(twists).max(axis=1, keepdims=True) > STILL
    biases = rates[:, MOVES] * np.where(moves, dt_s, 0.0)
    poses = se3.path(motion.poses[0], twists @ rates[:, :MOVES].T + biases)
    return Trajectory(motion.stamps_ns + to_ns(values[DELAY]), poses)


def _pose_errors(name: str, estimate: Trajectory, truth: Trajectory) -> TrajectoryErrors | None:
    if not len(truth):
        return None
    try:
        return trajectory_errors(estimate, truth)
    except EvaluationError as error:
        logger.warning('%s', found('uncompared', figure=name, error=error))
        return None


def _anees(
    trajectory: Trajectory, pose_covariances: FloatArray | None, truth: Trajectory
) -> float | None:
    if pose_covariances is None:
        return None
    try:
        return anchored_average_nees(trajectory, pose_covariances, truth)
    except EvaluationError as error:
        logger.warning('%s', found('unknown_anees', error=error))
        return None


def _landmark_rmse_m(ids: IntArray, world_points: FloatArray, truth: Truth) -> float | None:
    if truth.landmarks is None or (len(ids) and is_automatic(ids).all()):
        return None  # landmarks without ids of their own have no counterpart
    try:
        errors = landmark_errors(ids, world_points, truth.landmarks)
    except EvaluationError as error:
        logger.warning('%s', found('uncompared', figure='map', error=error))
        return None
    return errors.rmse_m


ACCURACY_ROWS = {
    'ate_rmse_m': ('position error (ATE), RMS', 'm after alignment'),
    'dead_reckoning_ate_rmse_m': ('of the velocities alone', 'm after alignment'),
    'unaligned_rmse_m': ('position error, not aligned', "m if the truth is in the map's frame"),
    'heading_rmse_rad': ('heading error, RMS', '° after alignment'),
    'landmark_rmse_m': ('landmark error, RMS', 'm after alignment'),
    'configuration_rmse_m': ('configuration error, RMS', 'm, not aligned'),
    'anees': ('ANEES of the pose', '(1 is consistent)'),
    'configuration_anees': ('ANEES of the configuration', '(1 is consistent)'),
    'unsmoothed_ate_rmse_m': ('of the part that is smoothed, online', 'm after alignment'),
    'smoothed_ate_rmse_m': ('smoothed: position error, RMS', 'm after alignment'),
    'smoothed_landmark_rmse_m': ('smoothed: landmark error, RMS', 'm after alignment'),
}
"""Figures of ``--json`` that are in the table, their names there and their units."""

FIGURES = (*ACCURACY_ROWS, 'nis', 'seconds')
"""What runs are compared by."""


def figure_text(key: str, figure: float, unit: str) -> str:
    """Return a figure as people read it: angles in degrees."""
    number = math.degrees(figure) if key.endswith('_rad') else figure
    return f'{significant(number)} {unit}'


OUTLIERS = 0.02
"""Share of the points that are taken for outliers: sensors have some per cent of them."""


@dataclass(frozen=True, slots=True, eq=False)
class Likelihood:
    """Log densities of all residuals of a run, in natural logarithms.

    ``shares`` say how much of an observation each is: those whose errors last, as
    ``observation_correlation_time`` has it, are together one.
    """

    stamps_ns: IntArray  # (m,)
    log_densities: FloatArray  # (m,)
    shares: FloatArray  # (m,)

    def select(self, mask: BoolArray) -> Likelihood:
        """Return the part that ``mask`` (m,) picks."""
        return Likelihood(self.stamps_ns[mask], self.log_densities[mask], self.shares[mask])

    @property
    def total(self) -> float:
        """Log likelihood of them all."""
        return float(self.shares @ self.log_densities)

    @property
    def mean(self) -> float:
        """The same per observation with new errors; −∞ if there is none."""
        return self.total / self.count if self.count > 0.0 else -math.inf

    @property
    def count(self) -> float:
        """How many observations with new errors there are."""
        return float(self.shares.sum())


class LikelihoodRecorder:
    """Notes the likelihood of each observation of a run; a point has the ``dimension``."""

    def __init__(self, dimension: int, reach_m: float) -> None:
        ball = math.pi ** (dimension / 2) / math.gamma(dimension / 2 + 1) * reach_m**dimension
        self.log_outlier = math.log(OUTLIERS / ball)
        self.clear()

    def clear(self) -> None:
        """Forget all: the run has started again."""
        self._stamps_ns: list[int] = []
        self._log_densities: list[FloatArray] = []
        self._shares: list[FloatArray] = []

    def note_update(self, update: Update) -> None:
        """Take in an observation, whose innovation the estimator has judged."""
        innovation = update.innovation
        if innovation is None:
            return
        regular = math.log1p(-OUTLIERS) + innovation.log_densities
        self._log_densities.append(np.logaddexp(regular, self.log_outlier))
        self._shares.append(innovation.shares)
        self._stamps_ns += [update.stamp_ns] * len(regular)

    @property
    def likelihood(self) -> Likelihood:
        """What was noted so far."""
        none = np.empty(0)
        return Likelihood(
            np.array(self._stamps_ns, dtype=np.int64),
            np.concatenate([none, *self._log_densities]),
            np.concatenate([none, *self._shares]),
        )
