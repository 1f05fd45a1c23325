"""An estimator on a short drive among five landmarks, of gyroscope and wheels at 20 Hz."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.settings.estimator_settings import Settings

GAINS = ('constant', 'riccati')
START_NS = 1_700_000_000_000_000_000
LANDMARKS = np.array([[4.0, 0, 0], [-4, 0, 1], [0, 4, 0.5], [1, -4, 0], [2, 2, 2]])
BODY_VELOCITY = np.array([0.05, -0.1, 0.3, 1.0, 0.1, -0.05])


def true_pose(time_s):
    return se3.exp(BODY_VELOCITY * time_s)


def velocity(time_s, body_velocity=BODY_VELOCITY):
    return VelocityEvent(START_NS + round(time_s * 1e9), np.array(body_velocity, dtype=float))


def observation(time_s, ids=range(5), noise=None):
    rows = np.array(list(ids), dtype=np.int64)
    points = se3.transform(se3.inverse(true_pose(time_s)), LANDMARKS[rows])
    if noise is not None:
        points = points + noise.normal(scale=0.05, size=points.shape)
    return ObservationEvent(START_NS + round(time_s * 1e9), rows, points)


def run(events, **changes):
    """Run events; landmarks are in the map from their first sighting unless changed."""
    estimator = Estimator(Settings(**{'confirmations': 1, **changes}))
    for event in events:
        estimator.add(event)
    estimator.flush()
    return estimator


def drive(duration_s=4.0, noise_seed=0):
    """A drive with velocities at 20 Hz and noisy observations at 10 Hz, in stamp order."""
    noise = np.random.default_rng(noise_seed)
    events = []
    for step in range(round(duration_s * 20)):
        events.append(velocity(0.05 * step))
        if step % 2 == 1:
            seen = noise.permutation(5)[: noise.integers(0, 5)]
            events.append(observation(0.05 * step, seen, noise))
    return events


def assert_same_state(one, other):
    assert one.stamp_ns == other.stamp_ns
    np.testing.assert_array_equal(one.pose, other.pose)
    np.testing.assert_array_equal(one.landmark_ids, other.landmark_ids)
    np.testing.assert_array_equal(one.world_points, other.world_points)
