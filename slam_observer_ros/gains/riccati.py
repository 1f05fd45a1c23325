"""Riccati gains: the equivariant filter on SLAM_n(3), with a full covariance.

The error E = X̂ X⁻¹ = (Ã, ã_i) (proof of Theorem 5.1) does not move while the robot does, so with
Ã = exp(ε) the state of the filter is x = (ε, c, ã_1 … ã_n), c being the errors of the velocity's
calibration. The residual is, by (33), r_i = Ã y_i° − ã_i − y_i° ≈ C_i x with

    C_i = [ −[y_i°]×  I  0 … −I … 0 ].

What no observation can tell, the choice of the world's frame, is exactly in its null space, so
the covariance stays honest. While â_i = 0, which :meth:`RiccatiGains.settle` sees to after each
correction (the reference ξ° is arbitrary), the motion's noise touches Ã alone. Then

    prediction   P ← P + Ad_Â Q Ad_Âᵀ in the pose block alone: O(1), however large the map
    update       K = P Cᵀ (C P Cᵀ + R)⁻¹,   X̂ ← exp(−K r) · X̂

at O(m n) for m landmarks seen plus O(m n²) to update the covariance of n known ones.

With ``landmark_velocity_error`` each landmark has an unknown velocity u_i in the reference frame
as well; ã_i then grows by ũ_i dt, prediction costs O(n²), and there is no looking back.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.gains.base import GainDesign, Residuals, Seen
from slam_observer_ros.gains.gauge import anchor
from slam_observer_ros.gains.hindsight import Hindsight
from slam_observer_ros.gains.history import History
from slam_observer_ros.gains.joint_covariance import JointCovariance
from slam_observer_ros.gains.linear import solve
from slam_observer_ros.gains.prediction import predict
from slam_observer_ros.gains.robust import (
    are_far,
    block_diagonal,
    far_from_the_others,
    mahalanobis,
    observation_weights,
    with_blocks,
)
from slam_observer_ros.geometry import slam_group, so3
from slam_observer_ros.geometry.axes import axes_of
from slam_observer_ros.motion.calibration import Calibration
from slam_observer_ros.motion.motion import Motion
from slam_observer_ros.observer import Correction, Observer
from slam_observer_ros.settings import Settings
from slam_observer_ros.smoothing.gauss_newton import Solution
from slam_observer_ros.types import BoolArray, FloatArray, IntArray


class RiccatiGains(GainDesign):
    """Gains from the full covariance of pose, velocity calibration and landmarks.

    Parameters
    ----------
    settings : Settings
        Noise, calibration, robustness and ``two_d_mode``.

    Attributes
    ----------
    calibration : Calibration
        Scale, bias and delay of the velocity, as far as they are known.

    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._axes = axes_of(settings.two_d_mode)
        self.calibration = Calibration(settings, self._axes)
        self._p = len(self._axes.pose)
        self._is_moving = settings.landmark_velocity_error > 0.0
        self._joint = JointCovariance(
            self._axes, self.calibration, settings.landmark_velocity_error
        )
        self._hindsight = Hindsight(self._axes, settings, self.calibration, self._joint)

    def change_settings(self, settings: Settings) -> None:
        """Take over the robustness."""
        self._settings = self._hindsight.settings = settings

    @property
    def calibration_variances(self) -> FloatArray:
        """(c,) variances of what is estimated of the calibration."""
        variances: FloatArray = np.diagonal(self._joint.P)[self._p : self._joint.first]
        return variances

    @property
    def pose_covariance(self) -> FloatArray:
        """(6, 6) covariance of the pose error ε; zero on axes that are not estimated."""
        return self._axes.full_pose_covariance(self._joint.pose)

    def pose_covariance_after(self, motion: Motion) -> FloatArray:
        """Return what it will be after a motion yet to be predicted (6, 6)."""
        first = self._joint.first
        P = self._joint.P[:first, :first].copy()
        predict(P, self._axes, self.calibration, motion)
        return self._axes.full_pose_covariance(P[: self._p, : self._p])

    @property
    def landmark_covariances(self) -> FloatArray:
        """(n, 3, 3) covariances of the landmark errors ã_i."""
        return self._joint.landmarks

    def predict(self, observer: Observer, motion: Motion) -> None:
        """Add the motion's noise to the pose block, and what the calibration's error adds."""
        if self._is_moving:
            self._predict_moving(observer, motion)
            return
        noise, F = predict(self._joint.P, self._axes, self.calibration, motion)
        if not self.looks_back:
            return
        if observer.u.any():
            # How far they went depends on how the robot was turned, which no smoother here knows.
            self.restart(observer, 'a landmark came with a velocity')
        else:
            self._hindsight.history.move(motion.path, noise, F, self.calibration.values)

    def _predict_moving(self, observer: Observer, motion: Motion) -> None:
        """Predict landmarks that move by ũ_i dt, then the robot at their end.

        Its noise turns R_Ã in ã_i = â_i − R_Ã a_i and ũ_i = û_i − R_Ã u_i, and leaves
        â_i − a_i = ã_i − [â_i]× ω and û_i − u_i = ũ_i − [û_i]× ω alone.
        """
        joint, everything = self._joint, np.arange(self._joint.count)
        a, u = joint.columns(everything), joint.velocity_columns(everything)
        duration_s = np.sum(motion.dt_s + motion.gap_s)
        joint.P[a] += duration_s * joint.P[u]
        joint.P[:, a] += duration_s * joint.P[:, u]
        columns = np.append(a, u)
        vectors = np.concatenate([observer.a, observer.u])
        joint.turn(columns, vectors)
        predict(joint.P, self._axes, self.calibration, motion)
        joint.turn(columns, -vectors)

    def add_landmarks(self, y_ref: FloatArray, covariances: FloatArray) -> None:
        """Append landmarks (m, 3) with room for them in P."""
        self._joint.place_seen(self._joint.make_room(len(y_ref)), y_ref, covariances)

    def relocate_landmarks(
        self, rows: IntArray, y_ref: FloatArray, covariances: FloatArray
    ) -> None:
        """Take landmarks for new ones; what was seen of them before now is forgotten."""
        self._hindsight.history.relocate_landmarks(rows)
        self._joint.place_seen(rows, y_ref, covariances)

    def set_pose_covariance(self, covariance: FloatArray) -> None:
        """Take over the covariance (6, 6) of ε, independent of all else."""
        pose = self._axes.pose
        self._joint.set_pose(covariance[np.ix_(pose, pose)])

    def add_known_landmarks(self, covariances: FloatArray) -> None:
        """Append landmarks whose errors are independent of all else."""
        self._joint.place_known(self._joint.make_room(len(covariances)), covariances)

    def joint_covariance(self, rows: IntArray) -> FloatArray:
        """Return the covariance (p + m k, p + m k) of ε and m landmarks together."""
        return self._joint.with_pose(rows)

    def anchor(
        self, observer: Observer, rows: IntArray, r: FloatArray, covariances: FloatArray
    ) -> Correction:
        """Return the correction that puts the whole estimate where known landmarks are.

        G is taken at y_i°, as C_i is: so it spans what P holds of the gauge already.
        """
        k, joint = self._axes.point, self._joint
        G = np.zeros((len(joint.P), self._p))
        G[: self._p] = np.eye(self._p)
        everything = joint.columns(np.arange(joint.count))
        G[everything] = self._axes.output_matrix(observer.y_ref).reshape(-1, self._p)
        R = block_diagonal(covariances[:, :k, :k])
        x, joint.P = anchor(joint.P, G, joint.columns(rows), R, r[:, :k].ravel())
        return self._as_correction(-x)

    def remove_landmarks(self, rows: IntArray) -> None:
        """Delete the rows and columns of the landmarks at ``rows``."""
        self._hindsight.history.remove_landmarks(rows)
        self._joint.remove(rows)

    def correct(self, residuals: Residuals) -> tuple[Correction, FloatArray]:
        """Return exp(−K r) and the weight that each point was given."""
        k, P = self._axes.point, self._joint.P
        r, noise = residuals.r[:, :k], residuals.covariances[:, :k, :k]
        weights = observation_weights(r, self.foretold(residuals)[1], noise, self._settings)
        passed = weights > 0.0
        used = residuals.select(passed)
        CP, CPC = self._project(used)
        S = with_blocks(CPC, used.covariances[:, :k, :k] / weights[passed, None, None])
        K = solve(S, CP).T
        half = K @ (0.5 * S @ K.T - CP)
        P += half + half.T  # Joseph form: (I − K C) P (I − K C)ᵀ + K R Kᵀ, multiplied out
        return self._as_correction(-K @ used.r[:, :k].ravel()), weights

    def distances(self, residuals: Residuals) -> FloatArray:
        """Return the Mahalanobis distance (m,) of each residual."""
        k = self._axes.point
        columns = self._joint.columns(residuals.rows).reshape(-1, k)
        _, CPC = self._output_covariances(self._chord_output(residuals), columns)
        return mahalanobis(residuals.r[:, :k], CPC + residuals.covariances[:, :k, :k])

    def suspects(self, residuals: Residuals) -> BoolArray:
        """Return which points (m,) only pass the gate since the state is so uncertain."""
        k = self._axes.point
        r, noise = residuals.r[:, :k], residuals.covariances[:, :k, :k]
        far = are_far(r, noise, self._settings)
        if far.any():
            predicted = self.foretold(residuals)[1]
            far &= far_from_the_others(r, predicted, noise, self._settings)
        return far

    def are_all_near(self, residuals: Residuals) -> bool:
        """Return whether all points pass the gate even by the sensor's noise alone.

        This is quickly told, and by all of S they are no further off.
        """
        k = self._axes.point
        own = mahalanobis(residuals.r[:, :k], residuals.covariances[:, :k, :k])
        return bool((own <= self._settings.rejection_distance).all())

    def are_all_rejected(self, residuals: Residuals) -> bool:
        """Return whether there are points seen, and the gate rejects them all."""
        gate = self._settings.rejection_distance
        return len(residuals.r) > 0 and bool((self.distances(residuals) > gate).all())

    def foretold(self, residuals: Residuals) -> tuple[FloatArray, FloatArray]:
        """Return what the state foretells of m residuals, as it is to judge them by.

        Returns
        -------
        PC : FloatArray
            (p, m k) their covariances with ε.
        CPC : FloatArray
            (m k, m k) their covariance, without the noise of the points, m².

        """
        C = self._chord_output(residuals).reshape(-1, self._p)
        return self._output_covariances(C, self._joint.columns(residuals.rows))

    def _project(self, residuals: Residuals) -> tuple[FloatArray, FloatArray]:
        """Return C P and C P Cᵀ."""
        columns, P = self._joint.columns(residuals.rows), self._joint.P
        C = self._pose_output(residuals)
        CP = C @ P[: self._p] - P[columns]  # rows of P cost less to pick than its columns
        return CP, CP[:, : self._p] @ C.T - CP[:, columns]

    def _pose_output(self, residuals: Residuals) -> FloatArray:
        """Return the columns (m k, p) of C that belong to ε."""
        y_ref = residuals.e - residuals.r
        return self._axes.output_matrix(y_ref).reshape(-1, self._p)

    def _chord_output(self, residuals: Residuals) -> FloatArray:
        """Return C_i (m, k, p) at the middle of the chord from y_i° to e_i.

        Turning y_i° to e_i, by however much, moves it at right angles to (e_i + y_i°)/2; with C
        at y_i° a robot that has turned further than it knows would reject what it sees.
        """
        return self._axes.output_matrix(residuals.e - 0.5 * residuals.r)

    def _output_covariances(
        self, C: FloatArray, columns: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the covariances of C ε − ã with ε (…, p, j), and of its own (…, j, j).

        C is (…, j, p), and ``columns`` (…, j) are those of ã in P.
        """
        P = self._joint.P
        to_pose, own = P[columns, : self._p], P[columns[..., :, None], columns[..., None, :]]
        PC = self._joint.pose @ so3.transpose(C) - so3.transpose(to_pose)
        return PC, C @ PC - to_pose @ so3.transpose(C) + own

    def settle(self, observer: Observer) -> None:
        """Take the landmarks' estimates for their reference, so that â_i = 0."""
        self._joint.settle(observer)

    @property
    def looks_back(self) -> bool:
        """Whether there is a history to look back at, of what the smoother takes for constant."""
        is_constant = not (self._is_moving or self.calibration.drifts)
        return self._settings.hindsight_interval > 0 and is_constant

    def look_back(self, observer: Observer, seen: Seen, in_doubt: bool) -> None:
        """Note what was seen, and every so often linearise it anew."""
        # An empty frame tells nothing: the motions before and after it add up.
        if self.looks_back and len(seen.rows):
            self._hindsight.look_back(observer, seen, in_doubt)

    def smooth(self, observer: Observer) -> Solution:
        """Return the estimates in hindsight of everything since the history's prior."""
        return self._hindsight.smooth(observer)

    @property
    def history(self) -> History:
        """What it can look back at, frame by frame as :meth:`smooth` returns them."""
        return self._hindsight.history

    def restart(self, observer: Observer, since: str) -> None:
        """Forget the past: what is known now is all that is known when looking back."""
        self._hindsight.restart(observer, since)

    def _as_correction(self, x: FloatArray) -> Correction:
        """Return the group element exp(x); the calibration moves by its own part of x."""
        joint = self._joint
        self.calibration.shift(x[self._p : joint.first])
        Delta = self._axes.full_pose(x[: self._p])
        self._hindsight.note_correction(Delta[:3])
        X = slam_group.exp(Delta, self._axes.full_points(x[joint.map_columns]))
        if not self._is_moving:
            return Correction(X.A, slice(None), X.a)
        u = self._axes.full_points(x[joint.velocity_columns(np.arange(joint.count))])
        return Correction(X.A, slice(None), X.a, u)
