"""Observer and gains without the handling of time and ids, to test the gains alone."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.geometry import paths, se3
from slam_observer_ros.observer.observer import Observer
from slam_observer_ros.observer.residuals import Residuals
from slam_observer_ros.sensor_models.motion import Motion
from slam_observer_ros.settings.estimator_settings import Settings

PLAIN = Settings(huber_threshold=0.0, rejection_threshold=1e9, relinearization_interval=0)
"""No robustness, no looking back: a plain filter."""


class Filter:
    """An observer and its gains, of any design."""

    def __init__(self, gains):
        self.observer = Observer(np.eye(4))
        self.gains = gains

    def move(self, body_velocities, dt_s, covariances):
        V = self.gains.calibration.apply(body_velocities)
        path = paths.path(self.observer.A, V * dt_s[:, None])
        self.observer.propagate(path)
        self.observer.move_landmarks(float(np.sum(dt_s)))
        at_ends = np.zeros((2, 6))
        motion = Motion(path, body_velocities, dt_s, covariances, float(dt_s.sum()), at_ends)
        self.gains.predict(self.observer, motion)

    def add(self, points, covariances):
        self.observer.add_landmarks(points)
        y_ref = self.observer.y_ref[-len(points) :]
        self.gains.add_landmarks(y_ref, self._turned(covariances))

    def relocate(self, rows, points, covariances):
        self.observer.relocate_landmarks(rows, points)
        self.gains.relocate_landmarks(rows, self.observer.y_ref[rows], self._turned(covariances))

    def residuals(self, rows, points, covariances):
        e, r = self.observer.errors(rows, points)
        dt_s = np.full(len(r), 0.1)
        return Residuals(rows, e, r, self.observer.a[rows], self._turned(covariances), dt_s)

    def see(self, rows, points, covariances):
        self.gains.recall(self.observer, rows)
        correction, weights = self.gains.correct(self.residuals(rows, points, covariances))
        self.observer.correct(correction)
        return weights

    def expected(self, rows):
        """Where the landmarks should be seen, (m, 3)."""
        points = self.observer.points[rows]
        return se3.transform(se3.inverse(self.observer.A), points)

    def step(self, rng, motion_variance, point_variance):
        """One random motion and one random sight of some of the landmarks."""
        n = len(self.observer.y_ref)
        V = rng.normal(size=(2, 6))
        self.move(V, np.array([0.05, 0.1]), motion_variance * random_covariances(rng, 2, 6))
        rows = np.sort(rng.permutation(n)[: rng.integers(1, n)])
        points = self.expected(rows)
        points = points + np.sqrt(point_variance) * rng.normal(size=points.shape)
        self.see(rows, points, point_variance * random_covariances(rng, len(rows), 3))

    @property
    def covariance(self):
        """Joint covariance of the pose and all landmarks."""
        return self.gains.joint_covariance(np.arange(len(self.observer.y_ref)))

    @property
    def points(self):
        """Landmarks (n, 3), reference frame."""
        return self.observer.points + self.gains.postponed_shifts()

    def _turned(self, covariances):
        R = self.observer.A[:3, :3]
        return R @ covariances @ R.T


def random_covariances(rng, count, size):
    roots = rng.normal(size=(count, size, size))
    return roots @ roots.swapaxes(1, 2) / size + 0.1 * np.eye(size)
