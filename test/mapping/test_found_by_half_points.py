"""A robot that is lost in a surveyed map finds itself by ranges or bearings alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import (
    AZIMUTH,
    AZIMUTH_RANGE,
    BEARING,
    ObservationEvent,
    RANGE,
    VelocityEvent,
)
from slam_observer_ros.lie import se3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.settings.estimator_settings import Settings

STEP_S, STEP_NS = 0.1, 100_000_000
DRIVE_M, SPEED = 30.0, 0.7
PLANE = Settings(
    two_d_mode=True,
    localization_mode='uncertain',
    observation_model='range_bearing',
    range_noise=0.1,
    bearing_noise=0.02,
    range_scale_stddev=0.1,
    angular_velocity_noise=(0.01, 0.01, 0.01),
    linear_velocity_noise=(0.02, 0.01, 0.01),
    reorder_window=0.0,
    max_rejections=1_000_000,
)
SPACE = replace(PLANE, two_d_mode=False)


class Hall:
    """A hall of any size with anchors anywhere, and a robot that starts anywhere."""

    def __init__(self, seed, settings=PLANE, anchors=8, in_a_line=False, turns=True, walls=0.0):
        self.rng, self.settings = np.random.default_rng(seed), settings
        self.turns, self.walls, n = turns, walls, anchors
        self.flat = np.array([1.0, 1.0, 0.0 if settings.two_d_mode else 1.0])
        self.size = self.rng.uniform(10.0, 40.0, 2)
        low, high = np.array([0.0, 0.0, 0.5]), np.array([*self.size, 4.0])
        self.points = self.rng.uniform(low, high, (n, 3)) * self.flat
        if in_a_line:
            turn = self.rng.uniform(0.0, np.pi)
            line = np.array([np.cos(turn), np.sin(turn), 0.0])
            far = self.rng.uniform(-0.5, 0.5, (n, 1)) * self.size[0]
            self.points = np.array([*self.size / 2.0, 0.0]) + far * line
        self.scale = np.exp(0.05 * self.rng.normal())
        start = self.rng.uniform(1.0, self.size - 1.0)
        yaw = self.rng.uniform(-np.pi, np.pi)
        self.A = se3.from_rpy((*start, self.flat[2], 0.0, 0.0, yaw))
        covariances = np.tile(1e-4 * np.eye(3), (n, 1, 1))
        survey = LandmarkMap(np.arange(n), self.points, covariances, np.zeros(n, np.int64))
        self.estimator = Estimator(settings)
        self.estimator.load_map(survey)

    def drive(self, kinds, distance_m=DRIVE_M):
        """Drive until the robot is found, or so far; return how far it was off, in metres."""
        turn = 0.0
        for step in range(round(distance_m / SPEED / STEP_S)):
            if step % 20 == 0 and self.turns:
                turn = self.rng.uniform(-0.6, 0.6)
            climb = 0.1 * np.sin(0.05 * step) * self.flat[2]
            V = np.array([0.0, climb, turn, SPEED, 0.0, 0.0])
            spread = np.array([0.01, 0.01, 0.01, 0.02, 0.01, 0.01]) / np.sqrt(STEP_S)
            spread[[0, 1, 5]] *= self.flat[2]
            stamp_ns = step * STEP_NS
            self.estimator.add(VelocityEvent(stamp_ns, V + spread * self.rng.normal(size=6)))
            if step % 4 == 0:
                self.estimator.add(self.seen(stamp_ns, kinds[step // 4 % len(kinds)]))
                if self.estimator.is_localised:
                    return float(np.linalg.norm((self.estimator.pose - self.A)[:3, 3]))
            self.A = self.A @ se3.exp(STEP_S * V)
        return None

    def seen(self, stamp_ns, kind):
        rows = self.rng.permutation(len(self.points))[:3]
        lines = se3.transform(se3.inverse(self.A), self.points[rows])
        ranges = np.linalg.norm(lines, axis=1, keepdims=True)
        units = lines / ranges + 0.02 * self.rng.normal(size=lines.shape) * self.flat
        units /= np.linalg.norm(units, axis=1, keepdims=True)
        through_wall = self.rng.random(ranges.shape) < self.walls
        ranges = ranges + through_wall * self.rng.exponential(1.0, ranges.shape)
        ranges = (ranges + 0.1 * self.rng.normal(size=ranges.shape)) / self.scale
        shown = {
            BEARING: units,
            AZIMUTH: units,
            RANGE: ranges * [1.0, 0.0, 0.0],
            AZIMUTH_RANGE: ranges * units,
        }[kind]
        return ObservationEvent(stamp_ns, rows, shown, kinds=np.full(len(rows), kind))

    @property
    def size_m(self):
        return float(np.linalg.norm(self.size))


@pytest.mark.parametrize('seed', range(6))
@pytest.mark.parametrize('kinds', [[RANGE], [BEARING], [AZIMUTH_RANGE], [RANGE, BEARING]], ids=str)
def test_a_robot_that_knows_nothing_is_found_within_a_short_drive(kinds, seed):
    hall = Hall(seed)
    off_m = hall.drive(kinds)
    assert off_m is not None and off_m < 0.05 * hall.size_m
    assert hall.estimator.localisation_problem is None


@pytest.mark.parametrize('seed', range(2))
@pytest.mark.parametrize('kind', [RANGE, BEARING, AZIMUTH_RANGE])
def test_in_space_it_is_found_as_well(kind, seed):
    hall = Hall(seed, SPACE)
    off_m = hall.drive([kind])
    assert off_m is not None and off_m < 0.05 * hall.size_m


@pytest.mark.parametrize('seed', range(4))
def test_ranges_through_walls_do_not_mislead_it(seed):
    hall = Hall(seed, walls=0.2)
    off_m = hall.drive([RANGE])
    assert off_m is not None and off_m < 0.05 * hall.size_m


@pytest.mark.parametrize(('seed', 'turns'), [(0, True), (2, False)])
def test_ranges_from_anchors_in_a_line_leave_the_side_open(seed, turns):
    hall = Hall(seed, in_a_line=True, turns=turns)
    assert hall.drive([RANGE]) is None
    problem = hall.estimator.localisation_problem
    assert problem is not None
    assert problem.kind in ('anchors_in_a_line', 'drive_a_curve')
    if turns:
        assert '(0, 1, 2, 3, 4, 5, 6, 7) stand in a line' in problem.what


@pytest.mark.parametrize('seed', range(3))
def test_bearings_of_anchors_in_a_line_say_on_which_side_it_is(seed):
    hall = Hall(seed, in_a_line=True)
    off_m = hall.drive([BEARING])
    assert off_m is not None and off_m < 0.05 * hall.size_m


def test_one_anchor_says_nothing_of_where_it_is():
    hall = Hall(0, anchors=1)
    hall.points = np.repeat(hall.points, 3, axis=0)
    assert hall.drive([RANGE]) is None
    assert hall.estimator.localisation_problem.kind == 'no_place'
