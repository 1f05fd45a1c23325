"""Riccati gains with the landmarks in P: they are mapped, and their life cycle is that of columns.

With ``landmark_velocity_error`` each landmark has an unknown velocity u_i in the reference frame
as well; ã_i then grows by ũ_i dt, prediction costs O(n²), and there is no looking back.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.errors import ParameterError
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry import slam_group
from slam_observer_ros.geometry.axes import axes_of
from slam_observer_ros.geometry.matrices import block_diagonal, transpose
from slam_observer_ros.observer.filter import FrameObservation, InHindsight, Residuals
from slam_observer_ros.observer.gauge import anchor
from slam_observer_ros.observer.observer import Correction, Observer
from slam_observer_ros.observer.prediction import predict
from slam_observer_ros.observer.riccati.fixed_map import FixedMapGains
from slam_observer_ros.observer.riccati.joint_covariance import JointCovariance
from slam_observer_ros.observer.riccati.riccati import RiccatiGains
from slam_observer_ros.sensor_models.calibration import Calibration
from slam_observer_ros.sensor_models.motion import Motion
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.smoothing.relinearisation import Hindsight


class FullMapGains(RiccatiGains):
    """Gains from the full covariance of pose, velocity calibration and landmarks.

    Parameters
    ----------
    settings : Settings
        Noise, calibration, robustness and ``two_d_mode``.

    """

    def __init__(self, settings: Settings) -> None:
        axes, velocity_error = axes_of(settings.two_d_mode), settings.landmark_velocity_error
        calibration = Calibration(settings, axes)
        joint = JointCovariance(axes, calibration, velocity_error)
        super().__init__(settings, calibration, joint)
        self._is_moving = velocity_error > 0.0
        self._hindsight = Hindsight(axes, settings, calibration, joint)

    def change_settings(self, settings: Settings) -> None:
        """Take over the robustness, and when to look back."""
        super().change_settings(settings)
        self._hindsight.settings = settings

    @property
    def landmark_error_covariances(self) -> FloatArray:
        """(n, 3, 3) covariances of the landmark errors ã_i."""
        return self._joint.landmarks

    def landmark_error_covariances_after(
        self, observer: Observer, duration_s: float
    ) -> FloatArray:
        """Return what the same will be when landmarks that move have moved on."""
        if not observer.have_moved:
            return self._joint.landmarks
        return self._joint.landmarks_after(duration_s, observer.u)

    def predict(self, observer: Observer, motion: Motion) -> None:
        """Add the motion's noise to the pose block, and what the calibration's error adds."""
        if observer.have_moved:
            self.settle(observer)
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

        Its noise turns R_Ã in ũ_i = û_i − R_Ã u_i, and leaves û_i − u_i = ũ_i − [û_i]× ω alone.
        """
        joint, everything = self._joint, np.arange(self._joint.count)
        a, u = joint.columns(everything), joint.velocity_columns(everything)
        joint.P[a] += motion.duration_s * joint.P[u]
        joint.P[:, a] += motion.duration_s * joint.P[:, u]
        joint.turn(u, observer.u)
        predict(joint.P, self._axes, self.calibration, motion)
        joint.turn(u, -observer.u)

    def add_landmarks(self, y_ref: FloatArray, covariances: FloatArray) -> None:
        """Append landmarks (m, 3) with room for them in P."""
        self._joint.place_seen(self._joint.make_room(len(y_ref)), y_ref, covariances)

    def relocate_landmarks(
        self, rows: IntArray, y_ref: FloatArray, covariances: FloatArray
    ) -> None:
        """Take landmarks for new ones; what was seen of them before now is forgotten."""
        self._hindsight.history.relocate_landmarks(rows)
        self._joint.place_seen(rows, y_ref, covariances)

    def with_fixed_landmarks(self, covariances: FloatArray) -> FixedMapGains:
        """Return gains that know pose and calibration as well, and never move a landmark."""
        return FixedMapGains(self._settings, self.calibration, self._joint, covariances)

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

    def _project(self, residuals: Residuals) -> tuple[FloatArray, FloatArray]:
        """Return C P and C P Cᵀ."""
        columns, P = self._joint.columns(residuals.rows), self._joint.P
        C = self._pose_output(residuals)
        CP = C @ P[: self._p] - P[columns]  # rows of P cost less to pick than its columns
        return CP, CP[:, : self._p] @ C.T - CP[:, columns]

    def _output_covariances(
        self, C: FloatArray, columns: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the covariances of C ε − ã with ε (…, p, j), and of its own (…, j, j).

        C is (…, j, p), and ``columns`` (…, j) are those of ã in P.
        """
        P = self._joint.P
        to_pose, own = P[columns, : self._p], P[columns[..., :, None], columns[..., None, :]]
        PC = self._joint.pose @ transpose(C) - transpose(to_pose)
        return PC, C @ PC - to_pose @ transpose(C) + own

    def settle(self, observer: Observer) -> None:
        """Take the landmarks' estimates for their reference, so that â_i = 0."""
        self._joint.settle(observer)

    @property
    def looks_back(self) -> bool:
        """Whether there is a history to look back at, of what the smoother takes for constant."""
        is_constant = not (self._is_moving or self.calibration.drifts)
        return self._settings.hindsight_interval > 0 and is_constant

    def look_back(self, observer: Observer, seen: FrameObservation, in_doubt: bool) -> None:
        """Note what was seen, and every so often linearise it anew."""
        # An empty frame tells nothing: the motions before and after it add up.
        if len(seen.rows):
            self._hindsight.look_back(observer, seen, in_doubt)

    def smooth(self, observer: Observer) -> InHindsight:
        """Return the estimates in hindsight of everything since the history's prior."""
        if self._settings.hindsight_interval == 0:
            return super().smooth(observer)
        if self._is_moving:
            raise ParameterError(
                "smoothing takes landmarks to rest: 'landmark_velocity_error' must be 0"
            )
        if self.calibration.drifts:
            raise ParameterError(
                "smoothing takes the calibration to stay: 'calibration_drift' must be 0"
            )
        if observer.have_moved:
            raise ParameterError('smoothing takes landmarks to rest; some came with velocities')
        solution, history = self._hindsight.smooth(observer), self._hindsight.history
        stamps_ns = np.array(history.stamps_ns, dtype=np.int64)
        return InHindsight(stamps_ns, solution.poses[1:], solution.points, history.since)

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
