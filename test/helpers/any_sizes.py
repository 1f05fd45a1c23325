"""Runs of an estimator whose state has any size that settings allow, for what is compiled."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.settings.estimator_settings import Settings

STEP_NS = 100_000_000
TWIST = np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.0])

STDDEVS = {
    'angular_scale_stddev': (0.02,) * 3,
    'linear_scale_stddev': (0.02,) * 3,
    'angular_bias_stddev': (0.01,) * 3,
    'linear_bias_stddev': (0.01,) * 3,
    'sensor_rotation_stddev': (0.03,) * 3,
    'sensor_translation_stddev': (0.05,) * 3,
    'velocity_delay_stddev': 0.2,
    'range_scale_stddev': 0.01,
}
"""What may be estimated of a calibration; all of it, or any part."""


def up_to(rng: np.random.Generator, most: int) -> int:
    """Return a size, small ones as likely as large ones."""
    return int(np.exp(rng.uniform(0.0, np.log(most + 1.0))))


def any_settings(rng: np.random.Generator) -> Settings:
    """Return settings that estimate any part of a calibration, relinearising often or never."""
    estimated = {
        name: value
        if rng.integers(2)
        else type(value)(0 * np.array(value))
        if isinstance(value, float)
        else (0.0, 0.0, 0.0)
        for name, value in STDDEVS.items()
    }
    noise = float(rng.choice([0.02, 0.3]))  # the rougher, the more is linearised again
    return Settings(
        reorder_window=0.0,
        two_d_mode=bool(rng.integers(2)),
        use_tag_orientation=bool(rng.integers(2)),
        calibration_drift=float(rng.choice([0.0, 0.01])),
        angular_velocity_noise=(noise,) * 3,
        relinearization_interval=int(rng.choice([0, 3, 20])),
        relinearization_angle=float(rng.choice([0.0, 0.05])),
        confirmations=1,
        **estimated,
    )


def run(seed: int, landmarks: int = 1000, steps: int = 60) -> Estimator:
    """Drive past up to so many landmarks, seen by up to eight sensors, and smooth at the end."""
    rng = np.random.default_rng(seed)
    settings = any_settings(rng)
    n, sensors = up_to(rng, landmarks), int(rng.integers(1, 9))
    world = rng.uniform(-12.0, 12.0, (n, 3)) * (1.0, 1.0, 0.2 * (not settings.two_d_mode))
    estimator, pose = Estimator(settings), np.eye(4)
    for step in range(steps):
        noise = rng.normal(scale=0.02, size=6) * (TWIST != 0.0)
        estimator.add(VelocityEvent(step * STEP_NS, TWIST + noise))
        pose = pose @ se3.exp(0.1 * TWIST)
        m = min(n, up_to(rng, 40))
        rows = rng.choice(n, m, replace=False)
        points = se3.transform(se3.inverse(pose), world[rows])
        points += rng.normal(scale=0.05, size=(m, 3)) * (1.0, 1.0, not settings.two_d_mode)
        frame = f'sensor_{step % sensors}'
        stamp_ns = (step + 1) * STEP_NS
        estimator.add(ObservationEvent(stamp_ns, rows, points, sensor_frame=frame))
    if settings.relinearization_interval:
        estimator.smooth()
    return estimator
