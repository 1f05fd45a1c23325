"""Accuracy and consistency of an estimate against the truth."""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import asdict, dataclass, field
import json

import numpy as np
from scipy import special

from slam_observer_ros.evaluation.alignment import align
from slam_observer_ros.evaluation.errors import EvaluationError
from slam_observer_ros.evaluation.trajectory import associate, MAX_GAP_NS, Trajectory
from slam_observer_ros.events import is_automatic, LandmarkTruth
from slam_observer_ros.geometry import se3, so3
from slam_observer_ros.types import BoolArray, FloatArray, IntArray

_SINGULAR = 1e-12
"""Eigenvalues of a correlation matrix below this are zero but for rounding."""


def root_mean_square(errors: FloatArray) -> float:
    """Take the root of the mean squared length of error vectors.

    Parameters
    ----------
    errors : FloatArray
        (k, d) errors, k > 0, or (k,) scalar ones.

    """
    return float(np.sqrt(np.sum(errors**2) / len(errors)))


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryErrors:
    """Errors of a trajectory after one rigid alignment of its positions.

    Attributes
    ----------
    estimate : Trajectory
        (k) estimated poses that the truth covers, moved into the truth's world.
    truth : Trajectory
        (k) true poses at the same stamps.
    covered : BoolArray
        Which poses of the whole estimate these k are.
    alignment : FloatArray
        (4, 4) transform from the estimate's world to the truth's.
    errors : FloatArray
        (k, 6) :func:`pose_errors` in the truth's world axes, rad and m.

    """

    estimate: Trajectory
    truth: Trajectory
    covered: BoolArray
    alignment: FloatArray
    errors: FloatArray

    @property
    def ate_rmse_m(self) -> float:
        """Absolute trajectory error: RMSE of the position, metres."""
        return root_mean_square(self.errors[:, 3:])

    @property
    def rotation_rmse_rad(self) -> float:
        """RMSE of the angle between estimated and true attitude, radians."""
        return root_mean_square(self.errors[:, :3])

    @property
    def heading_rmse_rad(self) -> float:
        """RMSE of the rotation about the world's vertical axis, radians."""
        return root_mean_square(self.errors[:, 2])


def trajectory_errors(
    estimate: Trajectory, truth: Trajectory, max_gap_ns: int = MAX_GAP_NS
) -> TrajectoryErrors:
    """Compare a trajectory with the truth after one rigid alignment of all positions.

    Parameters
    ----------
    estimate : Trajectory
        Estimated poses, in any world frame.
    truth : Trajectory
        True poses, at any rate.
    max_gap_ns : int
        Longest gap in the truth that is interpolated, nanoseconds.

    Raises
    ------
    EvaluationError
        The truth covers no pose of the estimate.

    """
    paired, true_paired, covered = associate(estimate, truth, max_gap_ns)
    if len(paired) == 0:
        raise EvaluationError('no pose of the estimate is at a time that the truth covers')
    alignment = align(paired.positions, true_paired.positions)
    aligned = paired.moved(alignment)
    errors = pose_errors(aligned.poses, true_paired.poses)
    return TrajectoryErrors(aligned, true_paired, covered, alignment, errors)


def pose_errors(poses: FloatArray, true_poses: FloatArray) -> FloatArray:
    """Compute errors in the order and axes of the estimator's pose covariance.

    Parameters
    ----------
    poses, true_poses : FloatArray
        (..., 4, 4) estimated and true poses in one world frame.

    Returns
    -------
    FloatArray
        (..., 6) rotation vector log(R̂ Rᵀ), rad, then x̂ − x, m, both in world axes.

    """
    R_error = poses[..., :3, :3] @ true_poses[..., :3, :3].swapaxes(-1, -2)
    return np.concatenate([so3.log(R_error), poses[..., :3, 3] - true_poses[..., :3, 3]], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkErrors:
    """Errors of a map after one rigid alignment of the landmarks whose truth is known.

    Attributes
    ----------
    ids : IntArray
        (m,) landmarks in both maps.
    alignment : FloatArray
        (4, 4) transform from the estimate's world to the truth's.
    errors : FloatArray
        (m, 3) aligned estimate minus truth, metres.

    """

    ids: IntArray
    alignment: FloatArray
    errors: FloatArray

    @property
    def rmse_m(self) -> float:
        """RMSE of the landmark positions, metres."""
        return root_mean_square(self.errors)


def landmark_errors(
    ids: IntArray, world_points: FloatArray, truth: LandmarkTruth
) -> LandmarkErrors:
    """Compare a map with the truth after one rigid alignment of the common landmarks.

    Parameters
    ----------
    ids : IntArray
        (n,) estimated landmarks, each once.
    world_points : FloatArray
        (n, 3) their positions in the estimate's world, metres.
    truth : LandmarkTruth
        True positions.

    Raises
    ------
    EvaluationError
        No landmark is in both maps.

    """
    common, rows, true_rows = np.intersect1d(ids, truth.ids, return_indices=True)
    if len(common) == 0:
        raise EvaluationError('no landmark is in both the estimated map and the true one')
    points, true_points = world_points[rows], truth.world_points[true_rows]
    alignment = align(points, true_points)
    return LandmarkErrors(common, alignment, se3.transform(alignment, points) - true_points)


@dataclass(slots=True)
class ConfigurationError:
    """Error on the quotient M_n(3) of the paper: the map as the robot sees it, gauge-free.

    After each observation, the RMS over all landmarks known so far of |P̂⁻¹ p̂_i − P⁻¹ p_i|;
    over a run, the RMS of that. Where a world frame lies plays no part, so nothing is aligned.

    Attributes
    ----------
    stamps_ns : list of int
        When :meth:`add` found landmarks to compare.
    values_m : list of float
        The error at these times, metres.

    """

    stamps_ns: list[int] = field(default_factory=list)
    values_m: list[float] = field(default_factory=list)
    _votes: defaultdict[int, Counter[int]] = field(default_factory=lambda: defaultdict(Counter))

    def add(
        self,
        stamp_ns: int,
        pose: FloatArray,
        ids: IntArray,
        world_points: FloatArray,
        true_pose: FloatArray,
        truth: LandmarkTruth,
    ) -> None:
        """Take in one configuration, once after each observation.

        Parameters
        ----------
        stamp_ns : int
            Time of the observation, nanoseconds.
        pose : FloatArray
            (4, 4) estimated pose.
        ids : IntArray
            (n,) landmarks known so far; those without truth are passed over. One whose sensor
            gave no id stands for the true landmark that it was nearest to most often so far, as
            seen by the robot.
        world_points : FloatArray
            (n, 3) their estimated positions in the estimate's world, metres.
        true_pose : FloatArray
            (4, 4) true pose at that time.
        truth : LandmarkTruth
            True landmark positions at that time.

        """
        if not len(truth.ids):
            return
        seen = se3.transform(se3.inverse(pose), world_points)
        true_seen = se3.transform(se3.inverse(true_pose), truth.world_points)
        for row in np.flatnonzero(is_automatic(ids)):
            nearest = np.argmin(np.linalg.norm(true_seen - seen[row], axis=1))
            self._votes[int(ids[row])][int(truth.ids[nearest])] += 1
        true_ids = np.array([self._true_id(i) for i in ids.tolist()], dtype=np.int64)
        rows, true_rows = np.nonzero(true_ids[:, None] == truth.ids)
        if not len(rows):
            return
        self.stamps_ns.append(stamp_ns)
        self.values_m.append(root_mean_square(seen[rows] - true_seen[true_rows]))

    def _true_id(self, landmark_id: int) -> int:
        votes = self._votes.get(landmark_id)
        return landmark_id if votes is None else votes.most_common(1)[0][0]

    @property
    def rmse_m(self) -> float | None:
        """RMS over the run, metres; None before anything could be compared."""
        return root_mean_square(np.array(self.values_m)) if self.values_m else None


def normalised_squared_errors(
    errors: FloatArray, covariances: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Compute the NEES εᵀ Σ⁻¹ ε, χ²-distributed where the covariance is honest.

    A direction of no variance is one that is known exactly (roll, pitch and height in planar
    mode): it is left out, and counts for no degree of freedom.

    Parameters
    ----------
    errors : FloatArray
        (..., d) errors.
    covariances : FloatArray
        (..., d, d) their covariances.

    Returns
    -------
    nees : FloatArray
        (...) normalised estimation errors squared.
    degrees_of_freedom : IntArray
        (...) number of directions that are not known exactly.

    Raises
    ------
    EvaluationError
        A covariance has a negative eigenvalue.

    """
    variances = np.diagonal(covariances, axis1=-2, axis2=-1)
    deviations = np.sqrt(np.where(variances > 0.0, variances, 1.0))
    # As correlations, radians and metres are of one size and one threshold serves both.
    correlations = covariances / (deviations[..., :, None] * deviations[..., None, :])
    eigenvalues, directions = np.linalg.eigh(correlations)
    if eigenvalues.min(initial=0.0) < -_SINGULAR:
        raise EvaluationError('a covariance has a negative eigenvalue')
    uncertain = eigenvalues > _SINGULAR
    components = (directions.swapaxes(-1, -2) @ (errors / deviations)[..., None])[..., 0]
    squares = np.where(uncertain, components**2, 0.0) / np.where(uncertain, eigenvalues, 1.0)
    return squares.sum(axis=-1), uncertain.sum(axis=-1)


def average_nees(errors: FloatArray, covariances: FloatArray) -> float | None:
    """Compute the ANEES per degree of freedom: 1 where the covariances are honest.

    Parameters
    ----------
    errors : FloatArray
        (..., d) errors of all runs and times.
    covariances : FloatArray
        (..., d, d) their covariances.

    Returns
    -------
    float or None
        Sum of the NEES over the sum of the degrees of freedom; above 1 is overconfident, below
        1 too cautious; None where every component is known exactly.

    """
    nees, degrees_of_freedom = normalised_squared_errors(errors, covariances)
    total = int(degrees_of_freedom.sum())
    return float(nees.sum() / total) if total else None


def average_nees_band(
    degrees_of_freedom: int, runs: int, confidence: float = 0.95
) -> tuple[float, float]:
    """Bound the ANEES per degree of freedom of an honest estimator, by the χ² distribution.

    Parameters
    ----------
    degrees_of_freedom : int
        Of one error: 6 for a pose, 3 for a landmark or a planar pose.
    runs : int
        Independent runs averaged.
    confidence : float
        Probability of lying inside the band.

    Returns
    -------
    lower, upper : float
        The band's limits, each missed with the same probability.

    """
    total = degrees_of_freedom * runs
    # chdtri inverts the χ² tail. scipy.stats has it too, but takes a second to import.
    tail = 0.5 * (1.0 - confidence)
    return (
        float(special.chdtri(total, 1.0 - tail) / total),
        float(special.chdtri(total, tail) / total),
    )


def anchored_average_nees(
    estimate: Trajectory,
    covariances: FloatArray,
    truth: Trajectory,
    max_gap_ns: int = MAX_GAP_NS,
) -> float | None:
    """Compute the pose's ANEES of one run, with the truth moved onto its first estimated pose.

    An estimator declares its first pose certain: that is its gauge. A fit over the whole run
    would hide errors that its covariance counts.

    Parameters
    ----------
    estimate : Trajectory
        k estimated poses.
    covariances : FloatArray
        (k, 6, 6) of world-axes rotation vector and position.
    truth : Trajectory
        True poses, at any rate.
    max_gap_ns : int
        Longest gap in the truth that is interpolated, nanoseconds.

    Returns
    -------
    float or None
        As :func:`average_nees`; None where the truth covers no pose.

    """
    paired, true_paired, covered = associate(estimate, truth, max_gap_ns)
    if len(paired) == 0:
        return None
    anchored = true_paired.moved(paired.poses[0] @ se3.inverse(true_paired.poses[0]))
    return average_nees(pose_errors(paired.poses, anchored.poses), covariances[covered])


@dataclass(frozen=True, slots=True)
class Report:
    """What a run did and how accurate it was: the object that ``--json`` prints.

    Attributes
    ----------
    events : int
        Events taken in, dropped ones included.
    duration_s : float
        Time that the recording spans, seconds.
    seconds : float
        Wall time that the run took, seconds.
    landmarks : int
        Landmarks in the final map.
    dropped : dict of str to int
        Events dropped, by reason.
    ate_rmse_m, rotation_rmse_rad, heading_rmse_rad : float or None
        See :class:`TrajectoryErrors`; None without truth.
    landmark_rmse_m : float or None
        See :class:`LandmarkErrors`; None without truth.
    configuration_rmse_m : float or None
        See :class:`ConfigurationError`; None without truth.
    anees : float or None
        Of the pose, per degree of freedom; None without truth or covariance.

    """

    events: int
    duration_s: float
    seconds: float
    landmarks: int
    dropped: dict[str, int]
    ate_rmse_m: float | None = None
    rotation_rmse_rad: float | None = None
    heading_rmse_rad: float | None = None
    landmark_rmse_m: float | None = None
    configuration_rmse_m: float | None = None
    anees: float | None = None

    def to_json(self) -> str:
        """Write the report as one JSON object; what was not measured is null."""
        return json.dumps(asdict(self), allow_nan=False)
