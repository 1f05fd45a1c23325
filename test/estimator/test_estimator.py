"""The estimator: order, lateness, gaps, landmark life cycle, and refusal of bad events."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import Mock

import gain_worlds
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

from slam_observer_ros.association.hypotheses import Hypotheses
from slam_observer_ros.common.errors import MapError, ParameterError
from slam_observer_ros.common.stamps import AGREEING_STAMPS
from slam_observer_ros.estimates import used_points
from slam_observer_ros.estimator import event_warnings
from slam_observer_ros.estimator.checks import MAX_MEASURED
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.estimator.timeline import MAX_PENDING_VELOCITIES, Timeline
from slam_observer_ros.evaluation.consistency import average_nees
from slam_observer_ros.evaluation.metrics import pose_errors
from slam_observer_ros.evaluation.trajectory import PoseTruth
from slam_observer_ros.events import (
    AngularVelocityEvent,
    FIRST_AUTOMATIC_ID,
    IMPOSSIBLE_ID,
    LAST_AUTOMATIC_ID,
    ObservationEvent,
    queued,
    UNKNOWN_ID,
    VelocityEvent,
)
from slam_observer_ros.geometry import se3, so3
from slam_observer_ros.known_map.landmark_map import LandmarkMap
from slam_observer_ros.observer.designs import make_gains
from slam_observer_ros.sensor_models.observation_noise import ObservationNoise
from slam_observer_ros.sensor_models.velocity_history import VelocityHistory
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.state import step as state_step
from slam_observer_ros.state.late_observation import carried_forward
from slam_observer_ros.state.matching import match
from slam_observer_ros.state.state import State

GAINS = ('constant', 'scheduled', 'riccati')
START_NS = 1_700_000_000_000_000_000
LANDMARKS = np.array([[4.0, 0, 0], [-4, 0, 1], [0, 4, 0.5], [1, -4, 0], [2, 2, 2]])
BODY_VELOCITY = np.array([0.05, -0.1, 0.3, 1.0, 0.1, -0.05])


def true_pose(time_s):
    return se3.exp(BODY_VELOCITY * time_s)


def velocity(time_s, body_velocity=BODY_VELOCITY):
    return VelocityEvent(START_NS + round(time_s * 1e9), np.array(body_velocity, dtype=float))


def observation(time_s, ids=range(5), noise=None):
    rows = np.array(list(ids), dtype=np.int64)
    points = se3.transform(se3.inverse(true_pose(time_s)), LANDMARKS[rows])
    if noise is not None:
        points = points + noise.normal(scale=0.05, size=points.shape)
    return ObservationEvent(START_NS + round(time_s * 1e9), rows, points)


def run(events, **changes):
    """Run events; landmarks are in the map from their first sighting unless changed."""
    estimator = Estimator(Settings(**{'confirmations': 1, **changes}))
    for event in events:
        estimator.add(event)
    estimator.flush()
    return estimator


def drive(duration_s=4.0, noise_seed=0):
    """A drive with velocities at 20 Hz and noisy observations at 10 Hz, in stamp order."""
    noise = np.random.default_rng(noise_seed)
    events = []
    for step in range(round(duration_s * 20)):
        events.append(velocity(0.05 * step))
        if step % 2 == 1:
            seen = noise.permutation(5)[: noise.integers(0, 5)]
            events.append(observation(0.05 * step, seen, noise))
    return events


def assert_same_state(one, other):
    assert one.stamp_ns == other.stamp_ns
    np.testing.assert_array_equal(one.pose, other.pose)
    np.testing.assert_array_equal(one.landmark_ids, other.landmark_ids)
    np.testing.assert_array_equal(one.world_points, other.world_points)


def test_first_sight_initialises_a_landmark_from_the_current_pose():
    estimator = run([velocity(0.0), observation(1.0, [2])], velocity_timeout=5.0)
    np.testing.assert_allclose(estimator.world_points, LANDMARKS[[2]], atol=1e-9)
    np.testing.assert_allclose(estimator.pose, true_pose(1.0), atol=1e-9)


def test_what_leaves_the_plane_does_not_count_in_planar_mode():
    estimator = run([velocity(0.0), observation(0.5)], two_d_mode=True)
    np.testing.assert_array_equal(estimator.body_velocity, BODY_VELOCITY * [0, 0, 1, 1, 1, 0])
    np.testing.assert_array_equal(estimator.pose[2], [0.0, 0.0, 1.0, 0.0])
    np.testing.assert_array_equal(estimator.world_points[:, 2], np.zeros(5))


def test_without_observations_the_state_is_moved_on_all_the_same():
    moves = []
    estimator = Estimator(
        Settings(reorder_window=0.0), on_motion=lambda _, start_ns, end_ns: moves.append(end_ns)
    )
    for step in range(1 + 3 * MAX_PENDING_VELOCITIES):
        estimator.add(VelocityEvent(START_NS + step * 10**7, np.zeros(6)))
    assert len(moves) == 3


def test_a_landmark_is_in_the_map_once_it_was_seen_often_enough():
    events = [velocity(0.0), *(observation(0.1 * step, [2]) for step in range(3))]
    assert len(run(events[:3], confirmations=3).landmark_ids) == 0
    np.testing.assert_allclose(
        run(events, confirmations=3).world_points, LANDMARKS[[2]], atol=1e-9
    )


def test_seen_again_a_landmark_corrects_the_drift_of_the_velocity():
    wrong = BODY_VELOCITY * [1, 1, 0.5, 1.1, 1, 1]
    events = [observation(0.0)]
    for step in range(200):
        events.append(velocity(0.05 * step, wrong))
        events.append(observation(0.05 * step + 0.05))
    drifted = run([event for event in events if isinstance(event, VelocityEvent)])
    corrected = run(events)
    error = np.linalg.norm(corrected.pose[:3, 3] - true_pose(10.0)[:3, 3])
    assert error < 0.25 * np.linalg.norm(drifted.pose[:3, 3] - true_pose(9.95)[:3, 3])


@hypothesis_settings(max_examples=20)
@given(st.randoms(use_true_random=False))
def test_events_shuffled_within_the_window_give_the_same_bits(random):
    events = drive()
    arrivals = {id(event): event.stamp_ns + random.randrange(200_000_000) for event in events}
    shuffled = sorted(events, key=lambda event: arrivals[id(event)])
    assert_same_state(run(shuffled, reorder_window=0.2), run(events, reorder_window=0.2))


@pytest.mark.parametrize('gains', GAINS)
def test_a_residual_is_how_far_a_landmark_is_seen_from_where_the_map_has_it(gains):
    settings = Settings(gains=gains, confirmations=1, reorder_window=0.0)
    estimator = Estimator(settings, initial_pose=true_pose(3.0))
    compared = 0
    for event in drive():
        pose, expected = estimator.pose_at(event.stamp_ns), np.full((5, 3), np.nan)
        expected[estimator.landmark_ids] = estimator.world_points
        estimator.add(event)
        if isinstance(event, ObservationEvent):
            off = se3.transform(pose, event.points) - expected[event.ids]
            known = np.isfinite(off[:, 0])
            assert_array_equal(estimator.last_update.ids, event.ids[known])
            np.testing.assert_allclose(estimator.last_update.residuals, off[known], atol=1e-9)
            compared += np.sum(known)
    assert compared > 50


def test_asking_for_the_pose_never_changes_the_estimate():
    asked = Estimator(Settings(confirmations=1))
    for event in drive():
        asked.add(event)
        _ = asked.pose, asked.pose_at(event.stamp_ns + 123_456_789), asked.body_velocity
    asked.flush()
    assert_same_state(asked, run(drive()))


def test_long_stretches_of_velocity_move_the_state_on_and_stay_exact():
    estimator = run([velocity(0.01 * step) for step in range(1001)])
    np.testing.assert_allclose(estimator.pose, true_pose(10.0), atol=1e-9)


def test_velocities_of_long_ago_are_not_kept():
    estimator = Estimator(Settings(reorder_window=0.0))
    for step in range(20_000):
        estimator.add(VelocityEvent(START_NS + step * 10**7, np.zeros(6)))
    assert len(estimator._timeline.velocities.flat().stamps_ns) < 5_000


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
        timeline.append(queued(velocity(0.1 * step, turning)))
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
        timeline.append(queued(velocity(0.1 * step, turning)))
    timeline.catch_up()
    seen, speed = np.array([[5.0, 0.0, 0.0]]), np.array([[4.0, 0.0, 0.0]])
    event = ObservationEvent(START_NS + 10**8, np.array([1]), seen, velocities=speed)
    if is_estimated:
        hypotheses.observe(replace(event, stamp_ns=timeline.state_ns))
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


@pytest.mark.parametrize('gains', ['riccati', 'scheduled', 'constant'])
def test_pose_and_covariance_lead_on_along_the_velocities_together(gains):
    estimator = Estimator(Settings(reorder_window=0.0, gains=gains))
    turning = np.array([0.1, 0.0, 0.4, 1.0, 0.1, 0.0])
    for event in (velocity(0.0, turning), observation(0.1), velocity(0.15, turning)):
        estimator.add(event)
        pose, covariance = estimator.uncertain_pose
        np.testing.assert_array_equal(pose, estimator.pose)
        np.testing.assert_array_equal(covariance, estimator.pose_covariance)
        at_stamp = estimator.pose_at(estimator.stamp_ns)
        np.testing.assert_allclose(pose, at_stamp, rtol=0, atol=1e-14)


def test_an_update_is_of_the_state_at_its_stamp_and_stamps_never_go_back():
    reported = []
    estimator = Estimator(
        Settings(reorder_window=0.0), on_update=lambda update: reported.append(update.stamp_ns)
    )
    for event in (velocity(0.0), observation(0.1), observation(0.5, []), observation(0.2)):
        estimator.add(event)
    assert [stamp_ns - START_NS for stamp_ns in reported] == [10**8, 10**8, 2 * 10**8]
    assert estimator.stamp_ns == START_NS + 5 * 10**8


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


def test_with_constant_gains_a_second_camera_of_the_same_stamps_corrects_the_map():
    estimator = Estimator(Settings(gains='constant'))
    points = LANDMARKS.copy()
    points[3:] += 0.3
    for step in range(400):
        stamp_ns = START_NS + 50_000_000 * step
        for ids in (np.arange(3), np.arange(3, 5)):
            estimator.add(ObservationEvent(stamp_ns, ids, points[ids]))
        points = LANDMARKS
    seen = se3.transform(se3.inverse(estimator.pose), estimator.world_points)
    np.testing.assert_allclose(seen, LANDMARKS[estimator.landmark_ids], atol=0.01)


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


def test_in_a_gap_the_pose_is_held_and_flagged():
    estimator = run([velocity(0.0), observation(3.0, [0])], velocity_timeout=0.5)
    np.testing.assert_allclose(estimator.pose, true_pose(0.5), atol=1e-9)
    assert estimator.velocity_is_stale
    np.testing.assert_array_equal(estimator.body_velocity, np.zeros(6))


def test_what_is_unknown_of_a_gap_begins_where_it_leaves_the_robot():
    """Not where its last velocity came, 4 m behind: turning there would move it sideways."""
    turn_variance, density = 0.01**2, 0.2  # in rad², m/√s
    settings = Settings(
        two_d_mode=True,
        angular_velocity_noise=(0.0, 0.0, 0.0),
        linear_velocity_noise=(0.0, 0.0, 0.0),
        unknown_angular_motion=np.sqrt(turn_variance),
        unknown_linear_motion=density,
        angular_bias_stddev=(0.0, 0.0, 0.0),
        velocity_delay_stddev=0.0,
    )
    estimator = Estimator(settings)
    for event in (velocity(0.0, [0, 0, 0, 4, 0, 0]), observation(2.0, [])):  # a second is unknown
        estimator.add(event)
    estimator.flush()
    np.testing.assert_allclose(estimator.pose[:3, 3], [4.0, 0.0, 0.0], atol=1e-9)
    expected = np.diag([0.0, 0.0, turn_variance, density**2, density**2, 0.0])
    np.testing.assert_allclose(estimator.pose_covariance, expected, atol=1e-12)


def test_without_any_velocity_observations_still_build_a_map():
    estimator = run([observation(0.0), observation(1.0)])
    assert estimator.velocity_is_stale
    assert len(estimator.landmark_ids) == 5


def test_a_forgotten_landmark_leaves_the_others_alone_and_may_come_back():
    estimator = run(drive())
    ids, points = list(estimator.landmark_ids), estimator.world_points
    row = ids.index(3)
    assert estimator.forget(3)
    assert not estimator.forget(3)
    np.testing.assert_array_equal(estimator.world_points, np.delete(points, row, axis=0))
    estimator.add(observation(4.2, [3]))
    estimator.flush()
    assert estimator.landmark_ids[-1] == 3


@pytest.mark.parametrize('gains', GAINS)
def test_the_first_landmark_can_be_forgotten_like_any_other(gains):
    estimator = run([ObservationEvent(START_NS, np.arange(5), LANDMARKS)], gains=gains)
    for landmark_id in (0, 4, 2):
        assert estimator.forget(landmark_id)
        assert landmark_id not in estimator.landmark_ids
        assert not estimator.forget(landmark_id)
    assert estimator.landmark_ids.tolist() == [1, 3]


@pytest.mark.parametrize('gains', GAINS)
def test_where_one_landmark_is_forgotten_the_others_keep_their_velocities(gains):
    speed = np.zeros_like(LANDMARKS)
    speed[:, 1] = [0.1, 0.2, 0.3, 0.4, 0.5]
    estimator = Estimator(Settings(gains=gains, confirmations=1, reorder_window=0.0))
    estimator.add(ObservationEvent(START_NS, np.arange(5), LANDMARKS, None, speed))
    assert estimator.forget(1)
    kept = [0, 2, 3, 4]
    np.testing.assert_allclose(estimator.landmark_velocities, speed[kept], atol=1e-12)
    nothing = np.empty(0, dtype=np.int64), np.empty((0, 3))
    estimator.add(ObservationEvent(START_NS + 10**9, *nothing))
    np.testing.assert_allclose(estimator.world_points, (LANDMARKS + speed)[kept], atol=1e-9)


def test_reset_forgets_everything_so_that_a_recording_may_start_over():
    estimator = Estimator(Settings(confirmations=1))
    for event in drive():
        estimator.add(event)
    estimator.reset()
    assert len(estimator.landmark_ids) == 0
    assert all(estimator.add(event) for event in drive())
    estimator.flush()
    assert_same_state(estimator, run(drive()))
    estimator.reset()
    np.testing.assert_array_equal(estimator.pose, np.eye(4))


def test_what_was_counted_is_kept_by_a_reset():
    off = np.array([3.0, 2.0, -4.0])
    events = [
        ObservationEvent(START_NS + step * 10**8, np.arange(5), LANDMARKS + (step == 9) * off)
        for step in range(12)
    ]
    estimator = run(events)
    counts = estimator.counts
    assert counts['rejected_landmark'] > 0
    estimator.reset()
    assert estimator.counts == counts
    estimator.handle_clock_jump()
    assert estimator.counts == counts


def bad_events():
    good = observation(5.0, [0, 1])
    stamp_ns = good.stamp_ns
    points, eyes = good.points, np.tile(np.eye(3), (2, 1, 1))
    one_is_negative, one_is_skew = eyes.copy(), eyes.copy()
    one_is_negative[1, 0, 0] = one_is_skew[1, 0, 1] = -0.5
    large_and_skew = np.diag([1.7e308] * 6)
    large_and_skew[0, 1] = 1e308
    return [
        ('negative_stamp', VelocityEvent(-1, BODY_VELOCITY)),
        ('wrong_type', VelocityEvent(stamp_ns * 1e-9, BODY_VELOCITY)),
        ('wrong_type', VelocityEvent(stamp_ns, BODY_VELOCITY.tolist())),
        ('wrong_type', ObservationEvent(stamp_ns, np.array([1.5, 2.0]), points)),
        ('wrong_type', ObservationEvent(stamp_ns, [1, 2], points)),
        ('wrong_type', ObservationEvent(stamp_ns, good.ids.astype(np.uint64), points)),
        ('wrong_type', VelocityEvent(np.uint64(stamp_ns), BODY_VELOCITY)),
        ('wrong_type', VelocityEvent(np.int32(5), BODY_VELOCITY)),
        ('wrong_type', VelocityEvent(stamp_ns, BODY_VELOCITY, receive_ns=1.5)),
        ('too_large', ObservationEvent(stamp_ns, np.array([7, 2**32 - 1]), points)),
        ('wrong_type', ObservationEvent(stamp_ns, np.ma.array(good.ids), points)),
        ('wrong_type', ObservationEvent(stamp_ns, good.ids, np.ma.array(points))),
        ('wrong_type', ObservationEvent(stamp_ns, good.ids, points.astype(np.longdouble))),
        ('wrong_type', ObservationEvent(stamp_ns, good.ids, points.astype(np.float16))),
        ('wrong_type', ObservationEvent(stamp_ns, good.ids, points.astype(np.int8))),
        ('wrong_type', None),
        ('wrong_type', PoseTruth(stamp_ns, np.eye(4))),
        ('too_large', VelocityEvent(2**70, BODY_VELOCITY)),
        ('wrong_shape', ObservationEvent(stamp_ns, np.array(1), points)),
        ('wrong_type', ObservationEvent(stamp_ns, good.ids, points.tolist())),
        ('wrong_type', ObservationEvent(stamp_ns, good.ids, None)),
        ('wrong_type', ObservationEvent(stamp_ns, good.ids, points.astype(str))),
        ('wrong_type', ObservationEvent(stamp_ns, good.ids, points.astype(object))),
        ('wrong_type', VelocityEvent(stamp_ns, BODY_VELOCITY.astype(complex))),
        ('wrong_shape', ObservationEvent(stamp_ns, good.ids, np.array(1.0))),
        ('too_large', ObservationEvent(stamp_ns, good.ids, np.full((2, 3), 2**32))),
        ('wrong_shape', VelocityEvent(stamp_ns, BODY_VELOCITY[:5])),
        ('not_finite', VelocityEvent(stamp_ns, BODY_VELOCITY * np.nan)),
        ('not_finite', VelocityEvent(stamp_ns, np.array([np.inf, 0, 0, -np.inf, 0, 0]))),
        ('bad_covariance', VelocityEvent(stamp_ns, BODY_VELOCITY, -np.eye(6))),
        ('bad_covariance', VelocityEvent(stamp_ns, BODY_VELOCITY, large_and_skew)),
        ('wrong_shape', ObservationEvent(stamp_ns, good.ids, points[:, :2])),
        ('wrong_shape', ObservationEvent(stamp_ns, good.ids[:1], points)),
        ('not_finite', ObservationEvent(stamp_ns, good.ids, points * np.inf)),
        ('negative_id', ObservationEvent(stamp_ns, np.array([7, -2]), points)),
        ('wrong_shape', ObservationEvent(stamp_ns, good.ids, points, np.ones((2, 3)))),
        ('not_finite', ObservationEvent(stamp_ns, good.ids, points, np.full((2, 3, 3), np.nan))),
        ('bad_covariance', ObservationEvent(stamp_ns, good.ids, points, covariances=-eyes)),
        ('bad_covariance', ObservationEvent(stamp_ns, good.ids, points, one_is_negative)),
        ('bad_covariance', ObservationEvent(stamp_ns, good.ids, points, one_is_skew)),
        ('wrong_shape', ObservationEvent(stamp_ns, good.ids, points, velocities=points[:1])),
        ('wrong_type', ObservationEvent(stamp_ns, good.ids, points, velocities=points.tolist())),
        ('not_finite', ObservationEvent(stamp_ns, good.ids, points, velocities=points * np.nan)),
        ('wrong_shape', ObservationEvent(stamp_ns, good.ids, points, sensor=points[0])),
        ('wrong_type', ObservationEvent(stamp_ns, good.ids, points, sensor=points.tolist())),
        ('not_finite', ObservationEvent(stamp_ns, good.ids, points, sensor=points * np.inf)),
        ('too_large', ObservationEvent(stamp_ns, good.ids, points, sensor=points * 1e7)),
        ('stamp_jump', VelocityEvent(stamp_ns + 10**12, BODY_VELOCITY)),
        ('duplicate', drive()[-2]),
        ('duplicate', drive()[-1]),
    ]


@pytest.mark.parametrize(('reason', 'event'), bad_events())
def test_a_bad_event_is_dropped_whole_counted_and_leaves_the_state_alone(reason, event):
    estimator, untouched = Estimator(Settings()), Estimator(Settings())
    for good in drive():
        assert estimator.add(good)
        untouched.add(good)
    assert not estimator.add(event)
    assert estimator.dropped == {reason: 1}
    estimator.flush()
    untouched.flush()
    assert_same_state(estimator, untouched)


@pytest.mark.parametrize('sign', [1.0, -1.0])
@pytest.mark.parametrize('dtype', [np.float64, np.float32])
def test_what_is_as_large_as_may_be_is_taken_and_what_is_larger_refused(sign, dtype):
    settings = Settings(max_linear_velocity=MAX_MEASURED, max_angular_velocity=MAX_MEASURED)
    for size, is_taken in ((MAX_MEASURED, True), (1.001 * MAX_MEASURED, False)):
        entries = np.array([0.0, sign * size, 0.0], dtype=dtype)
        estimator, ids = Estimator(settings), np.array([1])
        assert estimator.add(VelocityEvent(START_NS, np.tile(entries, 2))) == is_taken
        assert estimator.add(ObservationEvent(START_NS, ids, entries[None])) == is_taken
        velocities = entries[None] * np.ones((1, 3), dtype=dtype)
        moving = ObservationEvent(START_NS + 1, ids, np.ones((1, 3)), None, velocities)
        assert estimator.add(moving) == is_taken
        assert estimator.dropped == ({} if is_taken else {'too_large': 3})


def test_a_velocity_that_no_robot_has_is_refused_counted_and_named(caplog):
    fast, turning = np.zeros(6), np.zeros(6)
    fast[4], turning[2] = -500.0, 60.0
    estimator, untouched = Estimator(Settings()), Estimator(Settings())
    for good in drive():
        assert estimator.add(good)
        untouched.add(good)
    stamp_ns = estimator.newest_stamp_ns + 1
    assert not estimator.add(VelocityEvent(stamp_ns, fast))
    assert not estimator.add(VelocityEvent(stamp_ns, turning))
    assert not estimator.add(AngularVelocityEvent(stamp_ns, turning[:3]))
    assert estimator.dropped == {'too_fast': 3}
    assert 'a velocity of 500.0 m/s is beyond max_linear_velocity (100 m/s)' in caplog.text
    estimator.flush()
    untouched.flush()
    assert_same_state(estimator, untouched)
    settings = Settings(max_linear_velocity=600.0, max_angular_velocity=61.0)
    assert Estimator(settings).add(VelocityEvent(stamp_ns, fast + turning))


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('size', [1e155, -1e300, 1.7e308, np.inf, np.nan])
def test_numbers_that_are_too_large_are_refused_without_a_warning_of_numpy(size):
    huge, ids, points = np.full((6, 6), size), np.array([1]), np.ones((1, 3))
    skew = np.triu(huge) - np.tril(huge, -1)
    estimator = Estimator(Settings())
    for event in (
        VelocityEvent(START_NS, huge[0]),
        AngularVelocityEvent(START_NS, huge[0, :3]),
        ObservationEvent(START_NS, ids, huge[:1, :3]),
        ObservationEvent(START_NS, ids, points, None, huge[:1, :3]),
    ):
        assert not estimator.add(event)
    assert set(estimator.dropped) <= {'too_large', 'not_finite'}
    # Covariances that large say 'unknown'.
    estimator.add(VelocityEvent(START_NS, np.zeros(6), skew))
    estimator.add(ObservationEvent(START_NS, ids, points, skew[None, :3, :3]))


@pytest.mark.parametrize('gains', GAINS)
def test_points_with_ids_that_are_kept_for_others_are_left_out_counted_and_named(caplog, gains):
    estimator, without = Estimator(Settings(gains=gains)), Estimator(Settings(gains=gains))
    for step in range(5):
        event = observation(0.1 * step, [4, 0, 1, 2])
        ids = np.array([4, FIRST_AUTOMATIC_ID, LAST_AUTOMATIC_ID, LAST_AUTOMATIC_ID + 1])
        assert estimator.add(replace(event, ids=ids))
        without.add(replace(event, ids=ids[[0, 3]], points=event.points[[0, 3]]))
    estimator.flush()
    without.flush()
    assert_same_state(estimator, without)
    assert estimator.landmark_ids.tolist() == [4, LAST_AUTOMATIC_ID + 1]
    assert estimator.counts['reserved_id'] == 10
    assert used_points(estimator.counts) == 10
    assert 'points with the ids 10000000, 16777215;' in caplog.text
    assert len(caplog.records) == 1


def test_points_whose_message_has_no_possible_id_are_left_out_and_the_others_used():
    estimator = Estimator(Settings(reorder_window=0.0, confirmations=1))
    ids = np.array([7, IMPOSSIBLE_ID, 8, IMPOSSIBLE_ID])
    assert estimator.add(ObservationEvent(1, ids, np.ones((4, 3)) * np.arange(4)[:, None]))
    estimator.flush()
    assert estimator.landmark_ids.tolist() == [7, 8]
    assert estimator.counts['impossible_id'] == 2


def test_of_settings_without_effect_on_the_gains_there_is_one_warning(caplog):
    asked = {
        'landmark_velocity_stddev': 0.1,
        'linear_bias_stddev': (0.2, 0.0, 0.0),
        'calibration_drift': 0.1,
        'gain_k': 2.0,
    }
    Estimator(Settings(gains='riccati', **asked))
    Estimator(Settings(gains='constant'))
    assert not caplog.records
    Estimator(Settings(gains='riccati', gain_l=2.0, step_mode='paper'))
    assert caplog.messages == ['No effect on riccati gains: gain_l, step_mode.']
    caplog.clear()
    Estimator(Settings(gains='scheduled', **asked)).reset()
    Estimator(Settings(gains='constant', **asked))
    assert caplog.messages == [
        'No effect on scheduled gains: landmark_velocity_stddev.',
        'No effect on constant gains: linear_bias_stddev, calibration_drift, '
        'landmark_velocity_stddev.',
    ]


def test_where_many_landmarks_seem_to_move_the_odometry_is_named(caplog):
    estimator = Estimator(Settings(gains='scheduled', reorder_window=0.0, max_rejections=2))
    for step in range(500):
        estimator.add(velocity(0.1 * step, np.zeros(6)))
        times_moved = (step // 8 + 4 - np.arange(5)) // 5  # one after another
        points = LANDMARKS + 3.0 * np.outer(times_moved, [0.0, 0.0, 1.0])
        estimator.add(ObservationEvent(START_NS + step * 10**8, np.arange(5), points))
    reported = [message for message in caplog.messages if 'seem to have moved' in message]
    assert reported[0].startswith(
        '5 landmarks seem to have moved within a minute: odometry may err'
    )


def test_landmarks_that_moved_before_a_jump_of_the_clock_did_not_move_lately(caplog):
    warnings = event_warnings.EventWarnings()
    for landmark_id in range(event_warnings.MANY_MOVED):
        stamp_s = 1000 - 200 * landmark_id
        warnings.moved_landmarks(np.array([landmark_id]), stamp_s * 10**9)
    assert 'seem to have moved' not in caplog.text


@pytest.mark.parametrize('gains', GAINS)
def test_a_map_too_large_for_a_dense_covariance_is_reported_once(caplog, monkeypatch, gains):
    monkeypatch.setattr(event_warnings, 'MANY_LANDMARKS', 5)
    run([observation(0.1 * step) for step in range(5)], gains=gains)
    reported = [message for message in caplog.messages if 'The map has 5 landmarks' in message]
    assert len(reported) == (gains == 'riccati')


def test_more_landmarks_at_once_than_may_be_kept_are_reported(caplog):
    run([observation(0.1 * step) for step in range(5)], max_landmarks=3)
    assert '5 points in one message, and max_landmarks is 3' in caplog.text


@pytest.mark.parametrize('repeated', [[1, 1], [1, 1, 1], [1, 3, 3, 1]])
def test_points_with_one_id_are_left_out_counted_and_named(caplog, repeated):
    estimator, without = Estimator(Settings()), Estimator(Settings())
    for step in range(5):
        assert estimator.add(observation(0.1 * step, [4, *repeated, 2]))
        without.add(observation(0.1 * step, [4, 2]))
    estimator.flush()
    without.flush()
    assert_same_state(estimator, without)
    assert estimator.counts['repeated_id'] == 5 * len(repeated)
    assert used_points(estimator.counts) == 10
    named = ', '.join(str(landmark_id) for landmark_id in sorted(set(repeated)))
    assert f'several points of the ids {named} (1 so far)' in caplog.text
    assert len(caplog.records) == 1


def test_one_stray_stamp_is_refused_but_a_clock_that_jumped_is_followed():
    estimator = run(drive())
    jumped = [velocity(5000.0 + 0.05 * step) for step in range(20)]
    accepted = [estimator.add(event) for event in jumped]
    assert accepted == [False] * 4 + [True] * 16
    assert estimator.newest_stamp_ns == jumped[-1].stamp_ns


@pytest.mark.parametrize('ahead_s', [2.5, 9.0])
@pytest.mark.parametrize('reorder_window', [0.0, 0.05])
def test_one_stamp_ahead_does_not_cost_the_map(ahead_s, reorder_window):
    events = drive()
    ahead = VelocityEvent(events[60].stamp_ns + round(ahead_s * 1e9) + 1, BODY_VELOCITY)
    settings = {'reorder_window': reorder_window}
    right, wrong = run(events, **settings), run([*events[:60], ahead, *events[60:]], **settings)
    assert wrong.jumps == 0
    assert wrong.counts['observation'] == right.counts['observation']
    np.testing.assert_allclose(wrong.world_points, right.world_points, atol=0.02)


def test_events_released_in_between_leave_one_stamp_ahead_waiting():
    events = drive()
    ahead = VelocityEvent(events[60].stamp_ns + 2_500_000_001, BODY_VELOCITY)
    estimator = Estimator(Settings(confirmations=1))
    for event in [*events[:60], ahead]:
        estimator.add(event)
    estimator.release()
    assert estimator.stamp_ns == events[59].stamp_ns
    for event in events[60:]:
        assert estimator.add(event)
    estimator.release()
    assert_same_state(estimator, run(events))
    assert not estimator.dropped


def test_a_silence_of_both_sensors_erases_no_map_but_a_jump_of_the_clock_does():
    """Both have the same stamps; time of reception distinguishes them."""
    before, after = drive(), [observation(60.0 + 0.05 * step) for step in range(20)]
    for receive_s, jumps in ((60.0, 0), (4.0, 1)):
        received = [replace(event, receive_ns=event.stamp_ns) for event in before]
        received += [
            replace(event, receive_ns=START_NS + round(receive_s * 1e9)) for event in after
        ]
        estimator = run(received)
        assert estimator.jumps == jumps
        assert (estimator.landmark_counts.max() > 20) == (not jumps)


def test_an_empty_observation_moves_the_state_on_and_nothing_else():
    empty = ObservationEvent(START_NS + 10**9, np.empty(0, dtype=np.int64), np.empty((0, 3)))
    estimator = run([velocity(0.0), empty], velocity_timeout=2.0)
    assert estimator.stamp_ns == empty.stamp_ns
    np.testing.assert_allclose(estimator.pose, true_pose(1.0), atol=1e-9)


def test_while_there_is_room_no_landmark_makes_room_for_a_new_one():
    events = [observation(0.1 * landmark, [landmark]) for landmark in range(4)]
    estimator = run([velocity(0.0), *events], max_landmarks=5)
    assert estimator.landmark_ids.tolist() == [0, 1, 2, 3]
    assert estimator.counts['forgotten_landmark'] == 0


def test_by_default_a_map_does_not_grow_for_ever_and_it_is_said_once_when_it_is_full(caplog):
    limit = Settings().max_landmarks
    assert 500 <= limit <= 5000
    estimator = Estimator(Settings(gains='scheduled', reorder_window=0.0))
    noise = np.random.default_rng(0)
    for step in range(12):
        estimator.add(velocity(0.1 * step))
        ids = np.arange(300) + 300 * step
        points = noise.normal(scale=20.0, size=(300, 3))
        estimator.add(ObservationEvent(START_NS + step * 10**8, ids, points))
    assert estimator.counts['forgotten_landmark'] == 12 * 300 - limit
    said = [text for text in caplog.messages if f'max_landmarks is {limit}' in text]
    assert len(said) == 1
    assert 'from now on a new one replaces the one seen least often' in said[0]


def test_a_loaded_map_that_will_not_be_kept_whole_is_reported_when_it_is_loaded(caplog):
    points = np.random.default_rng(0).normal(scale=20.0, size=(30, 3))
    known = LandmarkMap(np.arange(100, 130), points, None, np.zeros(30, dtype=np.int64))
    for settings, is_reported in (
        (Settings(max_landmarks=10), True),
        (Settings(max_landmarks=10, localization_mode='fixed'), False),
        (Settings(), False),
    ):
        caplog.clear()
        Estimator(settings).load_map(known, np.eye(4))
        text = 'The loaded map has 30 landmarks, and max_landmarks is 10: '
        assert (text in caplog.text) == is_reported


def test_a_full_map_forgets_the_landmark_seen_least_often_never_one_in_view():
    events = [observation(0.0, [0, 1, 2]), observation(0.1, [0, 2]), observation(0.2, [0, 1, 3])]
    estimator = run([velocity(0.0), *events], max_landmarks=3)
    assert sorted(estimator.landmark_ids) == [0, 1, 3]
    assert estimator.counts['forgotten_landmark'] == 1
    estimator.add(observation(0.3, range(5)))
    estimator.flush()
    assert sorted(estimator.landmark_ids) == [0, 1, 3]
    assert estimator.counts['unmapped_landmark'] == 2


def test_landmarks_that_move_again_and_again_are_reported_ever_more_seldom(caplog):
    def moved(index, event):
        shift = true_pose(0.1 * index)[:3, :3].T @ [0.0, 0.0, 20.0 * (index // 10)]
        return replace(event, points=event.points + (event.ids == 2)[:, None] * shift)

    events = [velocity(0.1 * index) for index in range(140)]
    events += [moved(index, observation(0.1 * index)) for index in range(140)]
    events.sort(key=lambda event: event.stamp_ns)
    estimator = run(events, gains='riccati')
    assert 10 <= estimator.counts['moved_landmark'] < 100
    reported = [text.partition(':')[0] for text in caplog.messages if 'moved' in text]
    assert reported == [f'Landmarks [2] have moved ({times} so far)' for times in (1, 10)]


@pytest.mark.parametrize('gains', GAINS)
def test_landmarks_with_known_velocities_are_followed_through_the_lift_19(gains):
    speed = np.array(
        [[0.2, 0.0, 0.0], [0.0, -0.3, 0.1], [0.0, 0.0, 0.0], [0.1, 0.1, 0.0], [0, 0, 0.2]]
    )
    estimator = Estimator(
        Settings(gains=gains, relinearization_interval=20, relinearization_angle=0.0)
    )
    for step in range(200):
        time_s = 0.05 * step
        estimator.add(velocity(time_s))
        if step < 120:  # then they go on unseen
            body = se3.inverse(true_pose(time_s))
            points = se3.transform(body, LANDMARKS + speed * time_s)
            stamp_ns = START_NS + round(time_s * 1e9)
            velocities = se3.rotate(body, speed)
            estimator.add(ObservationEvent(stamp_ns, np.arange(5), points, None, velocities))
    end = START_NS + round(9.95e9)
    estimator.add(ObservationEvent(end, np.empty(0, dtype=np.int64), np.empty((0, 3))))
    estimator.flush()
    np.testing.assert_allclose(estimator.world_points, LANDMARKS + speed * 9.95, atol=1e-6)
    np.testing.assert_allclose(estimator.pose, true_pose(9.95), atol=1e-6)


@pytest.mark.parametrize('gains', GAINS)
def test_a_landmark_stops_where_its_sensor_says_nothing_of_a_velocity_any_more(gains):
    estimator = Estimator(Settings(gains=gains, confirmations=1, reorder_window=0.0))
    for step in range(60):
        points, speed = LANDMARKS.copy(), np.zeros_like(LANDMARKS)
        points[0, 0] += 0.1 * min(step, 10)
        speed[0, 0] = 1.0
        estimator.add(velocity(0.1 * step, np.zeros(6)))
        seen = ObservationEvent(START_NS + step * 10**8, np.arange(5), points)
        estimator.add(replace(seen, velocities=speed) if step < 10 else seen)
    np.testing.assert_allclose(estimator.world_points, points, atol=1e-6)
    np.testing.assert_array_equal(estimator.landmark_velocities, 0.0)
    assert estimator.counts['rejected_landmark'] == 0


def test_a_landmark_that_comes_back_says_as_much_as_one_that_was_always_there():
    """The robot knows where it went, but not how it has turned itself meanwhile."""
    settings = Settings(
        confirmations=1,
        reorder_window=0.0,
        velocity_timeout=10.0,
        observation_model='cartesian',
        point_noise=0.01,
        angular_velocity_noise=(0.01,) * 3,
    )
    speed = np.zeros_like(LANDMARKS)
    speed[0] = [0.0, 3.0, 0.0]
    at_rest = LANDMARKS + 4.0 * speed

    def back_after_4_s(points, velocities):
        estimator, back_ns = Estimator(settings), START_NS + 4 * 10**9
        estimator.add(velocity(0.0, np.zeros(6)))
        estimator.add(ObservationEvent(START_NS, np.arange(5), points, None, velocities))
        estimator.add(ObservationEvent(back_ns, np.array([0]), at_rest[:1]))
        estimator.flush()
        return estimator.configuration_covariance(np.arange(5))

    moved, expected = back_after_4_s(LANDMARKS, speed), back_after_4_s(at_rest, 0.0 * speed)
    np.testing.assert_allclose(moved, expected, atol=1e-3 * np.abs(expected).max())


@pytest.mark.parametrize('gains', GAINS)
def test_moving_landmarks_are_where_they_are_at_the_stamp_of_the_pose(gains):
    estimator = Estimator(Settings(gains=gains, confirmations=1, reorder_window=0.0))
    speed = np.zeros_like(LANDMARKS)
    speed[:, 1] = 2.0
    estimator.add(velocity(0.0, np.zeros(6)))
    estimator.add(ObservationEvent(START_NS, np.arange(5), LANDMARKS, None, speed))
    for step in range(1, 51):
        estimator.add(velocity(0.02 * step, np.zeros(6)))
        expected = LANDMARKS + 0.02 * step * speed
        np.testing.assert_allclose(estimator.world_points, expected, atol=1e-9)


@pytest.mark.parametrize('gains', GAINS)
def test_a_landmark_out_of_view_moves_on_while_others_are_seen_at_rest(gains):
    estimator = Estimator(Settings(gains=gains, confirmations=1, reorder_window=0.0))
    speed = np.array([[0.0, 2.0, 0.0]])
    estimator.add(velocity(0.0, np.zeros(6)))
    estimator.add(ObservationEvent(START_NS, np.array([0]), LANDMARKS[:1], None, speed))
    at_rest = ObservationEvent(START_NS, np.array([1]), LANDMARKS[1:2], None, 0.0 * speed)
    estimator.add(at_rest)
    estimator.add(replace(at_rest, stamp_ns=START_NS + 4 * 10**8))
    expected = [LANDMARKS[0] + 0.4 * speed[0], LANDMARKS[1]]
    np.testing.assert_allclose(estimator.world_points, expected, atol=1e-6)


@pytest.mark.parametrize('gap_s', [1e2, 1e4, 1e7])
@pytest.mark.parametrize(('gains', 'has_ids'), [*((g, True) for g in GAINS), ('riccati', False)])
@pytest.mark.parametrize('two_d_mode', [False, True])
def test_after_any_gap_an_accurate_sensor_finds_the_robot_again(gap_s, gains, has_ids, two_d_mode):
    """However uncertain the pose has become, sensors are 0.1 mm accurate at 50 m.

    Without ids it may be lost, and goes on from there.
    """
    random, sigma_m = np.random.default_rng(0), 1e-4
    points = 50.0 * random.standard_normal((8, 3)) * [1, 1, not two_d_mode]
    settings = Settings(gains=gains, two_d_mode=two_d_mode, max_stamp_jump=1e9)
    estimator, stamp_ns = Estimator(settings), START_NS
    ids = np.arange(8) if has_ids else np.full(8, UNKNOWN_ID)
    for step in range(30):
        stamp_ns += round(gap_s * 1e9) if step == 15 else 10**8
        if step % 5 == 0:
            estimator.add(VelocityEvent(stamp_ns, np.zeros(6)))
        seen = points + sigma_m * random.standard_normal((8, 3)) * [1, 1, not two_d_mode]
        covariances = np.tile(sigma_m**2 * np.eye(3), (8, 1, 1))
        estimator.add(ObservationEvent(stamp_ns, ids, seen, covariances))
    estimator.flush()
    assert estimator.counts['observation'] == 30
    assert np.isfinite(estimator.pose).all()
    if has_ids:
        assert len(estimator.landmark_ids) == 8
        np.testing.assert_allclose(estimator.pose, np.eye(4), atol=2e-3)


def with_velocities(event, noise):
    if not isinstance(event, ObservationEvent):
        return event
    return replace(event, velocities=noise.normal(scale=0.1, size=event.points.shape))


def test_where_landmarks_move_what_was_seen_is_not_looked_back_at():
    noise = np.random.default_rng(1)
    events = [with_velocities(event, noise) for event in drive()]
    often = run(events, gains='riccati', relinearization_interval=5, relinearization_angle=0.0)
    assert_same_state(often, run(events, gains='riccati', relinearization_interval=0))
    with pytest.raises(ParameterError, match='came with velocities'):
        often.smooth()


@pytest.mark.parametrize('gains', GAINS)
def test_a_pose_set_far_from_the_origin_serves_as_well_as_one_that_is_near(gains):
    far = np.eye(4)
    far[:3, 3] = [5e5, 4e6, 100.0]  # a UTM grid's
    near = Estimator(Settings(gains=gains))
    near.set_pose(np.eye(4), 0.01 * np.eye(6))
    distant = Estimator(Settings(gains=gains))
    distant.set_pose(far, 0.01 * np.eye(6))
    for event in drive():
        assert near.add(event) == distant.add(event)
    np.testing.assert_allclose(se3.inverse(far) @ distant.pose, near.pose, atol=1e-6)
    np.testing.assert_allclose(distant.world_points - far[:3, 3], near.world_points, atol=1e-6)


def test_unknown_constant_landmark_velocities_are_estimated_when_asked_for():
    speed = np.array([[0.2, 0.0, 0], [0, -0.3, 0.1], [0, 0, 0], [0.1, 0.1, 0], [0, 0, 0.2]])
    noise = np.random.default_rng(4)
    estimator = Estimator(
        Settings(landmark_velocity_stddev=0.5, point_noise=0.01, observation_model='cartesian')
    )
    for step in range(600):
        time_s = 0.05 * step
        estimator.add(velocity(time_s))
        points = se3.transform(se3.inverse(true_pose(time_s)), LANDMARKS + speed * time_s)
        points = points + noise.normal(scale=0.01, size=points.shape)
        stamp_ns = START_NS + round(time_s * 1e9)
        estimator.add(ObservationEvent(stamp_ns, np.arange(5), points))
    estimator.flush()
    np.testing.assert_allclose(estimator.landmark_velocities, speed, atol=0.03)


def moving_landmark(speeds=None):
    """An estimator of a landmark's velocity that saw one for a second and then drives on."""
    settings = Settings(landmark_velocity_stddev=0.5, reorder_window=0.0, velocity_timeout=10.0)
    estimator = Estimator(settings)
    for step in range(40):
        stamp_ns = START_NS + step * 10**8
        estimator.add(VelocityEvent(stamp_ns, np.zeros(6)))
        if step <= 10:
            point = np.array([[5.0 + 0.2 * step, 0.0, 0.0]])
            estimator.add(ObservationEvent(stamp_ns, np.array([1]), point, velocities=speeds))
    return estimator


def test_a_landmark_that_moves_is_the_less_certain_the_longer_it_was_not_seen():
    estimator = moving_landmark()
    reported = estimator.landmark_covariances
    assert estimator.stamp_ns - estimator._timeline.state_ns > 10**9
    estimator.flush()
    np.testing.assert_allclose(reported, estimator.landmark_covariances, rtol=1e-9, atol=1e-12)


def test_where_velocities_of_landmarks_are_estimated_those_of_messages_are_not_used():
    assert_same_state(moving_landmark(np.array([[3.0, 2.0, 1.0]])), moving_landmark())


@pytest.mark.parametrize('gains', ['constant', 'scheduled'])
def test_gains_that_estimate_no_velocities_of_landmarks_take_them_as_messages_say(gains):
    settings = Settings(gains=gains, landmark_velocity_stddev=0.5, confirmations=1)
    estimator, speeds = Estimator(settings), np.full((5, 3), 0.1)
    for time_s, reported, expected in [(0.0, speeds, speeds), (0.1, None, 0.0 * speeds)]:
        estimator.add(velocity(time_s, np.zeros(6)))
        event = ObservationEvent(observation(time_s).stamp_ns, np.arange(5), LANDMARKS)
        estimator.add(replace(event, velocities=reported))
        estimator.release()
        np.testing.assert_allclose(estimator.landmark_velocities, expected, atol=1e-9)


def test_a_late_observation_is_judged_by_where_its_landmarks_are_by_now():
    """Scheduled gains put off moving those that were out of view."""
    settings = Settings(gains='scheduled', confirmations=1)
    state = State(make_gains(settings, np.eye(4)), settings)
    event = observation(0.0, [0, 1])
    state_step.step(state, match(state, event))
    state.observer.body_points = Mock(return_value=event.points)
    velocities = VelocityHistory(timeout_ns=10**9)
    velocities.append(queued(velocity(0.0, np.zeros(6))))
    carried_forward(state, event, velocities, event.stamp_ns + 10**8)
    np.testing.assert_array_equal(state.observer.body_points.call_args.args[0], [0, 1])


def test_a_landmark_that_is_placed_again_moves_as_its_sensor_says_from_then_on():
    estimator, point = Estimator(Settings(reorder_window=0.0, confirmations=1)), np.ones((1, 3))
    for step in range(40):
        has_jumped, speed = step >= 20, np.array([[0.5, 0.0, 0.0]])
        others = np.concatenate([LANDMARKS, point + 0.05 * step * speed + 2.0 * has_jumped])
        speeds = np.concatenate([np.zeros_like(LANDMARKS), speed])
        estimator.add(velocity(0.05 * step, np.zeros(6)))
        stamp_ns = START_NS + step * 50_000_000
        estimator.add(ObservationEvent(stamp_ns, np.arange(6), others, velocities=speeds))
        np.testing.assert_allclose(estimator.landmark_velocities[-1], speed[0], atol=1e-3)
    assert estimator.counts['moved_landmark'] == 1


@pytest.mark.parametrize('on_time_jump', ['hold', 'reset'])
def test_what_waits_for_late_events_is_used_before_the_clock_jumps(on_time_jump):
    settings, reported, added = Settings(on_time_jump=on_time_jump, reorder_window=0.5), [], 0
    estimator = Estimator(settings, on_jump=lambda: reported.append(estimator.stamp_ns))
    for _ in range(2):
        for step in range(200):
            estimator.add(velocity(100.0 + 0.05 * step, np.zeros(6)))
            added += 1
    estimator.flush()
    assert estimator.jumps == 1
    assert reported == [None], 'once, before anything of the new time is used'
    assert estimator.counts['velocity'] + estimator.dropped.total() == added


@pytest.mark.parametrize('gains', GAINS)
def test_after_a_jump_back_in_time_pose_and_map_are_held_if_asked(gains):
    events = drive()
    estimator = run(events, on_time_jump='hold', gains=gains)
    pose, points = estimator.pose, estimator.world_points
    stray = ObservationEvent(START_NS - 10**12, np.array([99]), np.ones((1, 3)))
    for step in range(AGREEING_STAMPS):
        estimator.add(replace(stray, stamp_ns=stray.stamp_ns + step))
    assert estimator.newest_stamp_ns == stray.stamp_ns + AGREEING_STAMPS - 1
    estimator.flush()
    np.testing.assert_allclose(estimator.pose, pose, atol=1e-12)
    np.testing.assert_allclose(estimator.world_points[:-1], points, atol=1e-12)
    np.testing.assert_allclose(estimator.world_points[-1], pose[:3] @ [1.0, 1.0, 1.0, 1.0])


@pytest.mark.parametrize('gains', GAINS)
def test_a_pose_that_is_held_is_that_of_the_newest_velocity_not_of_the_last_observation(gains):
    estimator = Estimator(Settings(on_time_jump='hold', reorder_window=0.0, gains=gains))
    for event in [observation(0.0), *[velocity(0.05 * step) for step in range(21)]]:
        estimator.add(event)
    estimator.handle_clock_jump()
    np.testing.assert_allclose(estimator.pose, true_pose(1.0), atol=1e-9)


@pytest.mark.parametrize('is_in_loaded_map', [False, True])
def test_a_pose_that_is_set_is_that_of_the_newest_velocity(is_in_loaded_map):
    estimator, pose = Estimator(Settings(reorder_window=0.0)), true_pose(7.0)
    for event in [observation(0.0), *[velocity(0.05 * step) for step in range(21)]]:
        estimator.add(event)
    if is_in_loaded_map:
        known = LandmarkMap(np.arange(5), LANDMARKS, None, np.zeros(5, dtype=np.int64))
        estimator.load_map(known, pose)
    else:
        estimator.set_pose(pose)
    np.testing.assert_allclose(estimator.pose, pose, atol=1e-9)


def test_nothing_is_smoothed_across_a_pose_that_was_set():
    estimator, far = Estimator(Settings(reorder_window=0.0)), se3.exp(np.full(6, 0.5))
    for event in drive(2.0):
        estimator.add(event)
    estimator.set_pose(far @ estimator.pose)
    assert estimator.smooth().since == 'the pose was set'
    set_ns = estimator.stamp_ns
    for event in drive(4.0)[len(drive(2.0)) :]:
        estimator.add(event)
    assert (estimator.smooth().stamps_ns > set_ns).all()


def test_after_a_jump_back_in_time_landmarks_out_of_view_make_room_for_new_ones():
    settings = Settings(on_time_jump='hold', max_landmarks=3, confirmations=1, reorder_window=0.0)
    estimator, points = Estimator(settings), 3.0 * np.eye(3)
    for start_ns, ids in ((10**12, [0, 1, 2]), (10**9, [2, 7, 8])):
        for step in range(5):
            stamp_ns = start_ns + step * 10**8
            assert estimator.add(VelocityEvent(stamp_ns, np.zeros(6)))
            assert estimator.add(ObservationEvent(stamp_ns, np.array(ids), points))
        estimator.handle_clock_jump()
    assert sorted(estimator.landmark_ids) == [2, 7, 8]


def test_a_landmark_in_view_makes_no_room_though_its_point_is_rejected():
    estimator, points = Estimator(Settings(max_landmarks=3, reorder_window=0.0)), 3.0 * np.eye(3)
    for step in range(5):
        assert estimator.add(ObservationEvent(step * 10**8, np.arange(3), points))
    points = np.concatenate([points, np.ones((1, 3))])
    points[2] += 5.0
    assert estimator.add(ObservationEvent(5 * 10**8, np.array([0, 1, 2, 9]), points))
    assert sorted(estimator.landmark_ids) == [0, 1, 2]
    assert estimator.counts['rejected_landmark'] == estimator.counts['unmapped_landmark'] == 1
    assert estimator.smooth().since == 'the last start'


def test_observations_in_a_row_of_which_all_landmarks_were_rejected_are_counted():
    """From which a place in a map is taken for wrong, or odometry for having slipped."""
    estimator = Estimator(Settings(gains='scheduled', reorder_window=0.0, max_rejections=100))
    counted = []
    for step in range(12):
        off = 50.0 * (step in (6, 7, 8, 10, 11)) * np.array([1.0, -2.0, 3.0])
        estimator.add(VelocityEvent(START_NS + step * 10**8, np.zeros(6)))
        estimator.add(ObservationEvent(START_NS + step * 10**8, np.arange(5), LANDMARKS + off))
        counted.append(estimator._hypotheses.best.rejected_in_a_row)
    assert counted == [0, 0, 0, 0, 0, 0, 1, 2, 3, 0, 1, 2]


def test_after_a_jump_all_starts_where_the_run_began_though_the_robot_was_moved_since():
    start = true_pose(3.0)
    estimator = Estimator(Settings(), initial_pose=start)
    assert estimator.add(velocity(0.0))
    estimator.set_pose(true_pose(7.0))
    estimator.handle_clock_jump()
    np.testing.assert_array_equal(estimator.pose, start)


def test_after_a_jump_the_estimator_starts_again_at_once():
    estimator = run(drive())
    estimator.handle_clock_jump()
    assert len(estimator.landmark_ids) == 0
    assert estimator.stamp_ns is None
    assert estimator.add(velocity(-1e6))


def test_all_events_of_a_stamp_are_reported_once_and_also_after_a_jump_of_the_clock():
    reported = []
    settings = Settings(reorder_window=0.0, on_time_jump='hold')
    estimator = Estimator(
        settings, on_stamps=lambda stamps_ns: reported.extend(stamps_ns.tolist())
    )
    for step in range(3):
        stamp_ns = START_NS + step * 10**8
        estimator.add(VelocityEvent(stamp_ns, np.zeros(6)))
        estimator.add(ObservationEvent(stamp_ns, np.arange(5), LANDMARKS))
    assert reported == [START_NS, START_NS + 10**8]
    estimator.handle_clock_jump()
    assert reported == [START_NS + step * 10**8 for step in range(3)]
    estimator.add(VelocityEvent(START_NS, np.zeros(6)))
    estimator.flush()
    assert reported[3:] == [START_NS]


@pytest.mark.parametrize('gains', ['scheduled', 'riccati'])
def test_far_points_said_to_be_all_but_exact_are_taken_after_turning_blindly(gains):
    """Not by zeros, which say unknown."""
    estimator = Estimator(Settings(gains=gains, reorder_window=0.0))
    points = np.random.default_rng(1).uniform(-100.0, 100.0, size=(10, 3))
    velocity = np.array([0.0, 0.0, 0.2, 0.5, 0.0, 0.0])
    exact = np.tile(1e-300 * np.eye(3), (4, 1, 1))
    for number in range(60):
        pose = se3.exp(number * velocity)
        stamp_ns = START_NS + number * 5_000_000_000
        seen = np.arange(4) + number % 7
        estimator.add(VelocityEvent(stamp_ns, velocity))
        body_points = se3.transform(se3.inverse(pose), points[seen])
        assert estimator.add(ObservationEvent(stamp_ns, seen, body_points, exact))
        assert len(estimator.landmark_map.ids) == len(estimator.landmark_ids)
    np.testing.assert_allclose(estimator.pose, pose, atol=1e-6)


@pytest.mark.parametrize(
    ('wrong', 'expected'),
    [
        ({'gains': 'x'}, "'gains' takes one of constant, scheduled, riccati, not 'x'"),
        ({'range_noise': -1.0}, "'range_noise' takes a value"),
        ({'linear_velocity_noise': (1.0, 2.0)}, 'a list of 3 numbers'),
    ],
)
def test_settings_made_in_python_are_checked_like_those_of_a_file(wrong, expected):
    with pytest.raises(ParameterError, match=expected):
        Estimator(Settings(**wrong))
    with pytest.raises(ParameterError, match=expected):
        Estimator(Settings()).change_settings(Settings(**wrong))


def test_only_settings_that_may_change_while_running_do():
    estimator = Estimator(Settings())
    estimator.change_settings(Settings(gain_k=1.0, rejection_threshold=4.0))
    with pytest.raises(ParameterError, match='gains, confirmations can only be set'):
        estimator.change_settings(Settings(gains='constant', confirmations=9, gain_k=7.0))
    assert estimator.settings == Settings(gain_k=1.0, rejection_threshold=4.0)


@pytest.mark.parametrize('gains', ['scheduled', 'riccati'])
def test_settings_that_change_while_running_count_from_then_on(gains):
    settings = Settings(gains=gains, reorder_window=0.0, max_hypotheses=1)

    def rejected(estimator, step):
        before = estimator.counts['rejected_landmark']
        estimator.add(VelocityEvent(START_NS + step * 10**8, np.zeros(6)))
        seen = LANDMARKS + (step >= 10) * np.array([[1.5, 0, 0], *4 * [[0.0, 0, 0]]])
        estimator.add(ObservationEvent(START_NS + step * 10**8, np.arange(5), seen))
        return estimator.counts['rejected_landmark'] - before

    for changed, expected in ((settings, 1), (replace(settings, rejection_threshold=1e6), 0)):
        estimator = Estimator(settings)
        for step in range(10):
            assert rejected(estimator, step) == 0
        estimator.change_settings(changed)
        assert rejected(estimator, 10) == expected


@pytest.mark.parametrize('gains', ['scheduled', 'riccati'])
@pytest.mark.parametrize(
    ('model', 'noise'),
    [
        ('range_bearing', {'angular_velocity_noise': (0.1, 0.2, 0.3)}),
        ('range_bearing', {'linear_velocity_noise': (0.1, 0.2, 0.3)}),
        ('range_bearing', {'range_noise': 0.4}),
        ('range_bearing', {'bearing_noise': 0.2}),
        ('cartesian', {'point_noise': 0.3}),
        ('stereo', {'pixel_noise': 5.0}),
        ('stereo', {'disparity_noise': 5.0}),
    ],
)
def test_noise_that_changes_while_running_counts_from_then_on(gains, model, noise):
    before = Settings(gains=gains, observation_model=model, confirmations=1)
    changed, from_the_start = Estimator(before), Estimator(replace(before, **noise))
    changed.change_settings(replace(before, **noise))
    unchanged = Estimator(before)
    for event in drive(2.0):
        for estimator in (changed, from_the_start, unchanged):
            estimator.add(event)
    np.testing.assert_array_equal(changed.pose, from_the_start.pose)
    assert np.abs(changed.pose - unchanged.pose).max() > 1e-6
    if gains == 'riccati':
        covariances = [each.pose_covariance for each in (changed, from_the_start, unchanged)]
        np.testing.assert_array_equal(*covariances[:2])
        assert not np.allclose(*covariances[1:], rtol=1e-2, atol=0.0)


def test_what_is_no_settings_is_refused():
    with pytest.raises(ParameterError, match='settings are wanted, not a dict'):
        Estimator({'gains': 'riccati'})


MIRRORED = np.diag([1.0, 1.0, -1.0, 1.0])


@pytest.mark.parametrize(
    ('pose', 'covariance'),
    [
        (np.full((4, 4), np.nan), None),
        (2.0 * np.eye(4), None),
        (MIRRORED, None),
        (np.eye(3), None),
        (np.eye(4).tolist(), None),
        (np.eye(4), -np.eye(6)),
        (np.eye(4), np.eye(3)),
    ],
    ids=['NaN', 'scaled', 'mirrored', '3 × 3', 'list', 'negative', 'small'],
)
def test_no_pose_that_can_not_be_right_is_taken(pose, covariance):
    estimator = Estimator(Settings())
    with pytest.raises(ParameterError, match='pose'):
        estimator.set_pose(pose, covariance)
    surveyed = LandmarkMap(np.arange(2), np.ones((2, 3)), None, np.zeros(2, dtype=np.int64))
    with pytest.raises(ParameterError, match='pose'):
        estimator.load_map(surveyed, pose, covariance)
    if covariance is None:
        with pytest.raises(ParameterError, match='pose'):
            Estimator(Settings(), pose)
    assert estimator.is_localised
    assert_array_equal(estimator.pose, np.eye(4))


@pytest.mark.parametrize(
    ('changes', 'reason'),
    [
        ({'world_points': np.full((2, 3), np.nan)}, 'map points is NaN'),
        ({'world_points': np.zeros((1, 3))}, r'map points: shape \(1, 3\)'),
        ({'ids': np.array([7, 7])}, 'more than once'),
        ({'ids': np.array([7.5, 8.0])}, 'map ids: integers'),
        ({'ids': np.array([7, -1])}, 'map ids: integers'),
        ({'ids': np.array([7, 2**33])}, 'map ids: integers'),
        ({'counts': np.array([1, -1])}, 'negative'),
        ({'counts': np.zeros(1, dtype=np.int64)}, 'map counts: shape'),
        ({'covariances': -np.tile(np.eye(3), (2, 1, 1))}, 'negative eigenvalue'),
    ],
)
def test_no_map_that_can_not_be_right_is_taken(changes, reason):
    good = LandmarkMap(np.arange(2), np.ones((2, 3)), None, np.zeros(2, dtype=np.int64))
    estimator = Estimator(Settings())
    with pytest.raises(MapError, match=reason):
        estimator.load_map(replace(good, **changes))
    assert estimator.is_localised


def stated(stamp_s, body_velocity, covariance):
    return replace(velocity(stamp_s, body_velocity), covariance=covariance)


def test_a_velocity_has_the_covariance_that_came_with_it():
    covariance = np.diag([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]) ** 2
    covariance[2, 3] = covariance[3, 2] = 0.01
    events = [stated(0.1 * k, BODY_VELOCITY, covariance) for k in range(5)]
    settings = {'reorder_window': 0.0, 'angular_bias_stddev': (0.0,) * 3}
    assert_allclose(run(events, **settings).body_velocity_covariance, covariance)
    planar = run(events, **settings, two_d_mode=True).body_velocity_covariance
    assert_allclose(planar[2:5, 2:5], covariance[2:5, 2:5])
    assert np.count_nonzero(planar) == 5, 'exactly zero out of the plane'


def test_a_velocity_without_covariance_has_what_the_settings_say_of_one_message():
    events = [velocity(0.1 * k) for k in range(5)]
    settings = {'linear_velocity_noise': (0.2, 0.3, 0.4), 'reorder_window': 0.0}
    assert run(events[:1], **settings).body_velocity_covariance is None
    covariance = run(events, **settings).body_velocity_covariance
    assert_allclose(np.sqrt(np.diag(covariance)[3:] * 0.1), [0.2, 0.3, 0.4])
    settings |= {'velocity_timeout': 0.5, 'unknown_linear_motion': 5.0}
    silent = run([*events, observation(3.0, [1])], **settings)
    assert silent.velocity_is_stale
    assert_allclose(np.sqrt(np.diag(silent.body_velocity_covariance)[3:] * 0.1), 5.0)


def test_the_covariance_of_a_velocity_is_calibrated_as_the_velocity_is():
    settings = {'linear_scale_stddev': (0.1, 0.0, 0.0), 'linear_bias_stddev': (0.0, 0.2, 0.0)}
    covariance, speed = np.diag(np.full(6, 0.01)), np.array([0.0, 0.0, 0.0, 3.0, 0.0, 0.0])
    events = [stated(0.1 * k, speed, covariance) for k in range(5)]
    estimator = run(events, reorder_window=0.0, **settings)
    variances = np.diag(estimator.body_velocity_covariance)[3:]
    assert_allclose(variances, [0.01 + (0.1 * 3.0) ** 2, 0.01 + 0.2**2, 0.01])


def test_landmarks_that_always_come_after_their_velocities_are_counted_as_late():
    estimator = Estimator(Settings())
    for step in range(100):
        estimator.add(velocity(0.05 * step))
        if step >= 20:
            estimator.add(observation(0.05 * step - 1.0))
    estimator.flush()
    assert estimator.counts['late_observation'] == estimator.counts['observation'] == 80


@pytest.mark.parametrize(('by_s', 'text'), [(-300.0, 'back by 30'), (5000.0, 'ahead by 500')])
def test_of_a_jump_of_the_clock_it_is_said_by_how_much_and_which_way(caplog, by_s, text):
    estimator = Estimator(Settings())
    for step in range(30):
        estimator.add(velocity(400.0 + 0.05 * step + by_s * (step >= 20)))
    assert caplog.text.count('The clock has jumped') == 1
    assert f'The clock has jumped {text}' in caplog.text or 'back by 299' in caplog.text
