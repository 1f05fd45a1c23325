"""The textbook EKF-SLAM, against which the observer's choice of error is measured.

State: pose (R, x) and the landmarks' absolute positions p_i, with the errors taken in the world,

    R = exp(θ̃) R̂,   x = x̂ + x̃,   p_i = p̂_i + p̃_i.

Every step is linearised around the latest estimate, as in Smith, Self and Cheeseman (1990) and in
Thrun, Burgard and Fox, *Probabilistic Robotics* (2005), chapter 10. Gate and Huber's weights are
the observer's.
"""

from __future__ import annotations

from baseline_noise import BaselineNoise
import numpy as np
from odometry import Event, Odometry

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.events import VelocityEvent
from slam_observer_ros.filter.robust import gated_weights
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.axes import PLANAR, SPATIAL
from slam_observer_ros.lie.matrices import block_diagonal
from slam_observer_ros.settings.estimator_settings import Settings


class EkfSlam:
    """EKF-SLAM with known ids, in 3D or (``two_d_mode``) in the plane.

    Parameters
    ----------
    settings : Settings
        Noise figures, gate, Huber threshold and ``two_d_mode``.
    initial_pose : FloatArray, optional
        (4, 4) pose at the first event. Default identity.

    """

    def __init__(self, settings: Settings, initial_pose: FloatArray | None = None) -> None:
        self._settings = settings
        self._odometry = Odometry(settings)
        self._noise = BaselineNoise(settings)
        axes = PLANAR if settings.two_d_mode else SPATIAL
        self._pose_axes, self._d, self._k = axes.pose, axes.p, axes.point
        self._pose = np.eye(4) if initial_pose is None else initial_pose
        self._P = np.zeros((axes.p, axes.p))
        self._rows: dict[int, int] = {}
        self._points = np.empty((0, 3))

    @property
    def pose(self) -> FloatArray:
        """(4, 4) pose after the last observation, body to world."""
        return self._pose

    @property
    def landmark_ids(self) -> IntArray:
        """(n,) ids of the known landmarks."""
        return np.array(list(self._rows), dtype=np.int64)

    @property
    def world_points(self) -> FloatArray:
        """(n, 3) estimated landmarks, metres, world."""
        return self._points

    @property
    def pose_covariance(self) -> FloatArray:
        """(6, 6) covariance of (θ̃, x̃); zero on axes that are not estimated."""
        covariance = np.zeros((6, 6))
        covariance[self._pose_axes, self._pose_axes] = self._P[: self._d, : self._d]
        return covariance

    @property
    def landmark_covariances(self) -> FloatArray:
        """(n, 3, 3) covariances of the p̃_i, m²."""
        columns = self._columns(np.arange(len(self._points)))
        covariances = np.zeros((len(self._points), 3, 3))
        covariances[:, : self._k, : self._k] = self._P[columns[:, :, None], columns[:, None, :]]
        return covariances

    def add(self, event: Event) -> None:
        """Take in an event; stamps must not decrease."""
        if isinstance(event, VelocityEvent):
            self._odometry.add(event)
            return
        event = self._noise.corrected(event)
        self._predict(event.stamp_ns)
        known = np.array([landmark_id in self._rows for landmark_id in event.ids.tolist()])
        covariances, factors = self._noise.add(event)
        if known.any():
            seen = event.select(known)
            self._update(seen.ids, seen.points, covariances[known], factors[known])
        if not known.all():
            self._initialise(event.ids[~known], event.points[~known], covariances[~known])

    def _predict(self, stamp_ns: int) -> None:
        motion, noise = self._odometry.motion_to(stamp_ns)
        R = self._pose[:3, :3]
        F = np.eye(6)
        F[3:, :3] = -so3.hat(R @ motion[:3, 3])
        self._pose = self._pose @ motion
        G = np.kron(np.eye(2), self._pose[:3, :3])
        axes = self._pose_axes, self._pose_axes
        F, Q = F[axes], (G @ noise @ G.T)[axes]
        d = len(F)
        self._P[:d] = F @ self._P[:d]
        self._P[:, :d] = self._P[:, :d] @ F.T
        self._P[:d, :d] += Q

    def _update(
        self, ids: IntArray, points: FloatArray, covariances: FloatArray, factors: FloatArray
    ) -> None:
        k, R = self._k, self._pose[:3, :3]
        rows = np.array([self._rows[landmark_id] for landmark_id in ids.tolist()])
        predicted = se3.transform(se3.inverse(self._pose), self._points[rows])
        z = (points - predicted)[:, :k]
        H = self._output_matrix(rows)
        HPH = H @ self._P @ H.T
        noise = covariances[:, :k, :k]
        weights = gated_weights(z, HPH, noise, self._settings)
        used = weights > 0.0
        every = np.repeat(used, k)
        share = weights[used] / factors[used]
        S = HPH[np.ix_(every, every)] + block_diagonal(noise[used] / share[:, None, None])
        H = H[every]
        K = np.linalg.solve(S, H @ self._P).T
        error = K @ z[used].ravel()
        self._P -= K @ S @ K.T
        self._P = 0.5 * (self._P + self._P.T)
        self._move(error, R)

    def _output_matrix(self, rows: IntArray) -> FloatArray:
        """Return (m k, d + n k) derivatives Rᵀ [[p_i − x]×, −I, … I …] of the points seen."""
        k, d, Rt = self._k, self._d, self._pose[:3, :3].T
        by_pose = np.empty((len(rows), 3, 6))
        by_pose[:, :, :3] = so3.hat(self._points[rows] - self._pose[:3, 3])
        by_pose[:, :, 3:] = -np.eye(3)
        H = np.zeros((len(rows), k, len(self._P)))
        H[:, :, :d] = (Rt @ by_pose)[:, :k, self._pose_axes]
        for i, columns in enumerate(self._columns(rows)):
            H[i][:, columns] = Rt[:k, :k]
        return H.reshape(-1, len(self._P))

    def _move(self, error: FloatArray, R: FloatArray) -> None:
        d = self._d
        pose_error = np.zeros(6)
        pose_error[self._pose_axes] = error[:d]
        self._pose = se3.pose(so3.exp(pose_error[:3]) @ R, self._pose[:3, 3] + pose_error[3:])
        self._points[:, : self._k] += error[d:].reshape(-1, self._k)

    def _initialise(self, ids: IntArray, points: FloatArray, covariances: FloatArray) -> None:
        """Add p_i = x + R y_i, with its dependence on the pose."""
        k, n, R = self._k, len(self._P), self._pose[:3, :3]
        d = self._d
        by_pose = np.empty((len(ids), 3, 6))
        by_pose[:, :, :3] = -so3.hat(points @ R.T)
        by_pose[:, :, 3:] = np.eye(3)
        J = by_pose[:, :k, self._pose_axes].reshape(-1, d)
        P = np.empty((n + len(J), n + len(J)))
        P[:n, :n] = self._P
        P[n:, :n] = J @ self._P[:d]
        P[:n, n:] = P[n:, :n].T
        P[n:, n:] = P[n:, :d] @ J.T + block_diagonal((R @ covariances @ R.T)[:, :k, :k])
        self._P = P
        for landmark_id in ids.tolist():
            self._rows[landmark_id] = len(self._rows)
        self._points = np.concatenate([self._points, se3.transform(self._pose, points)])

    def _columns(self, rows: IntArray) -> IntArray:
        """Return the columns (m, k) of P that belong to landmarks (m,)."""
        columns: IntArray = self._d + self._k * rows[:, None] + np.arange(self._k)
        return columns
