"""The estimator: pose and map from events in order, gaps, life of landmarks, live settings."""

from __future__ import annotations

from dataclasses import replace

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
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

from slam_observer_ros.common.errors import ParameterError
from slam_observer_ros.estimator import event_warnings
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.estimator.timeline import MAX_PENDING_VELOCITIES
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.settings.estimator_settings import Settings


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


@pytest.mark.parametrize('gains', ['riccati', 'constant'])
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
    (said,) = caplog.messages
    assert said.startswith('No effect on riccati gains: gain_l, step_mode; ')
    caplog.clear()
    Estimator(Settings(gains='constant', **asked)).reset()
    assert [message.partition(';')[0] for message in caplog.messages] == [
        'No effect on constant gains: linear_bias_stddev, calibration_drift, '
        'landmark_velocity_stddev',
    ]


def test_where_many_landmarks_seem_to_move_the_odometry_is_named(caplog):
    estimator = Estimator(Settings(reorder_window=0.0, max_rejections=2))
    for step in range(500):
        estimator.add(velocity(0.1 * step, np.zeros(6)))
        times_moved = (step // 8 + 4 - np.arange(5)) // 5  # one after another
        points = LANDMARKS + 3.0 * np.outer(times_moved, [0.0, 0.0, 1.0])
        estimator.add(ObservationEvent(START_NS + step * 10**8, np.arange(5), points))
    reported = [message for message in caplog.messages if 'seem to have moved' in message]
    assert reported[0].startswith(
        '5 landmarks seem to have moved within a minute: odometry may err'
    )


@pytest.mark.parametrize('gains', GAINS)
def test_a_map_too_large_for_a_dense_covariance_is_reported_once(caplog, monkeypatch, gains):
    monkeypatch.setattr(event_warnings, 'MANY_LANDMARKS', 5)
    run([observation(0.1 * step) for step in range(5)], gains=gains)
    reported = [message for message in caplog.messages if 'The map has 5 landmarks' in message]
    assert len(reported) == (gains == 'riccati')


def test_more_landmarks_at_once_than_may_be_kept_are_reported(caplog):
    run([observation(0.1 * step) for step in range(5)], max_landmarks=3)
    assert '5 points in one message, and max_landmarks is 3' in caplog.text


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
    estimator = Estimator(Settings(reorder_window=0.0, max_points=300))
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
    estimator = Estimator(Settings(reorder_window=0.0, max_rejections=100))
    counted = []
    for step in range(12):
        off = 50.0 * (step in (6, 7, 8, 10, 11)) * np.array([1.0, -2.0, 3.0])
        estimator.add(VelocityEvent(START_NS + step * 10**8, np.zeros(6)))
        estimator.add(ObservationEvent(START_NS + step * 10**8, np.arange(5), LANDMARKS + off))
        counted.append(estimator._hypotheses.best.rejected_in_a_row)
    assert counted == [0, 0, 0, 0, 0, 0, 1, 2, 3, 0, 1, 2]


def test_far_points_said_to_be_all_but_exact_are_taken_after_turning_blindly():
    """Not by zeros, which say unknown."""
    estimator = Estimator(Settings(reorder_window=0.0))
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


def test_only_settings_that_may_change_while_running_do():
    estimator = Estimator(Settings())
    estimator.change_settings(Settings(gain_k=1.0, rejection_threshold=4.0))
    with pytest.raises(ParameterError, match='gains, confirmations can only be set'):
        estimator.change_settings(Settings(gains='constant', confirmations=9, gain_k=7.0))
    assert estimator.settings == Settings(gain_k=1.0, rejection_threshold=4.0)


def test_settings_that_change_while_running_count_from_then_on():
    settings = Settings(reorder_window=0.0, max_hypotheses=1)

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
def test_noise_that_changes_while_running_counts_from_then_on(model, noise):
    before = Settings(observation_model=model, confirmations=1)
    changed, from_the_start = Estimator(before), Estimator(replace(before, **noise))
    changed.change_settings(replace(before, **noise))
    unchanged = Estimator(before)
    for event in drive(2.0):
        for estimator in (changed, from_the_start, unchanged):
            estimator.add(event)
    np.testing.assert_array_equal(changed.pose, from_the_start.pose)
    assert np.abs(changed.pose - unchanged.pose).max() > 1e-6
    covariances = [each.pose_covariance for each in (changed, from_the_start, unchanged)]
    np.testing.assert_array_equal(*covariances[:2])
    assert not np.allclose(*covariances[1:], rtol=1e-2, atol=0.0)


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
