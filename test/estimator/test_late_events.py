"""Events that come late or in another order: which are used, and as of when."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import Mock

from estimator_runs import (
    assert_same_state,
    BODY_VELOCITY,
    drive,
    GAINS,
    LANDMARKS,
    observation,
    run,
    START_NS,
    true_pose,
    velocity,
)
import gain_worlds
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
import numpy as np
import pytest

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.estimator.placement import make_gains
from slam_observer_ros.estimator.timeline import carried_forward, MAX_PENDING_VELOCITIES, Timeline
from slam_observer_ros.events import AngularVelocityEvent, ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.models.observation_noise import ObservationNoise
from slam_observer_ros.models.velocity_history import VelocityHistory
from slam_observer_ros.runs.metrics import average_nees, pose_errors
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.tracking.hypotheses import Hypotheses
from slam_observer_ros.tracking.state import State
from slam_observer_ros.tracking.step import step as take_step


@hypothesis_settings(max_examples=20)
@given(st.randoms(use_true_random=False))
def test_events_shuffled_within_the_window_give_the_same_bits(random):
    events = drive()
    arrivals = {id(event): event.stamp_ns + random.randrange(200_000_000) for event in events}
    shuffled = sorted(events, key=lambda event: arrivals[id(event)])
    assert_same_state(run(shuffled, reorder_window=0.2), run(events, reorder_window=0.2))


def test_an_observation_later_than_the_window_is_carried_forward():
    events = [velocity(0.05 * step) for step in range(41)]
    events += [observation(2.0), observation(1.2, [4]), velocity(2.05)]
    estimator = run(events, reorder_window=0.0)
    assert estimator.counts['late_observation'] == 1
    np.testing.assert_allclose(estimator.world_points, LANDMARKS, atol=1e-9)


def test_an_observation_may_be_as_late_as_is_asked_for_and_takes_the_estimate_back_nowhere():
    events = [velocity(0.1 * step) for step in range(100)]
    events += [observation(9.5, []), observation(0.5)]
    estimator = Estimator(Settings(confirmations=1, reorder_window=0.0, late_limit=10.0))
    for event in events:
        assert estimator.add(event)
    assert estimator.stamp_ns == START_NS + round(9.9e9)
    np.testing.assert_allclose(estimator.pose, true_pose(9.9), atol=1e-9)
    np.testing.assert_allclose(estimator.world_points, LANDMARKS, atol=1e-9)


def test_a_velocity_later_than_the_window_counts_from_then_on():
    fast, faster = np.array([0.0, 0, 0, 1, 0, 0]), np.array([0.0, 0, 0, 2, 0, 0])
    events = [velocity(0.0, 0 * fast), observation(1.0), velocity(0.9, faster)]
    estimator = run([*events, velocity(0.8, fast), observation(1.5, [])], reorder_window=0.0)
    np.testing.assert_allclose(estimator.pose[:3, 3], [1.0, 0.0, 0.0], atol=1e-9)
    assert estimator.counts['late_velocity'] == 1
    assert estimator.dropped == {'too_late': 1}, 'a newer velocity was known before it'


def test_a_velocity_that_is_late_is_used_though_a_newer_one_of_a_gyroscope_was_before():
    gyroscope = AngularVelocityEvent(START_NS + 10**9, BODY_VELOCITY[:3])
    estimator = run([velocity(0.0), gyroscope, velocity(0.9)], reorder_window=0.0)
    assert estimator.counts['late_velocity'] == 1
    assert not estimator.dropped


def test_an_observation_without_points_makes_no_velocity_late():
    stop = velocity(0.5, np.zeros(6))
    events = [velocity(0.0), observation(1.0, []), stop, observation(1.5, [])]
    estimator = run(events, reorder_window=0.0, velocity_timeout=5.0)
    assert not estimator.counts['late_velocity']
    np.testing.assert_allclose(estimator.pose, true_pose(0.5), atol=1e-9)


def test_an_idle_sensor_whose_clock_is_ahead_makes_no_velocity_late():
    """However many come: they are used as they change, and not as of its stamps."""
    events, x_m = [], 0.0
    for step in range(4 * MAX_PENDING_VELOCITIES):
        speed = 1.0 if step % 20 < 10 else -0.5
        x_m += 0.02 * speed
        events.append(velocity(0.02 * step, [0, 0, 0, speed, 0, 0]))
        events.append(observation(0.02 * step + 0.5, []))
    estimator = run([*events, velocity(0.02 * len(events) / 2, np.zeros(6))], reorder_window=0.0)
    assert not estimator.counts['late_velocity']
    np.testing.assert_allclose(estimator.pose[0, 3], x_m, atol=1e-9)


def test_a_velocity_older_than_the_first_observation_counts_from_that_on():
    events = [observation(2.0), velocity(1.4), observation(2.3, [])]
    estimator = run(events, reorder_window=0.0, velocity_timeout=0.5)
    assert estimator.counts['late_velocity'] == 1
    np.testing.assert_allclose(estimator.pose, true_pose(0.3), atol=1e-9)


def test_however_many_velocities_come_late_no_motion_counts_twice():
    events = [velocity(0.0), observation(0.4, [])]
    events += [velocity(0.001 * step) for step in range(1, 3 * MAX_PENDING_VELOCITIES)]
    estimator = run(events, reorder_window=0.0)
    np.testing.assert_allclose(estimator.pose, true_pose(0.4), atol=1e-9)


@pytest.mark.parametrize('are_given', [False, True])
@pytest.mark.parametrize('m', [1, 3])
def test_an_observation_carried_forward_is_as_uncertain_as_the_motion_since(m, are_given):
    """However many points share its error: they don't average it down."""
    settings = Settings(
        observation_model='cartesian',
        point_noise=0.1,
        angular_velocity_noise=(0.0, 0.0, 0.2),
        linear_velocity_noise=(0.3, 0.0, 0.0),
    )
    timeline = Timeline(Hypotheses(State(make_gains(settings, np.eye(4)), settings)), settings)
    turning = np.array([0.0, 0.0, 1e-9, 0.0, 0.0, 0.0])
    for step in range(21):
        timeline.append(velocity(0.1 * step, turning))
    timeline.catch_up()
    given_m2 = np.tile(0.01 * np.eye(3), (m, 1, 1)) if are_given else None
    points = np.tile([5.0, 0.0, 0.0], (m, 1))
    carried = timeline.synchronise(
        ObservationEvent(START_NS + 10**9, np.arange(m), points, given_m2)
    )
    expected = 0.01 * np.eye(3) + m * np.diag([0.3, 5.0 * 0.2, 0.0]) ** 2
    np.testing.assert_allclose(carried.covariances[0], expected, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize('is_estimated', [False, True])
@pytest.mark.parametrize('turn_rad', [0.0, 1.0])
def test_a_landmark_that_has_moved_on_is_as_uncertain_as_it_was_when_seen(turn_rad, is_estimated):
    still = (0.0,) * 3
    settings = Settings(
        observation_model='stereo',
        angular_velocity_noise=still,
        linear_velocity_noise=still,
        landmark_velocity_stddev=0.5 * is_estimated,
    )
    hypotheses = Hypotheses(State(make_gains(settings, np.eye(4)), settings))
    timeline = Timeline(hypotheses, settings)
    turning = np.array([0.0, 0.0, turn_rad / 0.9, 0.0, 0.0, 0.0])
    for step in range(11):
        timeline.append(velocity(0.1 * step, turning))
    timeline.catch_up()
    seen, speed = np.array([[5.0, 0.0, 0.0]]), np.array([[4.0, 0.0, 0.0]])
    event = ObservationEvent(START_NS + 10**8, np.array([1]), seen, velocities=speed)
    if is_estimated:
        take_step(hypotheses, timeline.synchronise, replace(event, stamp_ns=timeline.state_ns))
        hypotheses.best.observer.u[0] = so3.exp(0.1 * turning[:3]) @ speed[0]
        event = replace(event, velocities=None)
    carried = timeline.synchronise(event)
    R = so3.exp(np.array([0.0, 0.0, turn_rad]))
    np.testing.assert_allclose(carried.points, (seen + 0.9 * speed) @ R, atol=1e-9)
    expected = R.T @ ObservationNoise(settings).at(seen) @ R
    expected = expected + (0.9 * settings.landmark_velocity_stddev) ** 2 * np.eye(3)
    np.testing.assert_allclose(carried.covariances, expected, rtol=1e-6)


def test_landmarks_that_are_always_seen_late_are_not_drawn_towards_the_robot():
    """A stereo camera that measures one too near must not be believed more for that."""
    stereo = Settings(
        observation_model='stereo',
        angular_velocity_noise=(1e-4,) * 3,
        linear_velocity_noise=(1e-4,) * 3,
        reorder_window=0.0,
    )
    directions = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0]])
    share = 0.12  # of the range is the standard deviation there
    parallax = stereo.disparity_noise / (stereo.focal_length * stereo.stereo_baseline)
    range_m, noise, others = share / parallax, np.random.default_rng(0), np.array([99])
    estimators = {is_late: Estimator(stereo) for is_late in (False, True)}
    for step in range(60):
        stamp_ns = START_NS + step * 10**8
        scales = 1.0 + share * noise.normal(size=(4, 1))
        seen = ObservationEvent(stamp_ns, np.arange(4), range_m * scales * directions)
        newer = ObservationEvent(stamp_ns + 10**7, others, np.ones((1, 3)))
        for is_late, estimator in estimators.items():
            estimator.add(VelocityEvent(stamp_ns, np.zeros(6)))
            for event in (newer, seen) if is_late else (seen, newer):
                estimator.add(event)
    assert estimators[True].counts['late_observation'] == 60

    def mean_range_m(estimator):
        found = estimator.world_points[np.isin(estimator.landmark_ids, np.arange(4))]
        return np.linalg.norm(found - estimator.pose[:3, 3], axis=1).mean()

    in_time, late = mean_range_m(estimators[False]), mean_range_m(estimators[True])
    np.testing.assert_allclose(late, in_time, rtol=5e-3)


def test_empty_observations_make_no_others_late():
    settings, noise = Settings(reorder_window=0.0), np.random.default_rng(0)
    alone, beside_empty_ones = Estimator(settings), Estimator(settings)
    waiting: list[ObservationEvent] = []
    for step in range(300):
        stamp_ns = START_NS + 10**7 * step
        for estimator in (alone, beside_empty_ones):
            estimator.add(VelocityEvent(stamp_ns, BODY_VELOCITY))
        beside_empty_ones.add(ObservationEvent(stamp_ns, np.empty(0, int), np.empty((0, 3))))
        if step % 50 == 10:
            seen = se3.transform(se3.inverse(true_pose(0.01 * step)), LANDMARKS)
            seen += 0.02 * noise.normal(size=seen.shape)
            waiting.append(ObservationEvent(stamp_ns, np.arange(5), seen))
        if step % 50 == 40:
            for estimator in (alone, beside_empty_ones):
                estimator.add(waiting[-1])
    assert beside_empty_ones.counts['observation'] == 306
    for estimator in (alone, beside_empty_ones):
        assert estimator.counts['late_observation'] == 6, 'those that waited, none of the empty'
    np.testing.assert_array_equal(beside_empty_ones.pose, alone.pose)
    np.testing.assert_array_equal(beside_empty_ones.pose_covariance, alone.pose_covariance)


@pytest.mark.parametrize('two_d_mode', [False, True])
def test_observations_that_come_late_among_others_leave_the_covariance_honest(two_d_mode):
    settings = Settings(
        two_d_mode=two_d_mode, reorder_window=0.0, observation_model='cartesian', point_noise=0.02
    )
    errors, covariances = [], []
    for seed in range(4):
        world = gain_worlds.drive(settings, 20.0, seed, seen=3)
        late = {id(event) for event in world.observations()[1::2]}
        arrivals = {
            id(event): event.stamp_ns + 1.9e9 * (id(event) in late) for event in world.events
        }
        estimator = Estimator(settings)
        for event in sorted(world.events, key=lambda event: arrivals[id(event)]):
            estimator.add(event)
            if isinstance(event, ObservationEvent) and event.stamp_ns % (5 * 10**9) == 0:
                truth = world.true_pose(estimator.stamp_ns)
                errors.append(pose_errors(estimator.pose, truth))
                covariances.append(estimator.pose_covariance)
        assert estimator.counts['late_observation'] > 30
    assert average_nees(np.array(errors), np.array(covariances)) < 2.0


@pytest.mark.parametrize('gains', GAINS)
def test_two_sensors_that_see_at_one_instant_are_none_of_them_late(gains):
    estimator = Estimator(Settings(gains=gains, reorder_window=0.0))
    for step in range(5):
        stamp_ns = START_NS + step * 10**8
        estimator.add(VelocityEvent(stamp_ns, np.zeros(6)))
        for ids in (np.arange(3), np.arange(2, 5)):
            assert estimator.add(ObservationEvent(stamp_ns, ids, LANDMARKS[ids]))
    assert estimator.counts['observation'] == 10
    assert estimator.counts['late_observation'] == estimator.counts['late_velocity'] == 0


def test_an_event_later_than_the_limit_is_refused():
    events = [velocity(0.05 * step) for step in range(100)] + [observation(1.0)]
    estimator = run(events, reorder_window=0.1, late_limit=1.0)
    assert estimator.dropped == {'too_late': 1}
    assert len(estimator.landmark_ids) == 0


def test_a_velocity_later_than_the_limit_is_refused():
    events = [velocity(0.0), observation(1.0), observation(2.0), velocity(0.5)]
    assert run(events, reorder_window=0.1, late_limit=1.5).counts['late_velocity'] == 1
    assert run(events, reorder_window=0.1, late_limit=1.3).dropped == {'too_late': 1}


def test_a_late_observation_is_judged_by_where_its_landmarks_are_by_now():
    settings = Settings(confirmations=1)
    state = State(make_gains(settings, np.eye(4)), settings)
    event = observation(0.0, [0, 1])
    take_step(Hypotheses(state), lambda seen: seen, event)
    state.observer.body_points = Mock(return_value=event.points)
    velocities = VelocityHistory(timeout_ns=10**9)
    velocities.append(velocity(0.0, np.zeros(6)))
    carried_forward(state, event, velocities, event.stamp_ns + 10**8)
    np.testing.assert_array_equal(state.observer.body_points.call_args.args[0], [0, 1])


def test_landmarks_that_always_come_after_their_velocities_are_counted_as_late():
    estimator = Estimator(Settings())
    for step in range(100):
        estimator.add(velocity(0.05 * step))
        if step >= 20:
            estimator.add(observation(0.05 * step - 1.0))
    estimator.flush()
    assert estimator.counts['late_observation'] == estimator.counts['observation'] == 80
