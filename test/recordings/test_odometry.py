"""The twist of an odometry is held against its poses: both are in one message."""

from __future__ import annotations

import numpy as np
import pytest

from slam_observer_ros.events import VelocityEvent
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.messages.poses import PoseMessage
from slam_observer_ros.recordings.event_builder import OdometryCheck

PERIOD_NS = 20_000_000


def message(stamp_ns, pose):
    quaternion = so3.to_quaternion(pose[:3, :3])
    return PoseMessage(stamp_ns, 'odom', 'base_link', pose[:3, 3], quaternion)


def checked(twist_of, seconds=60.0, heading=0.0, noise=0.0, seed=1):
    """Return the check of a drive of curves, with twists that are made of the true ones."""
    rng = np.random.default_rng(seed)
    check, pose = OdometryCheck(), se3.from_rpy((5.0, -3.0, 0.0, 0.0, 0.0, heading))
    for number in range(round(50 * seconds)):
        time_s = 0.02 * number
        V = np.array([0.0, 0.0, 0.4 * np.sin(0.3 * time_s), 0.5 + 0.2 * np.sin(time_s), 0.0, 0.0])
        seen = pose.copy()
        seen[:2, 3] += noise * rng.standard_normal(2)
        stamp_ns = number * PERIOD_NS
        check.add(message(stamp_ns, seen), VelocityEvent(stamp_ns, twist_of(V, pose)))
        pose = pose @ se3.exp(0.02 * V)
    return check


def in_odom_axes(V, pose):
    return np.r_[V[:3], pose[:3, :3] @ V[3:]]


@pytest.mark.parametrize('heading', [0.0, 2.0])
def test_a_twist_along_the_axes_of_the_poses_frame_is_recognised(heading):
    check = checked(in_odom_axes, heading=heading)
    assert check.is_decided
    assert check.problem == "is along the axes of 'odom' by its poses, not of child_frame_id"


@pytest.mark.parametrize(
    ('wrong', 'what'),
    [
        (lambda V, _: V * [1, 1, 1, 100, 100, 100], 'way'),
        (lambda V, _: V * [1, 1, 1, -1, -1, -1], 'way'),
        (lambda V, _: V[[0, 1, 2, 4, 3, 5]], 'way'),
        (lambda V, _: V * [1, 1, -1, 1, 1, 1], 'turn'),
        (lambda V, _: V * [1, 1, 57.3, 1, 1, 1], ''),
    ],
)  # fmt: skip
def test_units_signs_and_axes_that_are_wrong_are_said(wrong, what):
    problem = checked(wrong).problem
    assert problem.startswith('does not say the')
    assert what in problem


@pytest.mark.parametrize('noise', [0.0, 0.005])
def test_a_twist_that_is_noisy_or_slips_a_little_is_right(noise):
    rng = np.random.default_rng(0)

    def noisy(V, _pose):
        return V * [1, 1, 0.9, 1.15, 1, 1] + 0.05 * rng.standard_normal(6) * [0, 0, 1, 1, 1, 0]

    check = checked(noisy, heading=1.0, noise=noise)
    assert check.is_decided
    assert check.problem == ''


def test_poses_that_nobody_fills_in_say_nothing():
    check = OdometryCheck()
    for number in range(1000):
        V = np.array([0.0, 0.0, 0.1, 1.0, 0.0, 0.0])
        check.add(message(number * PERIOD_NS, np.eye(4)), VelocityEvent(number * PERIOD_NS, V))
    assert check.problem == ''


def test_nothing_is_said_of_a_robot_that_stands_or_whose_poses_are_reset():
    check = checked(lambda V, _pose: 0.0 * V, seconds=0.1)
    assert (check.problem, check.is_decided) == ('', False)
    check, pose, V = OdometryCheck(), np.eye(4), np.array([0.0, 0.0, 0.5, 1.0, 0.0, 0.0])
    for number in range(1000):
        if number % 40 == 20:
            pose = se3.from_rpy((100.0 * number, 0.0, 0.0, 0.0, 0.0, 1.0))
        stamp_ns = number * PERIOD_NS
        check.add(message(stamp_ns, pose), VelocityEvent(stamp_ns, V))
        pose = pose @ se3.exp(0.02 * V)
    assert check.problem == ''
