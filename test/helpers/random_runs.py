"""Random motions and observations for a filter alone, without stamps, ids and noise models."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.filter.flat_arrays import Advanced, Interval
from slam_observer_ros.filter.gains import Gains
from slam_observer_ros.filter.observer import Residuals
from slam_observer_ros.models.held_velocities import Velocities
from slam_observer_ros.models.observation_noise import ObservationNoise
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.tracking.state import Association, State
from slam_observer_ros.tracking.step import observe as observe_by_state

PLAIN = Settings(
    huber_threshold=0.0,
    rejection_threshold=1e9,
    relinearization_interval=0,
    angular_bias_stddev=(0.0, 0.0, 0.0),
    velocity_delay_stddev=0.0,
    motion_noise_factor='stated',
)
"""No robustness, no relinearising, no calibration: a plain filter."""

DT_S = 0.1
"""Time between two observations of each landmark."""


def held(
    body_velocities: FloatArray, dt_s: FloatArray, covariances: FloatArray | None = None
) -> Velocities:
    """Velocities (k, 6), held for ``dt_s`` (k,) from stamp 0 on, motions of covariances (k, 6, 6).

    Without covariances they are as noisy as the settings say. The first one was known before.
    """
    ends_ns, k = np.cumsum(np.rint(dt_s * 1e9)).astype(np.int64), len(dt_s)
    since_ns = np.append(0, ends_ns[:-1])
    stated = np.zeros((k, 6, 6))
    if covariances is not None:
        stated = covariances / dt_s[:, None, None] ** 2
    return Velocities(
        stamps_ns=np.append(-(10**12), since_ns[1:]),
        body_velocities=body_velocities,
        since_ns=np.repeat(since_ns[:, None], 2, axis=1),
        is_stated=np.full((k, 2), covariances is not None),
        covariances=stated,
        usual_angular_s=np.inf,
        usual_linear_s=np.inf,
        timeout_ns=2 * int(ends_ns[-1]),
    )


def propagate(
    filter_: Gains, body_velocities: FloatArray, dt_s: FloatArray, covariances: FloatArray
) -> Advanced:
    """Move along velocities (k, 6), held for ``dt_s`` (k,), motions of covariances (k, 6, 6)."""
    end_ns = int(np.rint(dt_s * 1e9).sum())
    velocities = held(body_velocities, dt_s, covariances)
    return filter_.advance(velocities, Interval(0, end_ns, 0, 0, None))


def residuals_of(
    filter_: Gains, rows: IntArray, points: FloatArray, covariances: FloatArray
) -> Residuals:
    """Residuals of landmarks (m,) that are seen at ``points`` (m, 3), body frame."""
    return filter_.residuals(
        rows, points, covariances, np.full(len(rows), DT_S), np.ones(len(rows))
    )


def observe(
    filter_: Gains, rows: IntArray, points: FloatArray, covariances: FloatArray
) -> FloatArray:
    """Correct a filter by landmarks (m,) seen at ``points`` (m, 3); return their weights."""
    seen = ObservationEvent(0, rows, points, covariances)
    one = Association(State(filter_, filter_._tuning), seen, rows)
    assert observe_by_state(one)
    return one.out.weights


def as_stated(points: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return covariances (m, 3, 3) as a filter takes them: all can be inverted."""
    return ObservationNoise(PLAIN).covariances(ObservationEvent(0, [], points, covariances))


def random_step(
    filter_: Gains, rng: np.random.Generator, motion_variance: float, point_variance: float
) -> None:
    """One random motion and one random observation of some of the landmarks."""
    V = rng.normal(size=(2, 6))
    Q = motion_variance * random_covariances(rng, 2, 6)
    propagate(filter_, V, np.array([0.05, 0.1]), Q)
    n = len(filter_.observer.points)
    rows = np.sort(rng.permutation(n)[: rng.integers(1, n)])
    points = filter_.observer.body_points(rows)
    points = points + np.sqrt(point_variance) * rng.normal(size=points.shape)
    observe(filter_, rows, points, point_variance * random_covariances(rng, len(rows), 3))


def covariance_of_all(filter_: Gains) -> FloatArray:
    """Joint covariance of the pose and all landmarks."""
    return filter_.joint_covariance(np.arange(len(filter_.observer.points)))


def random_covariances(rng: np.random.Generator, count: int, size: int) -> FloatArray:
    """Positive covariances (count, size, size) of the order of 1."""
    roots = rng.normal(size=(count, size, size))
    return roots @ roots.swapaxes(1, 2) / size + 0.1 * np.eye(size)
