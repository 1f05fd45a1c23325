"""A robot that drives an eight among landmarks, and the mistakes that its set-up may have."""

from __future__ import annotations

import math

import numpy as np

from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.runs.mistakes import Correction, OPTICAL
from slam_observer_ros.settings.estimator_settings import Settings

SETTINGS = Settings(
    two_d_mode=True,
    angular_velocity_noise=(0.0, 0.0, 0.02),
    linear_velocity_noise=(0.02, 0.005, 0.0),
    observation_model='range_bearing',
    range_noise=0.05,
    bearing_noise=0.01,
)
PERIOD_NS = 100_000_000
POSITIVE = np.diag([-1.0, -1.0, 1.0])

MADE = {
    'points_in_optical_axes': Correction('', OPTICAL.T),
    'points_mirrored': Correction('', np.diag([1.0, -1.0, 1.0])),
    'points_backwards': Correction('', POSITIVE),
    'points_in_millimetres': Correction('', 1e3 * np.eye(3)),
    'tag_size': Correction('', 0.8 * np.eye(3)),
    'turning_in_degrees': Correction('', turn=math.degrees(1.0)),
    'speed_in_kmh': Correction('', drive=3.6),
    'turning_negated': Correction('', turn=-1.0),
    'driving_negated': Correction('', drive=-1.0),
    'no_turning': Correction('', turn=0.0),
    'mount_off': Correction('', so3.exp(np.array([0.0, 0.0, math.radians(-5.0)]))),
}


def landmarks_of(rng):
    """Return where they are (25, 3), metres; the first that is drawn of a seed."""
    return np.column_stack([rng.uniform(-9.0, 9.0, (25, 2)), np.zeros(25)])


def surveyed(seed=0):
    """Return the map that a survey has made of them."""
    points = landmarks_of(np.random.default_rng(seed))
    covariances = np.tile(1e-4 * np.eye(3), (25, 1, 1))
    return LandmarkMap(np.arange(25), points, covariances, np.zeros(25, dtype=np.int64))


def drive(seed=0, seconds=20.0, false=0.0, turn=0.5):
    """Events of a robot that drives an eight among landmarks, as noisy as stated."""
    rng, events, A = np.random.default_rng(seed), [], np.eye(4)
    landmarks = landmarks_of(rng)
    for step in range(round(seconds * 1e9 / PERIOD_NS)):
        stamp_ns, dt_s = (step + 1) * PERIOD_NS, PERIOD_NS * 1e-9
        V = np.array([0.0, 0.0, turn if step % 250 < 125 else -turn, 0.6, 0.0, 0.0])
        noise = np.array([0.0, 0.0, 0.02, 0.02, 0.0, 0.0]) * rng.normal(size=6) / math.sqrt(dt_s)
        events.append(VelocityEvent(stamp_ns - PERIOD_NS, V + noise))
        A = A @ se3.exp(dt_s * V)
        if step % 4:
            continue
        points = se3.transform(se3.inverse(A), landmarks)
        ranges_m, bearings = np.linalg.norm(points, axis=1), np.arctan2(points[:, 1], points[:, 0])
        ids = np.flatnonzero((ranges_m < 6.0) & (np.abs(bearings) < 1.0))
        ranges_m = ranges_m[ids] + 0.05 * rng.normal(size=len(ids))
        bearings = bearings[ids] + 0.01 * rng.normal(size=len(ids))
        seen = ranges_m[:, None] * np.column_stack(
            [np.cos(bearings), np.sin(bearings), np.zeros(len(ids))]
        )
        wrong = rng.random(len(ids)) < false
        seen[wrong] += rng.normal(scale=2.0, size=(np.count_nonzero(wrong), 3)) * [1.0, 1.0, 0.0]
        events.append(ObservationEvent(stamp_ns, ids, seen))
    return events
