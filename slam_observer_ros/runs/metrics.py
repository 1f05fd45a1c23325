"""Accuracy of an estimated trajectory and map against the truth, and consistency of covariances.

The configuration error belongs to the paper's quotient: the map as the robot sees it.
NEES: normalised estimation error squared, εᵀ Σ⁻¹ ε; ANEES: its mean, per degree of freedom.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from slam_observer_ros.common.errors import EvaluationError
from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray, is_automatic
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.matrices import transpose
from slam_observer_ros.lie.se3 import rigid_alignment
from slam_observer_ros.recordings.trajectory import (
    associate,
    is_sparse,
    LandmarkTruth,
    MAX_GAP_NS,
    Trajectory,
)

MIN_POSES = 3  # fewer positions can be aligned without an error left


def root_mean_square(errors: FloatArray) -> float:
    """Return the root of the mean squared length of errors (k, d), or of values (k,); k > 0."""
    return float(np.sqrt(np.sum(errors**2) / len(errors)))


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryErrors:
    """Errors of a trajectory after one rigid alignment of its positions.

    ``estimate`` are the k poses that the truth covers, moved into the truth's world by
    ``alignment`` (4, 4), and ``truth`` those at the same stamps; ``covered`` says which poses of
    the whole estimate these are. ``errors`` are :func:`pose_errors` (k, 6) in the truth's axes.
    """

    estimate: Trajectory
    truth: Trajectory
    covered: BoolArray
    alignment: FloatArray
    errors: FloatArray

    @property
    def covered_share(self) -> float:
        """Share of the estimate that the truth covers; of a sparse one, from its first pose on."""
        if not is_sparse(self.truth):
            return float(self.covered.mean())
        first, last = np.flatnonzero(self.covered)[[0, -1]].tolist()
        return float((last - first + 1) / len(self.covered))

    @property
    def ate_rmse_m(self) -> float:
        """Absolute trajectory error: RMSE of the position, metres."""
        return root_mean_square(self.errors[:, 3:])

    @property
    def distances_m(self) -> FloatArray:
        """(k,) distances from the truth, metres."""
        return np.asarray(np.linalg.norm(self.errors[:, 3:], axis=1))

    @property
    def unaligned_rmse_m(self) -> float:
        """The same without the alignment, for an estimate in the truth's frame, metres."""
        return root_mean_square(self.in_estimate(self.estimate.positions) - self.truth.positions)

    @property
    def aligned_truth(self) -> Trajectory:
        """The true poses in the world of the estimate before the alignment."""
        return self.truth.moved(se3.inverse(self.alignment))

    def in_estimate(self, points: FloatArray) -> FloatArray:
        """Return points (n, 3) of the truth's world in the estimate's world, metres."""
        return se3.transform(se3.inverse(self.alignment), points)

    @property
    def rotation_rmse_rad(self) -> float:
        """RMSE of the angle between estimated and true attitude, radians."""
        return root_mean_square(self.errors[:, :3])

    @property
    def heading_rmse_rad(self) -> float:
        """RMSE of the rotation about the world's vertical axis, radians."""
        return root_mean_square(self.errors[:, 2])


def trajectory_errors(estimate: Trajectory, truth: Trajectory) -> TrajectoryErrors:
    """Compare a trajectory with the truth after one rigid alignment of all positions.

    Raises an EvaluationError if the truth covers fewer than three poses: these fit in any case.
    """
    paired, true_paired, covered = associate(estimate, truth)
    if len(paired) < MIN_POSES:
        raise EvaluationError(
            f'{len(paired)} of its {len(estimate)} poses are at times that the truth covers, '
            f'where one of the two has poses no more than {to_s(MAX_GAP_NS)} s apart; '
            f'it takes {MIN_POSES}'
        )
    alignment = rigid_alignment(paired.positions, true_paired.positions)
    aligned = paired.moved(alignment)
    errors = pose_errors(aligned.poses, true_paired.poses)
    return TrajectoryErrors(aligned, true_paired, covered, alignment, errors)


def pose_errors(poses: FloatArray, true_poses: FloatArray) -> FloatArray:
    """Return errors (..., 6) in the order and axes of the estimator's pose covariance.

    The rotation vector log(R̂ Rᵀ), rad, then x̂ − x, m, both in the axes of the one world in which
    the poses (..., 4, 4) are.
    """
    R_error = poses[..., :3, :3] @ transpose(true_poses[..., :3, :3])
    return np.concatenate([so3.log(R_error), poses[..., :3, 3] - true_poses[..., :3, 3]], axis=-1)


def landmark_rmse_m(ids: IntArray, world_points: FloatArray, truth: LandmarkTruth) -> float:
    """Return the RMSE of a map's landmarks (n,) whose truth is known, after rigid alignment.

    Each of the ids is there once. Raises an EvaluationError if no landmark is in both maps.
    """
    common, rows, true_rows = np.intersect1d(ids, truth.ids, return_indices=True)
    if len(common) == 0:
        raise EvaluationError('no landmark is in both the estimated map and the true one')
    points, true_points = world_points[rows], truth.world_points[true_rows]
    alignment = rigid_alignment(points, true_points)
    return root_mean_square(se3.transform(alignment, points) - true_points)


@dataclass(frozen=True, slots=True)
class Decay:
    """A straight line in log10 L: its slope, decades per second, and its value at time zero."""

    slope_per_s: float
    log10_at_zero: float


def fit_decay(times_s: FloatArray, lyapunov: FloatArray, floor: float) -> Decay | None:
    """Fit a line to log10 L over time, after the transient and before rounding is felt.

    L (k,) at ``times_s`` (k,) counts until it first falls below ``floor``, where rounding is felt;
    the transient is taken to be over at half of that time. None if there are fewer than two
    values to fit.
    """
    below = np.flatnonzero(lyapunov <= floor)
    end = int(below[0]) if len(below) else len(lyapunov)
    if end - end // 2 < 2:
        return None
    fitted = slice(end // 2, end)
    slope_per_s, log10_at_zero = np.polyfit(times_s[fitted], np.log10(lyapunov[fitted]), 1)
    return Decay(float(slope_per_s), float(log10_at_zero))


MAX_JOINT = 100  # landmarks whose errors are normalised together: it costs the cube of them
ROUNDING = 1e-13  # share of the total variance that rounding may have left out of a direction


@dataclass(slots=True)
class ConfigurationError:
    """Error on the quotient M_n(3) of the paper: the map as the robot sees it, gauge-free.

    After each observation, the RMS over all landmarks known so far of |P̂⁻¹ p̂_i − P⁻¹ p_i|;
    over a run, the RMS of that. Where a world frame lies plays no part, so nothing is aligned.
    ``values_m`` are of ``stamps_ns``, when there were landmarks to compare; ``nees`` are the
    normalised squared errors per degree of freedom, of those with a covariance.
    """

    stamps_ns: list[int] = field(default_factory=list)
    values_m: list[float] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    _votes: defaultdict[int, Counter[int]] = field(default_factory=lambda: defaultdict(Counter))

    def add(
        self,
        stamp_ns: int,
        pose: FloatArray,
        ids: IntArray,
        world_points: FloatArray,
        true_pose: FloatArray,
        truth: LandmarkTruth,
        covariance_of: Callable[[IntArray], FloatArray | None] | None = None,
        seen_ids: IntArray | None = None,
    ) -> None:
        """Take in one configuration and the truth at that time, once after each observation.

        Of the landmarks ``ids`` (n,) known so far those without truth are passed over. One whose
        sensor gave no id stands for the true landmark that it was nearest to most often when it
        was seen (by default now): at other times drift puts it next to others. ``covariance_of``
        gives the joint covariance (m k, m k) of rows (m,) of the landmarks as seen by the robot,
        of their first k coordinates, m², or None.
        """
        if not len(truth.ids):
            return
        seen = se3.transform(se3.inverse(pose), world_points)
        true_seen = se3.transform(se3.inverse(true_pose), truth.world_points)

        # Which true landmark each is
        without_id = is_automatic(ids)
        if np.count_nonzero(without_id):
            without_id &= np.isin(ids, ids if seen_ids is None else seen_ids)
            for landmark_id, point in zip(ids[without_id].tolist(), seen[without_id], strict=True):
                nearest = np.argmin(np.linalg.norm(true_seen - point, axis=1))
                self._votes[landmark_id][int(truth.ids[nearest])] += 1
        rows, true_rows = np.nonzero(self.true_ids(ids)[:, None] == truth.ids)
        if not len(rows):
            return

        # How far it is off, and how likely that is
        self.stamps_ns.append(stamp_ns)
        errors = seen[rows] - true_seen[true_rows]
        self.values_m.append(root_mean_square(errors))
        if covariance_of is not None:
            some = slice(None, None, -(-len(rows) // MAX_JOINT))
            P = covariance_of(rows[some])
            if P is not None:
                self.nees.append(_nees(errors[some], P))

    def true_ids(self, ids: IntArray) -> IntArray:
        """Return the true landmark (n,) that each stands for; its own id where it had one."""
        most = {i: votes.most_common(1)[0][0] for i, votes in self._votes.items()}
        return np.array([most.get(i, i) for i in ids.tolist()], dtype=np.int64)

    @property
    def anees(self) -> float | None:
        """Mean of the normalised squared errors; None if there are none."""
        return float(np.mean(self.nees)) if self.nees else None

    @property
    def rmse_m(self) -> float | None:
        """RMS over the run, metres; None before anything could be compared."""
        return root_mean_square(np.array(self.values_m)) if self.values_m else None


def _nees(errors: FloatArray, P: FloatArray) -> float:
    """Return eᵀ P⁻¹ e per degree of freedom of errors (m, 3); P (m k, m k) has k of them."""
    e = errors[:, : len(P) // len(errors)].ravel()
    regular = P + ROUNDING * np.trace(P) * np.eye(len(P))
    return float(e @ np.linalg.solve(regular, e)) / len(e)


MAX_SHARE_OF_ANCHOR = 0.1  # ANEES that the anchor's own error may make up; all errors together: 1
_SINGULAR = 1e-12  # eigenvalues of a correlation matrix below this are zero but for rounding


def normalised_squared_errors(
    errors: FloatArray, covariances: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Return NEES (...) of errors (..., d) by covariances (..., d, d), and degrees of freedom.

    It is χ²-distributed where these are honest. A direction of no variance is one that is known
    exactly (roll, pitch and height in planar mode): it is left out, and counts for no degree of
    freedom. Raises an EvaluationError if a covariance has a negative eigenvalue.
    """
    variances = np.diagonal(covariances, axis1=-2, axis2=-1)
    deviations = np.sqrt(np.where(variances > 0.0, variances, 1.0))
    # As correlations, radians and metres are of one size and one threshold serves both.
    correlations = covariances / (deviations[..., :, None] * deviations[..., None, :])
    eigenvalues, directions = np.linalg.eigh(correlations)
    if eigenvalues.min(initial=0.0) < -_SINGULAR:
        raise EvaluationError('a covariance has a negative eigenvalue')
    uncertain = eigenvalues > _SINGULAR
    components = (transpose(directions) @ (errors / deviations)[..., None])[..., 0]
    squares = np.where(uncertain, components**2, 0.0) / np.where(uncertain, eigenvalues, 1.0)
    return squares.sum(axis=-1), uncertain.sum(axis=-1)


def average_nees(errors: FloatArray, covariances: FloatArray) -> float | None:
    """Return the ANEES: above 1 is overconfident, below too cautious; None where all is exact."""
    nees, degrees_of_freedom = normalised_squared_errors(errors, covariances)
    total = int(degrees_of_freedom.sum())
    return float(nees.sum() / total) if total else None


def average_nees_band(
    degrees_of_freedom: int, runs: int, confidence: float = 0.95
) -> tuple[float, float]:
    """Return the band in which the ANEES of an honest estimator lies with that confidence.

    The χ² distribution of an error of so many degrees of freedom (6 for a pose, 3 for a landmark
    or a planar pose), averaged over independent runs. Each limit is missed as often.
    """
    total = degrees_of_freedom * runs
    from scipy import special  # which few runs need; scipy.stats takes a second to import

    # chdtri inverts the χ² tail.
    tail = 0.5 * (1.0 - confidence)
    return (
        float(special.chdtri(total, 1.0 - tail) / total),
        float(special.chdtri(total, tail) / total),
    )


def anchored_average_nees(
    estimate: Trajectory, covariances: FloatArray, truth: Trajectory
) -> float | None:
    """Return the pose's ANEES of one run, with the truth moved onto its first estimated pose.

    An estimator declares its first pose certain: that is its gauge. A fit over the whole run
    would hide errors that its covariance counts. The covariances (k, 6, 6) are of rotation vector
    and position, world axes. None where the truth covers no pose; an EvaluationError is raised if
    it begins when the pose is uncertain already.
    """
    paired, true_paired, covered = associate(estimate, truth)
    if len(paired) == 0:
        return None
    if _nees_of_anchor(paired, covariances[covered]) > MAX_SHARE_OF_ANCHOR:
        late_s = to_s(paired.stamps_ns[0] - estimate.stamps_ns[0])
        raise EvaluationError(
            f'the truth begins {late_s:.1f} s after the estimate, when the pose is uncertain '
            'already'
        )
    anchored = true_paired.moved(paired.poses[0] @ se3.inverse(true_paired.poses[0]))
    return average_nees(pose_errors(paired.poses, anchored.poses), covariances[covered])


def _nees_of_anchor(estimate: Trajectory, covariances: FloatArray) -> float:
    """Return what the first pose's error adds to the ANEES if the truth is moved onto it.

    It turns all other poses about the first one, and shifts them.
    """
    if not covariances[0].any():  # as nearly always
        return 0.0
    variances, directions = np.linalg.eigh(covariances[0])
    turns, shifts = np.split(
        directions.T * np.sqrt(np.maximum(variances, 0.0))[:, None], 2, axis=1
    )
    arms = estimate.positions - estimate.positions[0]
    moved = shifts + np.cross(turns, arms[:, None])
    errors = np.concatenate([np.broadcast_to(turns, moved.shape), moved], axis=2)
    return average_nees(errors, covariances[:, None]) or 0.0


CHI_SQUARE_95 = 5.991464547107979  # squared half-axis, in σ, of the ellipse of 95 % in a plane
