"""A robot that drives about in a world of which there is a map."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.settings.estimator_settings import Settings

POINT_NOISE_M = 0.05
MAP_NOISE_M = 0.03
BODY_VELOCITY = np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.1])
PLANAR_VELOCITY = BODY_VELOCITY * [0, 0, 1, 1, 1, 0]
GAINS = ('constant', 'riccati')
MODES = ('off', 'uncertain', 'fixed')


class World:
    """50 landmarks, a robot that starts anywhere, and a map with errors of 3 cm."""

    def __init__(self, seed=0, is_planar=False):
        self.random = np.random.default_rng(seed)
        self.flat = np.array([1.0, 1.0, 0.0 if is_planar else 1.0])
        self.points = self.random.uniform([-12, -12, -1], [12, 12, 4], (50, 3)) * self.flat
        self.velocity = PLANAR_VELOCITY if is_planar else BODY_VELOCITY
        start = self.random.normal(size=6) * [1, 1, 2, 3, 3, 1]
        self.start = se3.exp(start * [0, 0, 1, 1, 1, 0] if is_planar else start)
        self.is_planar = is_planar

    def settings(self, **changes):
        return Settings(
            two_d_mode=self.is_planar,
            observation_model='cartesian',
            point_noise=POINT_NOISE_M,
            reorder_window=0.0,
            **changes,
        )

    def map(self, ids=range(50), sigma_m=MAP_NOISE_M):
        ids = np.array(list(ids), dtype=np.int64)
        noise = self.random.normal(scale=sigma_m, size=(len(ids), 3)) if sigma_m else 0.0
        covariances = np.tile(sigma_m**2 * np.eye(3), (len(ids), 1, 1))
        points = self.points[ids] + noise * self.flat
        return LandmarkMap(ids, points, covariances, np.full(len(ids), 9))

    def pose(self, time_s):
        return self.start @ se3.exp(self.velocity * time_s)

    def near(self, time_s, count):
        distance = np.linalg.norm(self.points - self.pose(time_s)[:3, 3], axis=1)
        return np.sort(np.argsort(distance)[:count])

    def see(self, time_s, ids, pose=None):
        ids = np.array(ids, dtype=np.int64)
        pose = self.pose(time_s) if pose is None else pose
        noise = self.random.normal(scale=POINT_NOISE_M, size=(len(ids), 3))
        points = se3.transform(se3.inverse(pose), self.points[ids]) + noise * self.flat
        return ObservationEvent(round(time_s * 1e9), ids, points)

    def drive(self, first_s, last_s, count=6, offset=None):
        """Velocities and views of the nearest landmarks at 10 Hz, the robot moved by offset."""
        events = []
        for time_s in np.arange(first_s, last_s, 0.1):
            noise = self.random.normal(scale=0.02, size=6) * (self.velocity != 0.0)
            events.append(VelocityEvent(round(time_s * 1e9), self.velocity + noise))
            pose = self.pose(time_s) if offset is None else offset @ self.pose(time_s)
            events.append(self.see(time_s, self.near(time_s, count), pose))
        return events

    def error(self, estimator, time_s):
        """Rotation vector and position of the pose's error, along the map's axes."""
        true, pose = self.pose(time_s), estimator.pose
        turn = so3.log(pose[:3, :3] @ true[:3, :3].T)
        return np.concatenate([turn, pose[:3, 3] - true[:3, 3]])

    def nees(self, estimator, time_s):
        axes = [2, 3, 4] if self.is_planar else list(range(6))
        error = self.error(estimator, time_s)[axes]
        covariance = estimator.pose_covariance[np.ix_(axes, axes)]
        return error @ np.linalg.solve(covariance, error)


def add(estimator, events):
    for event in events:
        assert estimator.add(event)
    return estimator
