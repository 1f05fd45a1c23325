"""Landmarks that move: with velocities that messages state, or that are estimated."""

from __future__ import annotations

from dataclasses import replace

from estimator_runs import (
    assert_same_state,
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
import pytest

from slam_observer_ros.common.errors import ParameterError
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.settings.estimator_settings import Settings


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


def test_gains_that_estimate_no_velocities_of_landmarks_take_them_as_messages_say():
    settings = Settings(gains='constant', landmark_velocity_stddev=0.5, confirmations=1)
    estimator, speeds = Estimator(settings), np.full((5, 3), 0.1)
    for time_s, reported, expected in [(0.0, speeds, speeds), (0.1, None, 0.0 * speeds)]:
        estimator.add(velocity(time_s, np.zeros(6)))
        event = ObservationEvent(observation(time_s).stamp_ns, np.arange(5), LANDMARKS)
        estimator.add(replace(event, velocities=reported))
        estimator.release()
        np.testing.assert_allclose(estimator.landmark_velocities, expected, atol=1e-9)


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
