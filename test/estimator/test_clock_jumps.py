"""Stamps that jump: one that strays, a clock that was set, a recording that starts over."""

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
import pytest

from slam_observer_ros.common.stamps import AGREEING_STAMPS
from slam_observer_ros.estimator import event_warnings
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.settings.estimator_settings import Settings


def test_landmarks_that_moved_before_a_jump_of_the_clock_did_not_move_lately(caplog):
    warnings = event_warnings.EventWarnings()
    for landmark_id in range(event_warnings.MANY_MOVED):
        stamp_s = 1000 - 200 * landmark_id
        warnings.moved_landmarks(np.array([landmark_id]), stamp_s * 10**9)
    assert 'seem to have moved' not in caplog.text


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


@pytest.mark.parametrize(('by_s', 'text'), [(-300.0, 'back by 30'), (5000.0, 'ahead by 500')])
def test_of_a_jump_of_the_clock_it_is_said_by_how_much_and_which_way(caplog, by_s, text):
    estimator = Estimator(Settings())
    for step in range(30):
        estimator.add(velocity(400.0 + 0.05 * step + by_s * (step >= 20)))
    assert caplog.text.count('The clock has jumped') == 1
    assert f'The clock has jumped {text}' in caplog.text or 'back by 299' in caplog.text
