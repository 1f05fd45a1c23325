"""Simulated runs for the gain designs: a robot among landmarks, with the noise of the settings."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import Event, ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.models.held_velocities import HeldVelocities
from slam_observer_ros.models.motion_noise import MotionNoise
from slam_observer_ros.models.observation_noise import ObservationNoise
from slam_observer_ros.settings.estimator_settings import Settings

START_NS = 1_000_000_000
STEP_NS = 50_000_000
STEP_S = STEP_NS * 1e-9
OBSERVED_EVERY = 5
"""Velocities come at 20 Hz, observations at 4 Hz."""


@dataclass(frozen=True, eq=False)
class World:
    """Events at ``START_NS + k · STEP_NS`` and the truth ``poses[k]``, (steps + 1, 4, 4)."""

    events: list[Event]
    poses: FloatArray
    world_points: FloatArray

    def observations(self) -> list[ObservationEvent]:
        return [event for event in self.events if isinstance(event, ObservationEvent)]

    def with_observations(self, change) -> World:
        """The same run with each observation replaced by ``change(index, observation)``."""
        index, events = 0, []
        for event in self.events:
            if isinstance(event, ObservationEvent):
                events.append(change(index, event))
                index += 1
            else:
                events.append(event)
        return replace(self, events=events)

    def true_pose(self, stamp_ns: int) -> FloatArray:
        return self.poses[(stamp_ns - START_NS) // STEP_NS]


def true_velocities(steps: int, planar: bool) -> FloatArray:
    """Velocities (steps, 6) of a wavy round of about 20 s at 1 m/s."""
    t = STEP_S * np.arange(steps)
    V = np.zeros((steps, 6))
    V[:, 2] = 0.3 + 0.2 * np.sin(0.7 * t)
    V[:, 3] = 1.0 + 0.2 * np.cos(0.5 * t)
    if not planar:
        V[:, 0], V[:, 1] = 0.15 * np.cos(0.9 * t), 0.1 * np.sin(1.1 * t)
        V[:, 4], V[:, 5] = 0.1 * np.sin(0.4 * t), 0.2 * np.cos(0.8 * t)
    return V


def drive(
    settings: Settings,
    duration_s: float,
    seed: int = 0,
    noise: float = 1.0,
    landmarks: int = 12,
    seen: int = 4,
    scale: FloatArray | float = 1.0,
    bias: FloatArray | float = 0.0,
    delay_ns: int = 0,
) -> World:
    """Drive among landmarks and see the nearest few of them.

    The noise is as in the settings, times ``noise``. The sensor reports (V − bias) / scale,
    stamped ``delay_ns`` too early.
    """
    rng = np.random.default_rng(seed)
    planar = settings.two_d_mode
    steps = round(duration_s / STEP_S)
    V = true_velocities(steps, planar)
    poses = np.empty((steps + 1, 4, 4))
    poses[0] = np.eye(4)
    for k, motion in enumerate(se3.exp(V * STEP_S)):
        poses[k + 1] = poses[k] @ motion
    points = rng.uniform([-6.0, -3.0, -2.0], [6.0, 9.0, 2.0], (landmarks, 3))
    if planar:
        points[:, 2] = 0.0
    measured = (V - bias) / scale + noise * _velocity_noise(MotionNoise(settings), V, rng)
    events: list[Event] = []
    for k in range(steps + 1):
        stamp_ns = START_NS + k * STEP_NS
        if k < steps and stamp_ns - delay_ns <= START_NS + steps * STEP_NS:
            events.append(VelocityEvent(stamp_ns - delay_ns, measured[k]))
        if k % OBSERVED_EVERY == 0:
            y = se3.transform(se3.inverse(poses[k]), points)
            ids = np.sort(np.argsort(np.linalg.norm(y, axis=1))[:seen])
            event = ObservationEvent(stamp_ns, ids, y[ids])
            events.append(_with_noise(ObservationNoise(settings), event, noise, planar, rng))
    events.sort(key=lambda event: event.stamp_ns)
    return World(events, poses, points)


def estimate(world: World, settings: Settings, on_update=None, initial_pose=None) -> Estimator:
    """The estimator after all events of a run."""
    estimator = Estimator(settings, initial_pose, on_update)
    for event in world.events:
        assert estimator.add(event)
    estimator.flush()
    return estimator


def configuration_error_m(estimator: Estimator, world: World) -> float:
    """RMS over the map of how far landmarks lie from the truth, as seen from the robot."""
    known = estimator.landmark_ids
    seen = se3.transform(se3.inverse(estimator.pose), estimator.world_points)
    truth = se3.inverse(world.true_pose(estimator.stamp_ns))
    misses = seen - se3.transform(truth, world.world_points[known])
    return float(np.sqrt(np.mean(np.sum(misses**2, axis=1))))


def position_error_m(estimator: Estimator, world: World) -> float:
    truth = world.true_pose(estimator.stamp_ns)
    return float(np.linalg.norm(estimator.pose[:3, 3] - truth[:3, 3]))


def _velocity_noise(model: MotionNoise, V: FloatArray, rng: np.random.Generator) -> FloatArray:
    zero, dt_s = np.zeros(len(V)), np.full(len(V), STEP_S)
    unknown = np.zeros((len(V), 6, 6)), np.zeros((len(V), 2), dtype=bool)
    before = np.zeros((len(V), 2)), np.empty(0), np.empty((0, 6))
    held = HeldVelocities(V, *unknown, dt_s, zero, *before, np.full(2, np.inf))
    variances = np.diagonal(model.covariances(held), axis1=1, axis2=2)
    return np.sqrt(variances) / STEP_S * rng.standard_normal(V.shape)


def _with_noise(
    model: ObservationNoise,
    event: ObservationEvent,
    noise: float,
    planar: bool,
    rng: np.random.Generator,
) -> ObservationEvent:
    roots = np.linalg.cholesky(model.covariances(event))
    errors = (roots @ rng.standard_normal((len(event.ids), 3, 1)))[:, :, 0]
    if planar:
        errors[:, 2] = 0.0
    return replace(event, points=event.points + noise * errors)
