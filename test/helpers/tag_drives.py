"""A robot that turns on the spot, amid tags of which it sees only the one that is ahead."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.recordings.trajectory import PoseTruth

SEED = 0
STEP_NS = 50_000_000
TAG_COUNT, TAG_RADIUS_M = 8, 5.0
V = np.array([0.0, 0.0, 0.25, 0.0, 0.0, 0.0])
TURN_NOISE, SPEED_NOISE = 0.5, 0.1  # white, rad/√s and m/√s
POINT_NOISE_M, ORIENTATION_NOISE_RAD = 0.03, 0.03
SETTINGS = {
    'angular_velocity_noise': (TURN_NOISE,) * 3,
    'linear_velocity_noise': (SPEED_NOISE,) * 3,
    'observation_model': 'cartesian',
    'point_noise': POINT_NOISE_M,
    'orientation_noise': ORIENTATION_NOISE_RAD,
}


def true_tags(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return positions (8, 3) and orientations (8, 3, 3), as the first of ``rng`` turns them."""
    angles_rad = 2.0 * np.pi * np.arange(TAG_COUNT) / TAG_COUNT
    walls = np.stack([np.cos(angles_rad), np.sin(angles_rad), np.zeros(TAG_COUNT)], axis=-1)
    return TAG_RADIUS_M * walls, so3.exp(rng.normal(size=(TAG_COUNT, 3)))


def past_tags(
    start_ns: int, steps: int
) -> Iterator[tuple[PoseTruth, VelocityEvent, ObservationEvent]]:
    """Give the true pose, the velocity and the tag ahead, in the base frame, of each step."""
    rng = np.random.default_rng(SEED)
    walls, tags = true_tags(rng)
    noise = np.repeat([TURN_NOISE, SPEED_NOISE], 3) / np.sqrt(STEP_NS * 1e-9)
    for step in range(steps):
        stamp_ns = start_ns + step * STEP_NS
        pose = se3.exp(V * (step * STEP_NS * 1e-9))
        points = se3.transform(se3.inverse(pose), walls)
        ahead = np.argmax(points[:, 0], keepdims=True)
        y = points[ahead] + POINT_NOISE_M * rng.normal(size=(1, 3))
        turn = so3.exp(ORIENTATION_NOISE_RAD * rng.normal(size=(1, 3)))
        Z = pose[:3, :3].T @ tags[ahead] @ turn
        yield (
            PoseTruth(stamp_ns, pose),
            VelocityEvent(stamp_ns, V + noise * rng.normal(size=6)),
            ObservationEvent(stamp_ns, ahead, y, orientations=Z),
        )
