"""Velocities from pose differences or two sensors, and clocks that disagree."""

from __future__ import annotations

from hypothesis import given
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from strategies import poses

from slam_observer_ros.clock_offset import ClockOffset, SAMPLES
from slam_observer_ros.event_queue import EventQueue
from slam_observer_ros.events import VelocityEvent
from slam_observer_ros.geometry import se3
from slam_observer_ros.velocity_history import VelocityHistory
from slam_observer_ros.velocity_sources import AngularReplacement, PoseDifferences

SECOND = 1_000_000_000


@given(poses())
def test_velocity_from_poses_leads_from_one_to_the_next(start):
    V = np.array([0.3, -0.1, 0.5, 1.0, 2.0, -0.5])
    end = start @ se3.exp(V * 0.5)
    differences = PoseDifferences(SECOND)
    assert differences.add(SECOND, start) is None
    event = differences.add(SECOND + SECOND // 2, end)
    assert event.stamp_ns == SECOND
    assert_allclose(start @ se3.exp(event.body_velocity * 0.5), end, rtol=1e-6, atol=1e-6)


def test_poses_far_apart_or_in_wrong_order_give_no_velocity():
    differences = PoseDifferences(SECOND)
    for stamp_ns in (SECOND, 3 * SECOND, 3 * SECOND, 2 * SECOND):
        assert differences.add(stamp_ns, np.eye(4)) is None


def test_imu_replaces_the_angular_part_while_it_is_in_time():
    joined = AngularReplacement(SECOND)
    wheels = VelocityEvent(SECOND, np.array([0.0, 0.0, 0.9, 1.0, 0.0, 0.0]), np.eye(6))
    assert joined.add_angular(SECOND - 1, np.array([0.0, 0.0, 0.5]), np.eye(3) * 0.1) is None
    event = joined.add_velocity(wheels)
    assert_array_equal(event.body_velocity, [0.0, 0.0, 0.5, 1.0, 0.0, 0.0])
    assert_array_equal(np.diag(event.covariance), [0.1, 0.1, 0.1, 1.0, 1.0, 1.0])

    event = joined.add_angular(SECOND + 5, np.array([0.1, 0.0, 0.6]), None)
    assert event.stamp_ns == SECOND + 5
    assert_array_equal(event.body_velocity, [0.1, 0.0, 0.6, 1.0, 0.0, 0.0])
    assert event.covariance is None, 'half a covariance is none'

    late = VelocityEvent(3 * SECOND, wheels.body_velocity)
    assert joined.add_velocity(late) is late, 'the IMU has timed out'
    assert joined.add_angular(5 * SECOND, np.zeros(3), None) is None, 'the wheels have'


@pytest.mark.parametrize('is_imu_first', [False, True])
def test_both_parts_count_if_wheels_and_imu_have_the_same_stamps(is_imu_first):
    joined, history = AngularReplacement(SECOND), VelocityHistory(SECOND)
    queue = EventQueue(SECOND, 10 * SECOND, SECOND)
    stamps_ns = [SECOND, SECOND + SECOND // 10, SECOND + SECOND // 5]
    for number, stamp_ns in enumerate(stamps_ns):
        wheels = VelocityEvent(stamp_ns, np.array([9.0, 9.0, 9.0, number, 0.0, 0.0]))
        turn = np.array([0.0, 0.0, -number])
        for is_imu in (is_imu_first, not is_imu_first):
            event = (
                joined.add_angular(stamp_ns, turn, None) if is_imu else joined.add_velocity(wheels)
            )
            if event is not None:
                queue.push(event)  # raises if it is a duplicate
    for event in queue.pop_all():
        history.append(event)
    for number, stamp_ns in enumerate(stamps_ns):
        expected = [0.0, 0.0, -number, number, 0.0, 0.0]
        assert_array_equal(history.latest(stamp_ns + 1), expected)


def test_another_clock_is_found_and_corrected_once():
    clock = ClockOffset(SECOND)
    for index in range(SAMPLES):
        assert not clock.is_off
        clock.add(1000 * SECOND + index, 10 * SECOND + index)
    assert clock.is_off
    assert clock.correction_ns == -990 * SECOND
    for index in range(SAMPLES):  # a delay that varies moves nothing
        clock.add(1000 * SECOND + index, 10 * SECOND + 2 * index)
    assert clock.correction_ns == -990 * SECOND
    for index in range(SAMPLES):  # the other machine sets its clock
        clock.add(1000 * SECOND + index, 1000 * SECOND + index)
    assert not clock.is_off
    assert clock.correction_ns == 0


def test_single_stragglers_are_not_another_clock():
    clock = ClockOffset(SECOND)
    for index in range(3 * SAMPLES):
        delay = 5 * SECOND if index % 3 == 0 else 0
        clock.add(index * SECOND, index * SECOND + delay)
    assert not clock.is_off
    assert clock.correction_ns == 0
