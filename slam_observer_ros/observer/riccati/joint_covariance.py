"""The covariance of all errors that the Riccati gains know of, and which columns are whose."""

from __future__ import annotations

from copy import copy

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.axes import Axes
from slam_observer_ros.geometry.matrices import block_diagonal, transpose
from slam_observer_ros.observer.observer import Observer
from slam_observer_ros.observer.prediction import initial_covariance
from slam_observer_ros.sensor_models.calibration import Calibration


class JointCovariance:
    """P, the covariance of x = (ε, c, ã_1 … ã_n); with landmarks that move, (ã_i, ũ_i) for ã_i.

    Parameters
    ----------
    axes, calibration : Axes, Calibration
        Which p axes of the pose and k of a point, and which c of the calibration are estimated.
    velocity_error : float
        Standard deviation of a new landmark's velocity, m/s; 0 where landmarks stand still.

    Attributes
    ----------
    P : FloatArray
        (p + c + …, p + c + …) the covariance.
    first : int
        p + c, the first column of the landmarks.

    """

    def __init__(self, axes: Axes, calibration: Calibration, velocity_error: float) -> None:
        self._axes = axes
        self._p = axes.p
        self._velocity_error = velocity_error
        self._stride = axes.point * (2 if velocity_error > 0.0 else 1)
        self.P = initial_covariance(axes, calibration)
        self.first = len(self.P)
        self._first_columns = self.first + np.arange(axes.point)

    @property
    def count(self) -> int:
        """How many landmarks there are."""
        return (len(self.P) - self.first) // self._stride

    @property
    def pose(self) -> FloatArray:
        """(p, p) covariance of ε."""
        return self.P[: self._p, : self._p]

    @property
    def landmarks(self) -> FloatArray:
        """(n, 3, 3) covariances of the landmark errors ã_i."""
        k = self._axes.point
        columns = self.columns(np.arange(self.count)).reshape(-1, k)
        covariances = np.zeros((self.count, 3, 3))
        covariances[:, :k, :k] = self.P[columns[:, :, None], columns[:, None, :]]
        return covariances

    def landmarks_after(self, duration_s: float, velocities: FloatArray) -> FloatArray:
        """Return the same after t seconds at û_i (n, 3), once they are settled there.

        The error is ã_i + t (û_i − u_i) then, where û_i − u_i = ũ_i − [û_i]× ω.
        """
        n, k, p, everything = self.count, self._axes.point, self._p, np.arange(self.count)
        eye = np.tile(np.eye(k), (n, 1, 1))
        parts = [duration_s * self._axes.turn_matrix(velocities), eye]
        at = [np.tile(np.arange(p), (n, 1)), self.columns(everything).reshape(n, k)]
        if self._velocity_error > 0.0:
            parts.append(duration_s * eye)
            at.append(self.velocity_columns(everything).reshape(n, k))
        D, columns = np.concatenate(parts, axis=2), np.concatenate(at, axis=1)
        covariances = np.zeros((n, 3, 3))
        own = self.P[columns[:, :, None], columns[:, None, :]]
        covariances[:, :k, :k] = D @ own @ transpose(D)
        return covariances

    @property
    def map_columns(self) -> IntArray | slice:
        """Columns that belong to all landmarks; a slice, which is cheap, if it can be."""
        if self._velocity_error > 0.0:
            return self.columns(np.arange(self.count))
        return slice(self.first, None)

    def columns(self, rows: IntArray) -> IntArray:
        """Return the columns that belong to landmarks (m,), as (m k,)."""
        return (self._first_columns + self._stride * rows[:, None]).ravel()

    def velocity_columns(self, rows: IntArray) -> IntArray:
        """Return those of the landmarks' velocities, none where these are not estimated."""
        if self._velocity_error == 0.0:
            return np.empty(0, dtype=np.int64)
        return self.columns(rows) + self._axes.point

    def with_pose(self, rows: IntArray) -> FloatArray:
        """Return the covariance (p + m k, p + m k) of ε and m landmarks together."""
        columns = np.append(np.arange(self._p), self.columns(rows))
        return self.P[np.ix_(columns, columns)]

    def without_landmarks(self) -> JointCovariance:
        """Return the covariance of ε and c alone."""
        alone = copy(self)
        alone.P = self.P[: self.first, : self.first].copy()
        return alone

    def set_pose(self, covariance: FloatArray) -> None:
        """Take over the covariance (p, p) of ε, independent of all else."""
        self.P[: self._p] = self.P[:, : self._p] = 0.0
        self.P[: self._p, : self._p] = covariance

    def make_room(self, m: int) -> IntArray:
        """Append m landmarks, filled with zeros; return their rows."""
        count, old = self.count, self.P
        self.P = np.zeros((len(old) + self._stride * m,) * 2)
        self.P[: len(old), : len(old)] = old
        return np.arange(count, count + m)

    def place_seen(self, rows: IntArray, y_ref: FloatArray, covariances: FloatArray) -> None:
        """Fill in landmarks seen now: ã_i = J ε + noise, with J = [−[y_i°]×, I]."""
        P, p, k = self.P, self._p, self._axes.point
        columns = self.columns(rows)
        J = self._axes.output_matrix(y_ref).reshape(-1, p)
        P[columns] = J @ P[:p]
        P[:, columns] = P[columns].T
        own = J @ P[:p, :p] @ J.T + block_diagonal(covariances[:, :k, :k])
        P[np.ix_(columns, columns)] = own
        self._place_velocities(rows)

    def place_known(self, rows: IntArray, covariances: FloatArray) -> None:
        """Fill in landmarks whose errors are independent of all else."""
        k, columns = self._axes.point, self.columns(rows)
        self.P[np.ix_(columns, columns)] = block_diagonal(covariances[:, :k, :k])
        self._place_velocities(rows)

    def remove(self, rows: IntArray) -> None:
        """Delete the rows and columns of landmarks."""
        columns = np.append(self.columns(rows), self.velocity_columns(rows))
        self.P = np.delete(np.delete(self.P, columns, axis=0), columns, axis=1)

    def turn(self, columns: IntArray | slice, vectors: FloatArray) -> None:
        """Make errors x_i at ``columns`` x_i − [y_i]× ω, for ``vectors`` y (m, 3)."""
        L = self._axes.turn_matrix(vectors).reshape(-1, self._p)
        half = L @ self.P[: self._p]
        half[:, columns] += 0.5 * half[:, : self._p] @ L.T
        self.P[columns] += half
        self.P[:, columns] += half.T  # its mirror image, so that P stays symmetric

    def settle(self, observer: Observer) -> None:
        """Take the landmarks' estimates for their reference, so that â_i = 0.

        ã_i = â_i − R_Ã a_i turns with the noise of the pose unless a_i is small, which prediction
        in the pose block alone leaves out. With y_i° + â_i for y_i°, ã_i becomes ã_i − [â_i]× ω.
        """
        self.turn(self.map_columns, observer.a)
        observer.rebase(observer.points)

    def with_pose_error_by(self, A: FloatArray) -> FloatArray:
        """Return the covariance of Ad_A ε and all else."""
        p, pose = self._p, self._axes.pose
        Ad = se3.adjoint(A)[pose, pose]
        changed: FloatArray = self.P.copy()
        changed[:p] = Ad @ changed[:p]
        changed[:, :p] = changed[:, :p] @ Ad.T
        return changed

    def _place_velocities(self, rows: IntArray) -> None:
        """Fill in landmarks whose velocity is not known at all yet."""
        columns = self.velocity_columns(rows)
        self.P[columns] = self.P[:, columns] = 0.0
        self.P[columns, columns] = self._velocity_error**2
