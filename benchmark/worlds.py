"""What the estimators are compared on: real recordings and simulated worlds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import compress
import math
import os
from pathlib import Path

import numpy as np
from odometry import Event

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.models.held_velocities import HeldVelocities
from slam_observer_ros.models.motion_noise import MotionNoise
from slam_observer_ros.models.observation_noise import ObservationNoise
from slam_observer_ros.recordings.data_sets import load_graph, load_mrclam, load_starry_night
from slam_observer_ros.recordings.trajectory import LandmarkTruth, Trajectory
from slam_observer_ros.recordings.writer import DataSet
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.parameter_file import read_parameter_file
from slam_observer_ros.settings.parameter_table import from_parameters, table
from slam_observer_ros.simulation import Scenario, Simulation

CHECKOUT = Path(__file__).resolve().parent.parent
CONFIG_FOLDER = CHECKOUT / 'config'
VELOCITY_RATE_HZ = 20
OBSERVED_AFTER_S = 0.017
"""Time from a velocity to an observation: equal stamps hide what a delay costs."""
SPEED = 0.5
DETECTED_SHARE = 0.7
LANDMARK_SPEED = (0.05, 0.3)

CIRCLE = Scenario(
    duration=120.0,
    observation_rate=10.0,
    initial_bias=0.0,
    angular_velocity_noise=0.1,
    linear_velocity_noise=0.1,
    point_noise=0.1,
)
"""Section VI's run with noise; its bias on the first sighting is an error that no model knows."""


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """One run with its truth.

    Attributes
    ----------
    settings : Settings
        Noise figures that every estimator is given.
    events : list of Event
        In stamp order; at equal stamps the velocity comes first.
    truth : Trajectory
        True poses.
    landmarks : LandmarkTruth
        True landmarks, at stamp 0 if they move.
    landmark_velocities : FloatArray or None
        (n, 3) their true velocities, world, m/s; None where all are at rest.

    """

    settings: Settings
    events: list[Event]
    truth: Trajectory
    landmarks: LandmarkTruth
    landmark_velocities: FloatArray | None = None

    def landmarks_at(self, stamp_ns: int) -> LandmarkTruth:
        """Return where the landmarks truly are at a stamp."""
        if self.landmark_velocities is None:
            return self.landmarks
        moved_m = stamp_ns * 1e-9 * self.landmark_velocities
        return LandmarkTruth(self.landmarks.ids, self.landmarks.world_points + moved_m)

    def known_at_rest(self) -> World:
        """Return the same with the truth of those landmarks alone that are at rest."""
        if self.landmark_velocities is None:
            return self
        rests = ~self.landmark_velocities.any(axis=1)
        landmarks = LandmarkTruth(self.landmarks.ids[rests], self.landmarks.world_points[rests])
        return replace(self, landmarks=landmarks, landmark_velocities=None)

    def part(self, from_s: float, to_s: float) -> World:
        """Return what is between two times since the start of the run."""
        start_ns = self.events[0].stamp_ns
        is_within = [from_s <= (event.stamp_ns - start_ns) * 1e-9 <= to_s for event in self.events]
        return replace(self, events=list(compress(self.events, is_within)))


@dataclass(frozen=True, slots=True)
class Loop:
    """A closed course of one lap with landmarks beside it, driven for a while.

    Attributes
    ----------
    config : str
        Name of the shipped configuration whose noise is simulated.
    lap_s, duration_s : float
        Seconds of one lap and of the run, at 0.5 m/s.
    landmarks : int
        How many there are.
    max_range_m : float
        How far the sensor sees. It looks at the nearest few, and misses three in ten of them.
    observation_rate_hz : int
        A divisor of the velocities' rate, 20 Hz.
    moving_share : float
        Share of the landmarks that move, each straight on at 0.05 to 0.3 m/s: carts pushed on or
        slow robots. Each is beside the course when the robot first comes by.
    max_seen : int
        How many of the nearest it looks at.
    detected_share : float
        Share of the landmarks in view that it sees.
    view_rad : float
        Angle that it sees, half of it to either side of straight ahead.

    """

    config: str
    lap_s: float
    duration_s: float
    landmarks: int
    max_range_m: float
    observation_rate_hz: int
    moving_share: float = 0.0
    max_seen: int = 5
    detected_share: float = DETECTED_SHARE
    view_rad: float = 2.0 * math.pi


STEREO_LOOP = Loop('stereo_inertial', 300.0, 390.0, 100, 6.0, 5)
WHEELED_LOOP = Loop('wheeled_bearing_range', 300.0, 390.0, 100, 6.0, 2)


def names() -> list[str]:
    """Return the names of all worlds, in the order of the tables; real ones if they are there."""
    return [*(_RECORDED if data_folder().is_dir() else ()), *_SIMULATED]


def load(name: str) -> World:
    """Return the world of that name."""
    return (_RECORDED | _SIMULATED)[name]()


def data_folder() -> Path:
    """Return the folder of the real recordings."""
    return Path(os.environ.get('SLAM_OBSERVER_DATA', CHECKOUT.parent / 'shared' / 'data'))


def shipped_settings(config: str) -> Settings:
    """Return the settings of ``config/<config>.yaml``, with events used as they come."""
    values = read_parameter_file(CONFIG_FOLDER / f'{config}.yaml')
    names_known = {row.name for row in table(Settings)}
    values = {name: value for name, value in values.items() if name in names_known}
    return replace(from_parameters(Settings, values), reorder_window=0.0)


def simulated_settings(config: str) -> Settings:
    """Return the same for a simulated sensor: as /tf has it, with errors new each time."""
    return replace(
        shipped_settings(config),
        observation_correlation_time=0.0,
        sensor_rotation_stddev=(0.0, 0.0, 0.0),
    )


def mrclam(robot: int) -> World:
    """Return a robot's run of MRCLAM 6."""
    folder = data_folder() / 'mrclam' / 'MRCLAM_Dataset6'
    return _recorded(load_mrclam(folder, robot), shipped_settings('mrclam'))


def starry_night() -> World:
    """Return Starry Night."""
    data_set = load_starry_night(data_folder() / 'starry_night' / 'dataset3.mat')
    return _recorded(data_set, shipped_settings('stereo_inertial'))


def victoria_park() -> World:
    """Return Victoria Park: a car among trees, with the batch optimum of its graph for truth.

    Wheel encoder and steering angle give an edge to 1 cm and 0.1°; the laser's trees are as far
    off as their trunks are wide, and their file states.
    """
    return _graph('victoria_park', 'victoria_park_batch', graph_settings(0.002, 0.01, 0.632))


def city_trees() -> World:
    """Return cityTrees10000: simulated steps and turns on a grid, with the noise as stated."""
    truth = 'city_trees_10000_groundtruth'
    return _graph('city_trees_10000', truth, graph_settings(0.01, 0.02, 0.1))


def graph_settings(turn_rad: float, step_m: float, point_m: float) -> Settings:
    """Return the settings of a planar graph: deviations of an edge, a second, and of a point."""
    return Settings(
        reorder_window=0.0,
        two_d_mode=True,
        angular_velocity_noise=(0.0, 0.0, turn_rad),
        linear_velocity_noise=(step_m, step_m, 0.0),
        velocity_delay_stddev=0.0,  # steps have no time
        observation_model='cartesian',
        point_noise=point_m,
    )


def _graph(name: str, truth: str, settings: Settings) -> World:
    folder = data_folder() / 'graphs'
    return _recorded(load_graph(folder / f'{name}.txt', folder / f'{truth}.txt'), settings)


def circle() -> World:
    """Return the paper's circle with noise, whose figures the estimators know."""
    simulation = Simulation(CIRCLE)
    per_root_second = CIRCLE.velocity_rate**-0.5
    settings = Settings(
        reorder_window=0.0,
        angular_velocity_noise=(CIRCLE.angular_velocity_noise * per_root_second,) * 3,
        linear_velocity_noise=(CIRCLE.linear_velocity_noise * per_root_second,) * 3,
        observation_model='cartesian',
        point_noise=CIRCLE.point_noise,
    )
    arrivals = [delivery.event for delivery in simulation.deliveries()]
    events = [event for event in arrivals if isinstance(event, VelocityEvent | ObservationEvent)]
    stamps_ns = np.unique([event.stamp_ns for event in events])
    truth = Trajectory(stamps_ns, simulation.pose(stamps_ns))
    return World(settings, events, truth, simulation.landmark_truth(0))


def drive(loop: Loop, settings: Settings, seed: int, jitters: bool = False) -> World:
    """Drive a loop with noise that is just what ``settings`` say.

    A velocity is off by the same for all of its period, unless the robot ``jitters``: then it
    moves between two velocities as white noise has it, which is what filters assume.

    Observations state their covariances, computed where the landmarks really are: computed where
    a noisy sensor saw them they would be wrong, and no estimator could be consistent.
    """
    rng = np.random.default_rng(seed)
    t_s = np.arange(round(loop.duration_s * VELOCITY_RATE_HZ) + 1) / VELOCITY_RATE_HZ
    course = _course(loop, t_s, settings.two_d_mode)
    poses = se3.inverse(course[0]) @ course
    points = se3.transform(se3.inverse(course[0]), _roadside(loop, settings.two_d_mode, rng))
    walks = _walks(loop, settings.two_d_mode, seed) @ course[0][:3, :3]
    points -= loop.lap_s * np.linspace(0.0, 1.0, loop.landmarks)[:, None] * walks
    landmarks = LandmarkTruth(np.arange(loop.landmarks), points)
    return recorded_on(poses, landmarks, walks, loop, settings, rng, jitters)


def recorded_on(
    poses: FloatArray,
    landmarks: LandmarkTruth,
    walks: FloatArray,
    loop: Loop,
    settings: Settings,
    rng: np.random.Generator,
    jitters: bool = False,
) -> World:
    """Return what is measured on a way of poses (k, 4, 4), among landmarks at ``walks`` m/s."""
    stamps_ns = np.rint(np.arange(len(poses)) * 1e9 / VELOCITY_RATE_HZ).astype(np.int64)
    # Truth is at the stamps of velocities and between them, where landmarks are seen.
    steps = se3.log(se3.inverse(poses[:-1]) @ poses[1:])
    share = OBSERVED_AFTER_S * VELOCITY_RATE_HZ
    deviations = _step_deviations(steps, settings)
    moved = share * steps
    if jitters:  # a Brownian bridge from one velocity to the next
        bridge = math.sqrt(share * (1.0 - share)) * deviations
        moved = moved + bridge * rng.standard_normal(steps.shape)
    between = poses[:-1] @ se3.exp(moved)
    between_ns = stamps_ns[:-1] + round(OBSERVED_AFTER_S * 1e9)
    order = np.argsort(np.append(stamps_ns, between_ns))
    truth = Trajectory(
        np.append(stamps_ns, between_ns)[order], np.append(poses, between, axis=0)[order]
    )
    events: list[Event] = []
    world = World(settings, events, truth, landmarks, walks)
    velocities = VELOCITY_RATE_HZ * (steps + deviations * rng.standard_normal(steps.shape))
    for k, stamp_ns in enumerate(stamps_ns[:-1].tolist()):
        events.append(VelocityEvent(stamp_ns, velocities[k]))
        if k % (VELOCITY_RATE_HZ // loop.observation_rate_hz) == 0:
            seen_ns = int(between_ns[k])
            there = world.landmarks_at(seen_ns)
            seen = _look(seen_ns, between[k], there, loop, rng)
            if len(seen.ids):
                events.append(_measured(seen, settings, rng))
    return world


def _drive_shipped(loop: Loop) -> World:
    return drive(loop, simulated_settings(loop.config), seed=0)


def _recorded(data_set: DataSet, settings: Settings) -> World:
    velocities = [
        VelocityEvent(stamp_ns, body_velocity)
        for stamp_ns, body_velocity in zip(
            data_set.velocity_stamps_ns.tolist(), data_set.body_velocities, strict=True
        )
    ]
    events: list[Event] = [*velocities, *data_set.observations]
    events.sort(key=lambda event: event.stamp_ns)  # stable: velocities stay first
    truth = Trajectory(data_set.truth_stamps_ns, data_set.true_poses)
    return World(settings, events, truth, data_set.landmarks)


def _course(loop: Loop, t_s: FloatArray, planar: bool) -> FloatArray:
    """Return the poses (k, 4, 4) at times (k,): a wavy ring, in 3D also rising and banking."""
    phi = 2.0 * math.pi * t_s / loop.lap_s
    positions = _ring(loop, phi, planar)
    ahead = _ring(loop, phi + 1e-4, planar) - positions
    angles = np.zeros_like(positions)
    angles[:, 2] = np.arctan2(ahead[:, 1], ahead[:, 0])
    rotations = so3.exp(angles)
    if not planar:
        tilt = 0.2 * np.stack([np.sin(7.0 * phi), np.cos(5.0 * phi), np.zeros_like(phi)], axis=-1)
        rotations = rotations @ so3.exp(tilt)
    return se3.pose(rotations, positions)


def _ring(loop: Loop, phi: FloatArray, planar: bool) -> FloatArray:
    """Return points (k, 3) of the course at angles (k,)."""
    mean_radius = SPEED * loop.lap_s / (2.0 * math.pi)
    radius = mean_radius * (1.0 + 0.1 * np.sin(3.0 * phi))
    height = np.zeros_like(phi) if planar else 0.05 * mean_radius * np.sin(4.0 * phi)
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), height], axis=-1)


def _roadside(loop: Loop, planar: bool, rng: np.random.Generator) -> FloatArray:
    """Return landmarks (n, 3), spread along the course and up to 3 m beside it."""
    phi = 2.0 * math.pi * (np.arange(loop.landmarks) + rng.uniform(size=loop.landmarks))
    offsets = rng.uniform(-3.0, 3.0, (loop.landmarks, 3))
    points: FloatArray = _ring(loop, phi / loop.landmarks, planar) + offsets
    return points * np.array([1.0, 1.0, 0.0]) if planar else points


def _walks(loop: Loop, planar: bool, seed: int) -> FloatArray:
    """Return the landmarks' velocities (n, 3), of most of them zero."""
    rng = np.random.default_rng([seed, loop.landmarks])  # landmarks stay where they are
    directions = rng.standard_normal((loop.landmarks, 3)) * np.array([1.0, 1.0, not planar])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    speeds = rng.uniform(*LANDMARK_SPEED, loop.landmarks)
    moving = rng.permutation(loop.landmarks) < round(loop.moving_share * loop.landmarks)
    walks: FloatArray = (speeds * moving)[:, None] * directions
    return walks


def _step_deviations(steps: FloatArray, settings: Settings) -> FloatArray:
    """Return by how much the motions (k, 6), each of one period, are off in velocities (k, 6)."""
    dt_s = 1.0 / VELOCITY_RATE_HZ
    k = len(steps)
    held = HeldVelocities(
        steps / dt_s,
        np.zeros((k, 6, 6)),
        np.zeros((k, 2), dtype=bool),
        np.full(k, dt_s),
        np.zeros(k),
        np.zeros((k, 2)),
        np.empty(0),
        np.empty((0, 6)),
        np.full(2, np.inf),
    )
    return np.sqrt(np.diagonal(MotionNoise(settings).covariances(held), axis1=1, axis2=2))


def _look(
    stamp_ns: int,
    pose: FloatArray,
    landmarks: LandmarkTruth,
    loop: Loop,
    rng: np.random.Generator,
) -> ObservationEvent:
    """Return where the landmarks that are seen really are, in the body frame."""
    points = se3.transform(se3.inverse(pose), landmarks.world_points)
    range_m = np.linalg.norm(points, axis=1)
    nearest = np.argsort(range_m)[: loop.max_seen]
    seen = range_m[nearest] <= loop.max_range_m
    seen &= rng.random(len(nearest)) < loop.detected_share
    bearings_rad = np.arctan2(points[nearest, 1], points[nearest, 0])
    seen &= np.abs(bearings_rad) <= 0.5 * loop.view_rad
    rows = np.sort(nearest[seen])
    return ObservationEvent(stamp_ns, landmarks.ids[rows], points[rows])


def _measured(
    seen: ObservationEvent, settings: Settings, rng: np.random.Generator
) -> ObservationEvent:
    covariances = ObservationNoise(settings).covariances(seen)
    roots = np.linalg.cholesky(covariances)
    noise = (roots @ rng.standard_normal((len(seen.ids), 3, 1)))[:, :, 0]
    if settings.two_d_mode:
        noise[:, 2] = 0.0
    return replace(seen, points=seen.points + noise, covariances=covariances)


_RECORDED: dict[str, Callable[[], World]] = {
    'Starry Night': starry_night,
    **{f'MRCLAM 6, robot {robot}': partial(mrclam, robot) for robot in range(1, 6)},
    'Victoria Park': victoria_park,
    'cityTrees10000': city_trees,
}

_SIMULATED: dict[str, Callable[[], World]] = {
    "the paper's circle with noise": circle,
    'simulated loop, 3D stereo': partial(_drive_shipped, STEREO_LOOP),
    'simulated loop, wheeled': partial(_drive_shipped, WHEELED_LOOP),
}
