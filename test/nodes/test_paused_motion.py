"""After a pause the robot is where the odometry on /tf has brought it meanwhile."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
import pytest

from slam_observer_ros import Estimator, Settings
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.nodes.services import PausedMotion
from slam_observer_ros.nodes.transforms import TransformedOdometry
from slam_observer_ros.recordings.frames import TransformBuffer
from slam_observer_ros.settings.node_settings import ObserverNodeSettings

SECOND = 1_000_000_000
START_NS = 1_000 * SECOND
STEP_NS = SECOND // 20
V = np.array([0.0, 0.0, 0.3, 0.5, 0.0, 0.0])
DRIFT = se3.from_rpy((3.0, -4.0, 0.0, 0.0, 0.0, 2.0))
"""Pose of the map in the odometry's frame, as after a long drive."""


@pytest.fixture
def robot():
    return Robot()


class Robot:
    """Drives on, sees landmarks unless it is paused, and has its odometry on /tf."""

    def __init__(self):
        self.estimator = Estimator(Settings(two_d_mode=True, velocity_timeout=1.0))
        self.transforms = TransformBuffer()
        odometry = TransformedOdometry(ObserverNodeSettings(), self.transforms)
        self.motion = PausedMotion(self.estimator, odometry)
        self.stamp_ns, self.pose = START_NS, np.eye(4)
        self.points = 4.0 * np.random.default_rng(3).normal(size=(8, 3)) * [1.0, 1.0, 0.0]

    def drive(self, seconds, is_paused=False):
        for _ in range(round(20 * seconds)):
            self.transforms.insert('odom', 'base_link', self.stamp_ns, DRIFT @ self.pose)
            if not is_paused:
                self.estimator.add(VelocityEvent(self.stamp_ns, V))
                seen = se3.transform(se3.inverse(self.pose), self.points)
                self.estimator.add(ObservationEvent(self.stamp_ns, np.arange(8), seen))
            self.stamp_ns += STEP_NS
            self.pose = self.pose @ se3.exp(0.05 * V)

    def pause(self):
        self.estimator.release()
        self.motion.begin()

    def resume(self):
        is_followed = self.motion.end()
        self.estimator.release()
        return is_followed

    @property
    def odometry_in_map(self):
        """Map to odometry, as /tf has it."""
        stamp_ns = self.estimator.stamp_ns
        odometry = self.transforms.lookup('odom', 'base_link', stamp_ns)
        return self.estimator.pose @ se3.inverse(odometry)


@pytest.mark.parametrize('pause_s', [0.3, 3.0, 40.0])
def test_the_odometry_keeps_its_place_in_the_map(robot, pause_s):
    robot.drive(2.0)
    robot.pause()
    known = robot.estimator.pose_covariance
    robot.drive(pause_s, is_paused=True)
    assert robot.resume()
    assert robot.estimator.stamp_ns == robot.stamp_ns - STEP_NS
    assert_allclose(robot.odometry_in_map, se3.inverse(DRIFT), atol=1e-6)
    # How far the odometry may be off since is known, too.
    assert robot.estimator.pose_covariance[0, 0] >= known[0, 0]
    assert np.trace(robot.estimator.pose_covariance) > np.trace(known)
    assert not robot.estimator.dropped
    robot.drive(1.0)
    assert not robot.estimator.dropped
    assert robot.estimator.counts['rejected_landmark'] == 0


def test_a_robot_that_is_moved_while_it_is_paused_goes_on_from_there(robot):
    robot.drive(2.0)
    robot.pause()
    robot.drive(1.0, is_paused=True)
    given = se3.from_rpy((7.0, 1.0, 0.0, 0.0, 0.0, -1.0))
    robot.estimator.set_pose(given)
    robot.motion.note_move()
    robot.drive(2.0, is_paused=True)
    assert robot.resume()
    assert_allclose(robot.estimator.pose, given @ se3.exp(2.0 * V), atol=1e-6)


def test_without_odometry_on_tf_the_robot_is_where_it_was_paused(robot):
    robot.drive(2.0)
    robot.transforms.clear()
    robot.pause()
    before = robot.estimator.pose
    assert not robot.resume()
    assert_allclose(robot.estimator.pose, before)
