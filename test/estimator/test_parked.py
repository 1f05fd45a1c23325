"""A robot stands for most of its life: its pose stays as it is, and as sure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import (
    AngularVelocityEvent,
    ObservationEvent,
    UNKNOWN_ID,
    VelocityBlock,
    VelocityEvent,
)
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.models.velocity_history import STANDS_NS, TURNS, VelocityHistory
from slam_observer_ros.settings.estimator_settings import Settings

PERIOD_NS = 50_000_000
SECOND = 10**9
POINTS = np.array([[2.0, 0.3, 0.2], [3.0, -1.0, 0.3], [3.0, 1.5, 0.4], [-2.0, 1.0, 0.1]])
SETTINGS = Settings(reorder_window=0.0, point_noise=0.03, observation_model='cartesian')
V = np.array([0.0, 0.0, 0.1, 0.3, 0.0, 0.0])
GYRO_NOISE = 0.004  # rad/s of a single message


class Robot:
    """Drives, stands, and is pushed; odometry does not notice the last."""

    def __init__(self, settings=SETTINGS):
        self.estimator, self.rng = Estimator(settings), np.random.default_rng(0)
        self.A, self.stamp_ns = np.eye(4), 0

    def run(self, seconds, rows, V=V, pushed=None, wander=0.0, ids=None, bias=None):
        """Go on for some time, seeing landmarks ``rows`` ten times a second.

        With a ``bias`` (3,), rad/s, a gyroscope measures how the robot turns.
        """
        for step in range(round(seconds * SECOND / PERIOD_NS)):
            self.estimator.add(VelocityEvent(self.stamp_ns, V))
            if bias is not None:
                turning = V[:3] - bias + GYRO_NOISE * self.rng.normal(size=3)
                self.estimator.add(AngularVelocityEvent(self.stamp_ns, turning))
            self.A = self.A @ se3.exp(PERIOD_NS / SECOND * (V if pushed is None else pushed))
            self.stamp_ns += PERIOD_NS
            if len(rows) and step % 2:
                seen = se3.transform(se3.inverse(self.A), POINTS[rows])
                seen += wander + 0.01 * self.rng.normal(size=seen.shape)
                named = np.array(rows) if ids is None else ids
                self.estimator.add(ObservationEvent(self.stamp_ns, named, seen))
        self.estimator.flush()

    @property
    def error_m(self):
        return float(np.linalg.norm(self.estimator.pose[:3, 3] - self.A[:3, 3]))

    @property
    def sigmas(self):
        return np.sqrt(np.diag(self.estimator.pose_covariance))


@pytest.mark.parametrize(
    ('rows', 'wander'), [([], 0.02), ([0], 0.0), ([0, 1, 2], 0.0), ([0, 1, 2], 0.02)]
)
def test_after_a_long_time_at_rest_it_is_where_it_was_and_as_sure(rows, wander):
    robot = Robot()
    robot.run(10.0, [0, 1, 2, 3])
    robot.run(2.0, rows, np.zeros(6))
    before, pose = robot.sigmas, robot.estimator.pose
    robot.run(100.0, rows, np.zeros(6), wander=wander)
    assert (robot.sigmas < 1.05 * before + 1e-4).all()
    assert np.linalg.norm(robot.estimator.pose[:3, 3] - pose[:3, 3]) < 0.01 + 1.8 * wander
    # What is seen again and again from one place makes it no surer than a few views do.
    assert (robot.sigmas > 0.3 * before).all()
    assert robot.estimator.counts['slip'] == robot.estimator.counts['moved_landmark'] == 0
    robot.run(10.0, [0, 1, 2, 3])
    assert robot.error_m < 0.05
    assert robot.estimator.counts['slip'] == 0


@pytest.mark.parametrize('rows', [[0], [0, 1, 2]])
def test_a_robot_that_is_pushed_with_its_wheels_locked_is_noticed(rows):
    covariances = np.tile(1e-4 * np.eye(3), (4, 1, 1))
    known = LandmarkMap(np.arange(4), POINTS, covariances, np.zeros(4, dtype=np.int64))
    robot = Robot(replace(SETTINGS, localization_mode='fixed'))
    robot.estimator.load_map(known, np.eye(4), 1e-4 * np.eye(6))
    robot.run(5.0, [0, 1, 2, 3])
    robot.run(60.0, rows, np.zeros(6))
    robot.run(2.0, rows, np.zeros(6), pushed=0.3 * np.eye(6)[3])
    robot.run(5.0, rows, np.zeros(6))
    is_sure = robot.error_m < 3.0 * np.linalg.norm(robot.sigmas[3:])
    assert is_sure or robot.estimator.is_contradicted
    if len(rows) > 1:
        assert robot.error_m < 0.1


def variances(history, start_ns, end_ns):
    held = history.held(start_ns, end_ns)
    return held.is_stated.all(), np.diagonal(held.covariances, axis1=1, axis2=2).max()


@pytest.mark.parametrize('named', [0, 2, 4])
def test_rejected_points_without_ids_end_standing_as_others_do(named):
    robot, ids = Robot(), np.where(np.arange(4) < named, np.arange(4), UNKNOWN_ID)
    robot.run(10.0, [0, 1, 2, 3], ids=ids)
    robot.run(3.0, [0, 1, 2, 3], np.zeros(6), ids=ids)
    timeline, update = robot.estimator._timeline, robot.estimator.last_update
    assert timeline.velocities.stood_s(robot.stamp_ns) > 1.0
    none, all_ = np.zeros(4, dtype=bool), np.ones(4, dtype=bool)
    event = ObservationEvent(robot.stamp_ns, ids, POINTS)
    for rejected, off_m, stands in ((none, 5.0, True), (all_, 0.0, True), (all_, 5.0, False)):
        residuals = np.full((4, 3), off_m)
        timeline.judge_standing(event, replace(update, rejected=rejected, residuals=residuals))
        assert (timeline.velocities.stood_s(robot.stamp_ns) > 0.0) == stands


def test_standing_begins_after_a_second_of_zeros_and_ends_at_once():
    history = VelocityHistory(SECOND)
    moves = [0, *range(60, 70)]
    for step in range(80):
        velocity = V if step in moves else np.zeros(6)
        history.append(VelocityEvent(step * PERIOD_NS, velocity))
        stood_ns = (step - 1) * PERIOD_NS
        stands = step not in moves and step < 60 and stood_ns >= STANDS_NS
        assert history.stood_s(step * PERIOD_NS) == (stood_ns / SECOND if stands else 0.0)
    assert variances(history, 30 * PERIOD_NS, 59 * PERIOD_NS) == (True, 1e-8)
    assert variances(history, PERIOD_NS, 10 * PERIOD_NS) == (False, 0.0)


def test_who_has_no_odometry_and_publishes_zeros_does_not_stand():
    history = VelocityHistory(SECOND)
    for step in range(100):
        history.append(VelocityEvent(step * PERIOD_NS, np.zeros(6)))
        assert history.stood_s(step * PERIOD_NS) == 0.0


def test_a_driver_that_falls_silent_does_not_stand():
    history = VelocityHistory(SECOND // 2)
    history.append(VelocityEvent(-SECOND, V))
    for stamp_ns in (0, SECOND // 4, 5 * SECOND, 5 * SECOND + SECOND // 4):
        history.append(VelocityEvent(stamp_ns, np.zeros(6)))
        assert history.stood_s(stamp_ns) == 0.0


def test_velocities_in_a_block_stand_as_single_ones_do():
    stamps_ns = PERIOD_NS * np.arange(100)
    velocities = np.where((stamps_ns % (2 * SECOND) < SECOND // 5)[:, None], V, 0.0)
    one, many = VelocityHistory(SECOND), VelocityHistory(SECOND)
    for stamp_ns, velocity in zip(stamps_ns.tolist(), velocities, strict=True):
        one.append(VelocityEvent(stamp_ns, velocity))
    many.append(VelocityBlock(stamps_ns, velocities))
    for first, second in zip(one.flat(), many.flat(), strict=True):
        np.testing.assert_array_equal(first, second)
    assert one.flat().is_stated.any()


@pytest.mark.parametrize(
    'changes',
    [{}, {'two_d_mode': True}, {'relinearization_interval': 0}, {'calibration_drift': 0.01}],
)
def test_a_gyroscope_beside_the_wheels_learns_its_bias_while_they_stand(changes):
    settings = replace(SETTINGS, smoothing_window=0, **changes)
    bias = np.array([0.0, 0.0, -0.02] if settings.two_d_mode else [-0.006, 0.008, -0.02])
    robot = Robot(settings)

    def errors(found):
        biases = [part for part in found if 'angular_bias' in part.name]
        deviations = np.array([part.deviation for part in biases])
        true = bias[-len(biases) :]
        return np.array([part.value for part in biases]) - true, deviations

    def turned():
        return float(np.linalg.norm(so3.log(robot.estimator.pose[:3, :3].T @ robot.A[:3, :3])))

    robot.run(5.0, [0, 1, 2, 3], bias=bias)
    robot.run(5.0, [], np.zeros(6), bias=bias)
    before = robot.estimator.pose
    robot.run(60.0, [], np.zeros(6), bias=bias)
    # It has not turned by 1.2 rad, but by what the bias says of the drive before, …
    np.testing.assert_allclose(robot.estimator.pose, before, atol=0.02)
    off, deviations = errors(robot.estimator.calibration)
    assert (deviations < 5e-4).all()
    assert (np.abs(off) < 4.0 * deviations).all()
    # … nor does it in the dark, and relinearising or smoothing what was seen forgets nothing.
    began = turned()
    robot.run(10.0, [], bias=bias)
    assert turned() - began < 0.15  # the noise of turning, 0.03 rad/√s
    robot.run(20.0, [0, 1, 2, 3], bias=bias)
    found = [robot.estimator.calibration]
    if settings.relinearization_interval:
        found.append(robot.estimator.smooth().calibration)
    for each in found:
        off, deviations = errors(each)
        assert (deviations < 1e-3).all()
        assert (np.abs(off) < 4.0 * deviations).all()


def test_a_gyroscope_beside_wheels_that_stand_since_start_up_shows_its_bias_before_any_drive():
    robot, bias = Robot(), np.array([-0.006, 0.008, -0.02])
    robot.run(20.0, [], np.zeros(6), bias=bias)
    found = [part for part in robot.estimator.calibration if 'angular_bias' in part.name]
    off = np.array([part.value for part in found]) - bias
    deviations = np.array([part.deviation for part in found])
    assert (deviations < 5e-4).all()
    assert (np.abs(off) < 4.0 * deviations).all()
    turned_rad = np.linalg.norm(so3.log(robot.estimator.pose[:3, :3]))
    assert turned_rad < 0.05  # of 0.45 by the gyroscope alone


@pytest.mark.parametrize(('rate', 'stands'), [(0.5 * TURNS, True), (2.0 * TURNS, False)])
def test_wheels_that_stand_overrule_the_bias_of_a_gyroscope_but_not_a_turn(rate, stands):
    history, turns = VelocityHistory(SECOND), np.array([0.0, 0.0, rate])
    history.append(VelocityEvent(0, V))
    for step in range(1, 60):
        history.append(VelocityEvent(step * PERIOD_NS, np.zeros(6)))
        history.append(AngularVelocityEvent(step * PERIOD_NS + 1, turns))
    stamp_ns = 60 * PERIOD_NS
    assert (history.stood_s(stamp_ns) > 0.0) == stands
    latest = history.latest(stamp_ns - 1)
    np.testing.assert_array_equal(latest[:3], 0.0 if stands else turns)
