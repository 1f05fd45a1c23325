"""Random halls: each seed draws the hall, its landmarks, the sensor, and what is not stated."""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

import numpy as np
from odometry import Event
import outliers
import slips
import worlds
from worlds import Loop, World

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.models.calibration import without_calibration
from slam_observer_ros.recordings.trajectory import LandmarkTruth
from slam_observer_ros.settings.estimator_settings import Settings

DURATION_S = 120.0
STANDS_S = 1.0
"""How long the robot stands before it drives on, also at the very start."""

SIDE_M, SPACING_M, SPEED, TURN_RATE = (10.0, 40.0), (1.0, 6.0), (0.4, 1.0), 0.8
LANDMARKS = (8, 120)
"""Fewest and most in a hall; another is drawn where there would be others."""

MOST_SEEN = 20.0
"""Landmarks that a sensor has in view on average, at most: with more nothing is in doubt."""

FALSE_SHARES = (0.0, 0.05, 0.1)
SCALE, DELAY_NS = 0.03, 250_000_000


@dataclass(frozen=True, slots=True)
class Hall:
    """A hall, as a seed draws it, and what of it the estimator's settings don't say."""

    seed: int
    sides_m: FloatArray  # (2,)
    spacing_m: float
    sensor: str
    loop: Loop  # how the sensor sees
    settings: Settings
    false_share: float
    unstated: tuple[str, ...]

    @property
    def kind(self) -> str:
        """The kind of world whose figures are averaged."""
        return f'{self.sensor}, {"not as stated" if self.unstated else "as stated"}'

    def __str__(self) -> str:
        loop, (x, y) = self.loop, self.sides_m
        return (
            f'{self.seed}: {x:.0f} × {y:.0f} m, {loop.landmarks} landmarks, {self.sensor} '
            f'{math.degrees(loop.view_rad):.0f}° {loop.max_range_m:.1f} m '
            f'{loop.observation_rate_hz} Hz {loop.detected_share:.0%}, {self.false_share:.0%} '
            f'false{"".join(", " + what for what in self.unstated)}'
        )


def draw(seed: int) -> Hall:
    """Draw a hall."""
    rng = np.random.default_rng([seed, 53])
    is_scanner = bool(rng.random() < 0.5)
    while True:
        sides_m, spacing_m = rng.uniform(*SIDE_M, 2), rng.uniform(*SPACING_M)
        view, reach = ((90, 360), (4, 12)) if is_scanner else ((45, 90), (3, 6))
        view_rad, reach_m = math.radians(rng.uniform(*view)), float(rng.uniform(*reach))
        count = round(sides_m.prod() / spacing_m**2)
        in_view = 0.5 * view_rad * reach_m**2 / spacing_m**2
        if LANDMARKS[0] <= count <= LANDMARKS[1] and in_view <= MOST_SEEN:
            break
    rates, detected = ((2, 4, 5, 10), (0.6, 0.98)) if is_scanner else ((1, 2, 4), (0.4, 0.9))
    loop = Loop(
        'wheeled_bearing_range',
        0.0,
        DURATION_S,
        count,
        reach_m,
        int(rng.choice(rates)),
        max_seen=count,
        detected_share=float(rng.uniform(*detected)),
        view_rad=view_rad,
    )
    unstated = np.array(['wheels', 'ranges', 'delay', 'slips'])[rng.random(4) < 0.5].tolist()
    return Hall(
        seed,
        sides_m,
        float(spacing_m),
        'scanner' if is_scanner else 'camera',
        loop,
        _settings(loop, is_scanner, rng),
        float(rng.choice(FALSE_SHARES)),
        tuple(unstated) if rng.random() < 0.5 else (),
    )


def world(hall: Hall) -> World:
    """Return what is measured in a hall, with ids and without false points."""
    rng = np.random.default_rng([hall.seed, 54])
    course = _course(hall, rng)
    points = se3.transform(se3.inverse(course[0]), _landmarks(hall, rng))
    landmarks = LandmarkTruth(np.arange(len(points)), points)
    poses, walks = se3.inverse(course[0]) @ course, np.zeros((len(points), 3))
    measured = worlds.recorded_on(poses, landmarks, walks, hall.loop, hall.settings, rng)
    measured = replace(measured, landmark_velocities=None)
    if 'slips' in hall.unstated:
        measured = slips.with_slips(measured, hall.seed)
    events = [_as_it_is(event, hall) for event in measured.events]
    events = [event for event in events if event.stamp_ns >= 0]
    events.sort(key=lambda event: event.stamp_ns)  # stable: velocities stay first
    return replace(measured, events=events)


def without_ids(hall: Hall, measured: World) -> World:
    """Return the same without ids and with the hall's false points."""
    return outliers.with_false_points(measured, hall.seed, hall.false_share)


def _settings(loop: Loop, is_scanner: bool, rng: np.random.Generator) -> Settings:
    """Return what is stated: of half of the robots nothing is calibrated on the way."""
    settings = worlds.simulated_settings(loop.config)
    if is_scanner:
        settings = replace(
            settings,
            range_noise=float(rng.uniform(0.01, 0.05)),
            range_scale_noise=0.0,
            bearing_noise=float(rng.uniform(0.003, 0.015)),
        )
    else:
        settings = replace(
            settings,
            range_noise=float(rng.uniform(0.02, 0.05)),
            range_scale_noise=float(rng.uniform(0.01, 0.05)),
            bearing_noise=float(rng.uniform(0.005, 0.03)),
        )
    return settings if rng.random() < 0.5 else without_calibration(settings)


def _course(hall: Hall, rng: np.random.Generator) -> FloatArray:
    """Return poses (k, 4, 4): from one random place to the next, turning on the way."""
    dt_s, speed = 1.0 / worlds.VELOCITY_RATE_HZ, rng.uniform(*SPEED)
    steps = round(DURATION_S * worlds.VELOCITY_RATE_HZ) + 1
    margin_m = np.minimum(1.5, 0.2 * hall.sides_m)
    position, goal = rng.uniform(margin_m, hall.sides_m - margin_m, (2, 2))
    heading, waits_s = rng.uniform(-math.pi, math.pi), STANDS_S
    positions, headings = np.zeros((steps, 3)), np.zeros((steps, 3))
    for k in range(steps):
        positions[k, :2], headings[k, 2] = position, heading
        waits_s -= dt_s
        if waits_s > 0.0:
            continue
        ahead = goal - position
        off = math.remainder(math.atan2(ahead[1], ahead[0]) - heading, 2.0 * math.pi)
        turn = min(max(2.0 * off, -TURN_RATE), TURN_RATE) * dt_s
        # Slower while it turns: so no goal is circled for ever.
        way_m = speed * max(math.cos(off), 0.0) * dt_s
        position = position + way_m * np.array([math.cos(heading), math.sin(heading)])
        heading += turn
        if math.hypot(*ahead) < 0.5:
            goal = rng.uniform(margin_m, hall.sides_m - margin_m)
            waits_s = STANDS_S if rng.random() < 0.2 else 0.0
    return se3.pose(so3.exp(headings), positions)


def _landmarks(hall: Hall, rng: np.random.Generator) -> FloatArray:
    """Return landmarks (n, 3), none nearer to another than a third of the spacing."""
    points: list[FloatArray] = []
    while len(points) < hall.loop.landmarks:
        point = np.append(rng.uniform(0.0, hall.sides_m), 0.0)
        if all(np.linalg.norm(point - other) >= hall.spacing_m / 3.0 for other in points):
            points.append(point)
    return np.array(points)


def _as_it_is(event: Event, hall: Hall) -> Event:
    """Return an event of a robot that is not as it is stated to be."""
    unstated = hall.unstated
    if isinstance(event, ObservationEvent):
        scale = 1.0 + SCALE * ('ranges' in unstated)
        return replace(event, points=scale * event.points)
    if isinstance(event, VelocityEvent):
        off = SCALE if hall.seed % 4 < 2 else -SCALE
        scale = 1.0 + off * ('wheels' in unstated)
        # What is stamped now is obeyed later.
        stamp_ns = event.stamp_ns - DELAY_NS * ('delay' in unstated)
        return replace(event, stamp_ns=stamp_ns, body_velocity=scale * event.body_velocity)
    return event
