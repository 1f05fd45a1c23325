"""Delay and noise of the odometry are not judged by what something else explains."""

from __future__ import annotations

from collections import deque
import math

import numpy as np
import pytest

from slam_observer_ros.common.findings import explained, OF_ODOMETRY
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.runs.health import of_estimate
from slam_observer_ros.settings.estimator_settings import Settings

TAGS = 5.0 * np.array([[math.cos(a), math.sin(a), 0.0] for a in np.arange(12) * math.pi / 6.0])
FORKLIFT = np.array([[1.0 + 0.3 * j, 0.0, 0.0] for j in range(4)])
STEP_NS = 50_000_000
CIRCLE = np.array([0.0, 0.0, 0.5 / 3.0, 0.5, 0.0, 0.0])
STILL = np.zeros(6)


class Robot:
    """Drives in a hall of twelve tags, and is asked each second what is wrong."""

    def __init__(self, is_in_map=True):
        self.estimator = Estimator(Settings(two_d_mode=True, localization_mode='uncertain'))
        if is_in_map:
            points = np.concatenate([TAGS, FORKLIFT])
            covariances = np.tile(1e-4 * np.eye(3), (16, 1, 1))
            counts = np.zeros(16, dtype=np.int64)
            self.estimator.load_map(LandmarkMap(np.arange(16), points, covariances, counts))
        self.pose = se3.from_rpy((3.0, 0.0, 0.0, 0.0, 0.0, math.pi / 2.0))
        self.rng, self.stamp_ns, self.steps = np.random.default_rng(2), 0, 0
        self.named = []  # (seconds, kind)

    def drive(self, seconds, V=CIRCLE, report=None, beside=False, every=1):
        """Move by V, or V(step), and report that, or report(step): each velocity once in every."""
        for _ in range(round(20 * seconds)):
            twist = V(self.steps) if callable(V) else V
            if self.steps % every == 0:
                said = report(self.steps) if report else twist
                self.estimator.add(VelocityEvent(self.stamp_ns, said))
            self.pose = self.pose @ se3.exp(0.05 * twist)
            self.stamp_ns, self.steps = self.stamp_ns + STEP_NS, self.steps + 1
            if self.steps % 2 == 0:
                self._see(beside)
            if self.steps % 20 == 0:
                self.look()

    def _see(self, beside):
        seen = se3.transform(se3.inverse(self.pose), TAGS)
        ids = np.flatnonzero(np.linalg.norm(seen, axis=1) < 5.0)
        points = seen[ids]
        if beside:
            ids = np.append(ids, np.arange(12, 16))
            swaying = FORKLIFT + [0.5 + 0.05 * math.sin(self.steps / 50.0), 0.6, 0.0]
            points = np.concatenate([points, swaying])
        points[:, :2] += 0.02 * self.rng.normal(size=(len(ids), 2))
        self.estimator.add(ObservationEvent(self.stamp_ns, ids, points))

    def look(self):
        findings = explained(of_estimate(self.estimator))
        self.named += [(self.steps / 20, each.kind) for each in findings]

    @property
    def kinds(self):
        return {kind for _, kind in self.named}


@pytest.mark.parametrize('is_in_map', [True, False])
def test_landmarks_on_a_forklift_are_no_noise_of_the_odometry(is_in_map):
    robot = Robot(is_in_map)
    robot.drive(5.0)
    robot.drive(15.0, beside=True)
    robot.drive(40.0)
    assert robot.estimator.counts['carried_landmark'] == 4
    # What the filter takes is another matter: it is careful until it knows better.
    assert not robot.kinds & OF_ODOMETRY


@pytest.mark.parametrize('is_in_map', [True, False])
def test_a_robot_that_is_pushed_has_no_late_odometry(is_in_map):
    robot = Robot(is_in_map)
    robot.drive(20.0)
    robot.drive(3.0, np.array([0.0, 0.0, 0.4, 0.5, 0.0, 0.0]), report=lambda _: STILL)
    robot.drive(30.0)
    assert sum(robot.estimator.counts[name] for name in ('slip', 'lost'))
    assert not robot.kinds & OF_ODOMETRY


def test_a_robot_whose_driver_was_not_alone_has_no_late_odometry():
    robot = Robot()
    for _ in range(20):
        robot.estimator.distrust_odometry()  # as the node does while it hears two
        robot.drive(1.0, V=wavy, report=lambda step: wavy(step) * (1.0, 1.6)[step % 2])
    robot.drive(2.0, V=wavy)
    assert not robot.kinds & OF_ODOMETRY


def wavy(step):
    turn = 0.3 * math.sin(step / 40.0)
    return np.array([0.0, 0.0, 0.15 + turn, 0.4 + 0.3 * math.sin(step / 22.0), 0.0, 0.0])


def test_a_late_odometry_is_named_in_time_and_for_good_whatever_slips():
    robot, late = Robot(), deque(maxlen=7)

    def delayed(step):
        late.append(wavy(step))
        return late[0]

    robot.drive(30.0, V=delayed, report=wavy)
    assert (30.0, 'late_odometry') in robot.named
    robot.drive(2.0, V=lambda _: STILL, report=wavy)  # it stands, and its wheels spin
    named_s = robot.steps / 20
    robot.drive(30.0, V=delayed, report=wavy)
    assert sum(kind == 'late_odometry' and s > named_s for s, kind in robot.named) > 15
    (found,) = [each for each in of_estimate(robot.estimator) if each.kind == 'late_odometry']
    assert '0.3' in found.what or '0.2' in found.what


def test_a_noisy_odometry_is_named_between_the_slips_it_passes_for():
    robot = Robot()
    robot.drive(
        70.0,
        report=lambda _: CIRCLE + [0.0, 0.0, 1.0, 1.0, 0.0, 0.0] * robot.rng.normal(size=6),
    )
    assert robot.estimator.counts['slip']
    assert (70.0, 'noisy_odometry') in robot.named


@pytest.mark.parametrize('period_s', [0.7, 1.0, 1.5])
def test_commands_by_key_press_are_named_and_no_delay_or_noise(period_s):
    """The robot follows each slowly, and stops half a second later."""
    named = 0
    for seed in range(1, 4):
        robot, rng, V = Robot(), np.random.default_rng(seed), np.zeros(6)
        every = round(20 * period_s)
        commands = np.zeros((2000, 6))
        commands[:, [2, 3]] = rng.uniform([-0.6, 0.1], [0.6, 0.5], size=(2000, 2))

        def followed(step, commands=commands, every=every, V=V):
            wanted = commands[step // every] if step % every < 10 else STILL
            V[:] += (wanted - V) / 8.0
            return V.copy()

        def reported(step, commands=commands, every=every):
            return commands[step // every]

        robot.drive(60.0, V=followed, report=reported, every=every)
        assert not robot.kinds & OF_ODOMETRY
        named += 'rare_velocity' in robot.kinds
    # Where each has ended before the next, nothing may be wrong at all.
    assert period_s > 1.0 or named >= 2


def test_at_the_end_of_a_recording_all_counts_as_nothing_more_will_show():
    robot, late = Robot(), deque(maxlen=7)

    def delayed(step):
        late.append(wavy(step))
        return late[0]

    robot.drive(10.0, V=delayed, report=wavy)
    assert 'late_odometry' not in robot.kinds
    robot.estimator.flush()
    robot.look()
    assert robot.kinds == {'late_odometry'}
