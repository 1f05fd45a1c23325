"""Velocities from pose differences or two sensors, and clocks that disagree."""

from __future__ import annotations

from contextlib import suppress

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from strategies import poses

from slam_observer_ros.common.errors import InvalidEventError
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.estimator.event_queue import EventQueue
from slam_observer_ros.events import (
    AngularVelocityEvent,
    Event,
    ObservationEvent,
    VelocityEvent,
)
from slam_observer_ros.lie import se3
from slam_observer_ros.models.motion_noise import MotionNoise
from slam_observer_ros.models.velocity_history import VelocityHistory
from slam_observer_ros.recordings.event_builder import PoseDifferences
from slam_observer_ros.runs.health import ClockOffset, SAMPLES
from slam_observer_ros.settings.estimator_settings import Settings

SECOND = 1_000_000_000
START_NS = 100 * SECOND
V = np.array([0.0, 0.0, 0.9, 1.0, 0.0, 0.0])


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
    for stamp_ns in (SECOND, 3 * SECOND):
        assert differences.add(stamp_ns, np.eye(4)) is None
    for stamp_ns in (3 * SECOND, SECOND // 2):
        with pytest.raises(InvalidEventError) as raised:
            differences.add(stamp_ns, np.eye(4))
        assert raised.value.reason == 'skipped_pose'


def driven(stamps_ns, poses):
    """Return the pose that velocities made of poses lead to, each held until the next one."""
    differences = PoseDifferences(SECOND)
    used, end_ns = [], stamps_ns[0]
    for stamp_ns, pose in zip(stamps_ns, poses, strict=True):
        with suppress(InvalidEventError):
            if (event := differences.add(stamp_ns, pose)) is not None:
                used.append(event)
                end_ns = stamp_ns
    moved = poses[0]
    ends_ns = [*(event.stamp_ns for event in used[1:]), end_ns]
    for event, until_ns in zip(used, ends_ns, strict=True):
        moved = moved @ se3.exp(event.body_velocity * (until_ns - event.stamp_ns) * 1e-9)
    return moved, used


BURST = 5
STAMPS = {
    'of a coarse clock': lambda k: k // 2 * 2,
    'of a very coarse clock': lambda k: k // 7 * 7,
    'in bursts': lambda k: k // BURST * BURST + k % BURST * 0.03,
    'in long bursts': lambda k: k // 10 * 10 + k % 10 * 0.05,
    'in bursts of one stamp': lambda k: k // BURST * BURST,
    'one too late': lambda k: k + 1.2 * (k % 10 == 4),
    'one far ahead': lambda k: k + 10_000 * (k == 57),
    'jittering': lambda k: k + 0.3 * (-1) ** k,
}


@pytest.mark.parametrize('stamps', STAMPS)
def test_no_motion_is_lost_and_no_speed_made_up_by_stamps(stamps):
    count, period_ns = 200, 20_000_000
    true = [se3.exp(V * k * 0.02) for k in range(count + 1)]
    stamps_ns = [START_NS + round(STAMPS[stamps](k) * period_ns) for k in range(count)]
    # One that is clearly later ends it.
    moved, used = driven([*stamps_ns, START_NS + (count + BURST) * period_ns], true)
    assert_allclose(moved, true[-1], atol=1e-9)
    later = [event for event in used if event.stamp_ns > START_NS + 50 * period_ns]
    assert max(np.linalg.norm(event.body_velocity[3:]) for event in later) < 2.6


def test_poses_after_a_clock_was_set_back_lead_on_from_the_first_that_shows_it():
    differences = PoseDifferences(SECOND)
    assert differences.add(START_NS, np.eye(4)) is None
    back_ns = START_NS - 60 * SECOND
    for count in range(4):
        with pytest.raises(InvalidEventError):
            differences.add(back_ns + count * SECOND // 50, np.eye(4))
    assert differences.add(back_ns + 4 * SECOND // 50, np.eye(4)) is None
    event = differences.add(back_ns + 5 * SECOND // 50, se3.exp(V / 50))
    assert_allclose(event.body_velocity, V, atol=1e-9)


@pytest.mark.parametrize('rate_hz', [10, 50, 1000])
@pytest.mark.parametrize('jump', [[0.0, 0.0, 0.0, 7.0, 2.0, 0.0], [0.0, 0.0, 3.0, -6.0, 0.0, 0.0]])
def test_an_odometry_that_was_reset_gives_no_velocity_from_before_to_after(rate_hz, jump):
    period_ns = SECOND // rate_hz
    differences = PoseDifferences(SECOND)
    before = se3.exp(np.array(jump))
    assert differences.add(START_NS, before) is None
    with pytest.raises(InvalidEventError, match='has jumped') as raised:
        differences.add(START_NS + period_ns, np.eye(4))
    assert raised.value.reason == 'pose_jump'
    moved = se3.exp(V / rate_hz)
    event = differences.add(START_NS + 2 * period_ns, moved)
    assert event.stamp_ns == START_NS + period_ns
    assert_allclose(event.body_velocity, V, atol=1e-9)


def test_what_a_robot_can_do_is_no_jump():
    differences = PoseDifferences(SECOND)
    fast = np.array([0.0, 0.0, 40.0, 40.0, 0.0, 0.0])
    differences.add(START_NS, np.eye(4))
    assert_allclose(
        differences.add(START_NS + SECOND // 50, se3.exp(fast / 50)).body_velocity, fast, atol=1e-9
    )


def wheels(time_s, velocity, covariance=None):
    stamp_ns = START_NS + round(time_s * SECOND)
    return VelocityEvent(stamp_ns, np.array(velocity, dtype=float), covariance)


def imu(time_s, turn, covariance=None):
    stamp_ns = START_NS + round(time_s * SECOND)
    return AngularVelocityEvent(stamp_ns, np.array(turn, dtype=float), covariance)


def history_of(events):
    """Return the history of events that were received in this order."""
    queue, history = EventQueue(10 * SECOND, 10 * SECOND, SECOND), VelocityHistory(SECOND)
    for event in events:
        queue.push(event)  # raises if it is a duplicate
    for event in queue.pop_all():
        history.append(event)
    return history


def held_for(history, *times_s):
    return history.held(*(START_NS + round(time_s * SECOND) for time_s in times_s))


def test_imu_replaces_the_angular_part_while_it_is_in_time():
    events = [imu(0.0, [0.0, 0.0, 0.5]), wheels(0.5, V), imu(0.6, [0.1, 0.0, 0.6])]
    history = history_of([*events, wheels(1.4, V), wheels(1.7, V)])
    held = held_for(history, 0.0, 2.0)
    assert_allclose(held.dt_s, [0.0, 0.1, 0.8, 0.3, 0.3], atol=1e-9)
    assert_allclose(held.gap_s, [0.5, 0.0, 0.0, 0.0, 0.0], atol=1e-9)
    assert_array_equal(held.body_velocities[1], [0.0, 0.0, 0.5, 1.0, 0.0, 0.0])
    assert_array_equal(held.body_velocities[2:4], [[0.1, 0.0, 0.6, 1.0, 0.0, 0.0]] * 2)
    assert_array_equal(held.body_velocities[4], V, 'the IMU has timed out')


def test_errors_of_two_sensors_have_nothing_to_do_with_each_other():
    history = VelocityHistory(SECOND)
    correlated = np.eye(6) + 0.5
    assert not history.append(AngularVelocityEvent(0, np.zeros(3), 0.01 * np.eye(3)))
    assert history.append(VelocityEvent(0, np.zeros(6), correlated))
    (covariance,) = history.held(0, SECOND // 10).covariances
    assert_array_equal(covariance[:3, :3], 0.01 * np.eye(3))
    assert_array_equal(covariance[3:, 3:], correlated[3:, 3:])
    assert not covariance[:3, 3:].any()
    assert not covariance[3:, :3].any()


def test_a_velocity_is_in_force_until_its_timeout_has_passed():
    history = VelocityHistory(SECOND)
    assert history.latest(0) is None
    assert history.append(VelocityEvent(5 * SECOND, np.ones(6)))
    assert history.latest(5 * SECOND - 1) is None
    for stamp_ns in (5 * SECOND, 6 * SECOND):
        assert_array_equal(history.latest(stamp_ns), np.ones(6))
    assert history.latest(6 * SECOND + 1) is None
    held = history.held(5 * SECOND, 8 * SECOND)
    assert (held.dt_s.sum(), held.gap_s.sum()) == (1.0, 2.0)


def test_an_imu_whose_covariance_is_zero_does_not_know_it():
    history = history_of([imu(0.0, [0.0, 0.0, 0.5], np.zeros((3, 3))), wheels(0.1, V)])
    assert not held_for(history, 0.1, 0.2).is_stated.any()
    history = history_of([imu(0.0, [0.0, 0.0, 0.5], np.eye(3)), wheels(0.1, V)])
    assert held_for(history, 0.1, 0.2).is_stated.tolist() == [[True, False]]


def test_an_imu_alone_is_no_velocity():
    history = VelocityHistory(SECOND)
    assert not history.append(imu(0.0, [0.0, 0.0, 1.0])), 'the wheels have not begun'
    assert history.append(wheels(0.1, V))
    for time_s in (0.5, 1.0, 1.5):
        history.append(imu(time_s, [0.0, 0.0, 1.0]))
    assert history.latest(START_NS + SECOND) is not None
    assert history.latest(START_NS + SECOND * 3 // 2) is None, 'the wheels have timed out'
    held = held_for(history, 0.1, 2.0)
    assert_allclose([held.dt_s.sum(), held.gap_s.sum()], [1.0, 0.9])


@pytest.mark.parametrize('is_imu_first', [False, True])
def test_both_parts_count_if_wheels_and_imu_have_the_same_stamps(is_imu_first):
    events = []
    for number, time_s in enumerate([0.0, 0.1, 0.2]):
        both = [imu(time_s, [0.0, 0.0, -number]), wheels(time_s, [9, 9, 9, number, 0, 0])]
        events += both if is_imu_first else both[::-1]
    held = held_for(history_of(events), 0.0, 0.3)
    moved = held.dt_s[:, None] * held.body_velocities
    expected = 0.1 * np.array([0.0, 0.0, -3.0, 3.0, 0.0, 0.0])
    assert_allclose(moved.sum(axis=0), expected, atol=1e-12)


@pytest.mark.parametrize('imu_rate_hz', [1, 10, 100])
def test_the_error_of_each_sensor_lasts_as_long_as_its_own_message_is_held(imu_rate_hz):
    of_wheels, of_imu = np.diag([9.0, 9.0, 9.0, 1.0, 2.0, 3.0]), np.diag([4.0, 5.0, 6.0])
    events: list[Event] = [wheels(n / 10, V, of_wheels) for n in range(10)]
    events += [imu(n / imu_rate_hz, [0.0, 0.0, 1.0], of_imu) for n in range(imu_rate_hz)]
    covariances = MotionNoise(Settings()).covariances(held_for(history_of(events), 0.0, 1.0))
    expected = [4 / imu_rate_hz, 5 / imu_rate_hz, 6 / imu_rate_hz, 0.1, 0.2, 0.3]
    assert_allclose(covariances.sum(axis=0), np.diag(expected), atol=1e-12)


@pytest.mark.parametrize('imu_knows', [False, True])
@pytest.mark.parametrize('wheels_know', [False, True])
def test_each_sensor_brings_its_own_covariance_or_has_the_parameters_noise(imu_knows, wheels_know):
    settings = Settings(angular_velocity_noise=(0.1,) * 3, linear_velocity_noise=(0.2,) * 3)
    events = [
        wheels(0.0, V, np.diag([9.0, 9.0, 9.0, 1.0, 1.0, 1.0]) if wheels_know else None),
        imu(0.0, [0.0, 0.0, 1.0], 0.25 * np.eye(3) if imu_knows else None),
    ]
    held = held_for(history_of(events), 0.0, 0.5)
    covariance = MotionNoise(settings).covariances(held).sum(axis=0)
    angular = 0.25 * 0.5**2 if imu_knows else 0.1**2 * 0.5
    linear = 1.0 * 0.5**2 if wheels_know else 0.2**2 * 0.5
    assert_allclose(covariance, np.diag([angular] * 3 + [linear] * 3), atol=1e-12)


@given(st.integers(0, 2**32 - 1))
def test_a_message_that_is_late_within_the_window_changes_not_a_bit(seed):
    rng = np.random.default_rng(seed)
    events: list[Event] = [wheels(n / 20, rng.normal(size=6)) for n in range(20)]
    events += [imu(n / 50, rng.normal(size=3)) for n in range(50)]
    points = rng.normal(size=(4, 3))
    events += [ObservationEvent(START_NS + n * SECOND // 4, np.arange(4), points) for n in (1, 2)]
    delays_s = 0.049 * rng.random(len(events))
    received = sorted(
        zip(events, delays_s, strict=True), key=lambda e: e[0].stamp_ns * 1e-9 + e[1]
    )
    in_order, late = (Estimator(Settings(reorder_window=0.05)) for _ in range(2))
    for event in sorted(events, key=lambda event: event.stamp_ns):
        assert in_order.add(event)
    for event, _ in received:
        assert late.add(event)
    in_order.flush()
    late.flush()
    assert_array_equal(late.pose, in_order.pose)
    assert_array_equal(late.pose_covariance, in_order.pose_covariance)


def test_wheels_later_than_the_window_still_move_the_robot_beside_an_imu():
    received = [
        (event.stamp_ns, event) for event in (imu(n / 50, np.zeros(3)) for n in range(100))
    ]
    straight = [wheels(n / 20, [0.0, 0.0, 0.0, 1.0, 0.0, 0.0]) for n in range(40)]
    received += [(event.stamp_ns + SECOND // 10 + 1, event) for event in straight]
    estimator = Estimator(Settings(reorder_window=0.05))
    for _, event in sorted(received, key=lambda pair: pair[0]):
        assert estimator.add(event)
    estimator.flush()
    assert_allclose(estimator.pose[0, 3], 1.98, atol=1e-6)
    assert estimator.dropped.total() == 0


def test_another_clock_is_found_and_corrected_once():
    clock = ClockOffset(SECOND)
    for index in range(SAMPLES):
        assert not clock.is_off
        clock.add(1000 * SECOND + index, 10 * SECOND + index)
    assert clock.is_off
    assert 'or set use_sim_time' in clock.problem('twist', is_simulated=False)
    assert 'use_sim_time' not in clock.problem('twist', is_simulated=True)
    assert clock.correction_ns == -990 * SECOND
    for index in range(SAMPLES):  # a delay that varies moves nothing
        clock.add(1000 * SECOND + index, 10 * SECOND + 2 * index)
    assert clock.correction_ns == -990 * SECOND
    for index in range(SAMPLES):  # the other machine sets its clock
        clock.add(1000 * SECOND + index, 1000 * SECOND + index)
    assert not clock.is_off
    assert clock.correction_ns == 0


@pytest.mark.parametrize('since_s', [0.0, 300.0, 100 * 86400.0])
def test_stamps_of_1970_are_named_as_such(since_s):
    """Of a driver that counts from its start, or of a simulation: neither is slow."""
    clock, now_ns = ClockOffset(SECOND), 1_800_000_000 * SECOND
    for index in range(SAMPLES):
        clock.add(round(since_s * SECOND) + index * SECOND, now_ns + index * SECOND)
    for is_simulated in (False, True):
        text = clock.problem("'/odom'", is_simulated)
        assert text.startswith("stamps on '/odom' are of 1970: ")
        assert 'correct_clock_offset' in text
        assert 'faster' not in text
        assert ('set use_sim_time' in text) != is_simulated
    assert clock.correction_ns == now_ns - round(since_s * SECOND)


def test_stamps_of_1970_are_right_where_the_clock_is_a_simulations():
    clock = ClockOffset(SECOND)
    for index in range(SAMPLES):
        clock.add(index * SECOND, index * SECOND + 1, is_simulated=True)
    assert not clock.problem("'/odom'", is_simulated=True)
    for index in range(SAMPLES):
        clock.add(index * SECOND, (index + 5) * SECOND, is_simulated=True)
    assert '1970' not in clock.problem("'/odom'", is_simulated=True)


def test_when_this_machines_clock_has_jumped_the_offset_is_found_again():
    clock = ClockOffset(SECOND)
    for index in range(SAMPLES):
        clock.add(1000 * SECOND + index, 10 * SECOND + index)
    clock.clear()
    for index in range(SAMPLES):
        assert (clock.offset_ns, clock.correction_ns) == (None, 0)
        clock.add(1000 * SECOND + index, 1000 * SECOND + index)
    assert clock.offset_ns == 0


@pytest.mark.parametrize(('ahead_s', 'is_simulated', 'is_off'), [
    (0.4, False, True), (0.06, False, True), (0.03, False, False), (-0.4, False, False),
    (0.4, True, False), (1.1, True, True),
])  # fmt: skip
def test_stamps_of_the_future_are_of_another_clock(ahead_s, is_simulated, is_off):
    """A message can be late, but not early; /clock, though, only comes every now and then."""
    clock = ClockOffset(SECOND)
    for index in range(SAMPLES):
        receive_ns = START_NS + index * SECOND
        clock.add(receive_ns + round(ahead_s * SECOND), receive_ns, is_simulated)
    assert clock.is_off == is_off
    text = clock.problem("'/landmarks'", is_simulated)
    assert (f"'/landmarks' are {ahead_s:.3f} s ahead of this machine's clock" in text) == is_off
    assert clock.correction_ns == (-round(ahead_s * SECOND) if is_off else 0)


@pytest.mark.parametrize('straggler_s', [5, -5])
def test_single_stragglers_are_not_another_clock(straggler_s):
    clock = ClockOffset(SECOND)
    for index in range(3 * SAMPLES):
        delay = straggler_s * SECOND if index % 3 == 0 else 0
        clock.add(index * SECOND, index * SECOND + delay)
    assert not clock.is_off
    assert clock.correction_ns == 0
