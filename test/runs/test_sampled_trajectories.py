"""What a replay measures: the poses of the estimator and of the velocities alone."""

from __future__ import annotations

from dataclasses import replace
import gc
import tracemalloc

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.recordings.trajectory import Truth
from slam_observer_ros.runs.recorders import SAMPLE_PERIOD_NS
from slam_observer_ros.runs.replay import replay
from slam_observer_ros.settings.estimator_settings import Settings

SECOND = 10**9
STEP_NS = 20_000_000
TWIST = np.array([0.0, 0.1, 0.5, 1.0, 0.2, 0.0])
IDS, POINTS = np.arange(3), np.array([[3.0, 0.0, 1.0], [0.0, 3.0, 0.0], [-2.0, 1.0, 2.0]])


def events_of(steps, observation_every, has_velocities=True):
    """Velocities, and landmarks that seem to stand still before the moving robot."""
    for step in range(steps):
        if has_velocities:
            yield VelocityEvent(step * STEP_NS, TWIST)
        if step % observation_every == 0:
            yield ObservationEvent(step * STEP_NS, IDS, POINTS)


@pytest.mark.parametrize('observation_every', [7, 1000])
@pytest.mark.parametrize('gains', ['constant', 'riccati'])
def test_dead_reckoning_follows_the_velocities_whatever_is_seen(observation_every, gains):
    result = replay(events_of(400, observation_every), Settings(gains=gains))

    reckoned = result.dead_reckoning
    t_s = reckoned.stamps_ns / SECOND
    assert reckoned.stamps_ns[0] == 0
    assert reckoned.stamps_ns[-1] > 399 * STEP_NS - SAMPLE_PERIOD_NS
    assert np.diff(reckoned.stamps_ns).min() >= SAMPLE_PERIOD_NS
    assert_allclose(reckoned.poses, se3.exp(TWIST * t_s[:, None]), atol=1e-9)


def test_dead_reckoning_holds_its_pose_where_no_velocity_is_in_force():
    events = [VelocityEvent(0, TWIST), ObservationEvent(5 * SECOND, IDS, POINTS)]
    reckoned = replay(events, Settings(velocity_timeout=1.0)).dead_reckoning
    assert_allclose(reckoned.poses[-1], se3.exp(TWIST * 1.0), atol=1e-12)


def test_memory_does_not_grow_with_a_replay_of_which_not_all_is_kept():
    held_bytes = []

    def events():
        for number, event in enumerate(events_of(3000, 5000)):
            if number in (1000, 3000):
                gc.collect()
                held_bytes.append(tracemalloc.get_traced_memory()[0])
            yield event

    tracemalloc.start()
    try:
        result = replay(events(), Settings(gains='constant'), keep_all=False)
    finally:
        tracemalloc.stop()
    assert held_bytes[1] - held_bytes[0] < 2000  # a byte a message
    assert len(result.trajectory) == 0
    assert result.localised_ns == (0, 2999 * STEP_NS)
    assert result.dead_reckoning.stamps_ns[[0, -1]].tolist() == [0, 2997 * STEP_NS]


def test_there_is_no_dead_reckoning_without_velocities():
    result = replay(events_of(100, 5, has_velocities=False), Settings())
    assert len(result.dead_reckoning.poses) == 0
    assert len(result.trajectory.poses) > 0


@pytest.mark.parametrize('window_s', [0.0, 0.25])
def test_the_trajectory_does_not_depend_on_the_order_of_arrival(window_s):
    """Nor on how long events are held back to be put in order."""
    in_order = list(events_of(400, 3))
    rng = np.random.default_rng(0)
    received_ns = [event.stamp_ns + window_s * SECOND * rng.uniform() for event in in_order]
    arrivals = [in_order[i] for i in np.argsort(received_ns, kind='stable')]
    expected = replay(in_order, Settings(reorder_window=0.0)).trajectory
    trajectory = replay(arrivals, Settings(reorder_window=window_s)).trajectory
    assert_array_equal(trajectory.stamps_ns, expected.stamps_ns)
    assert_array_equal(trajectory.poses, expected.poses)


@pytest.mark.parametrize('window_s', [0.0, 0.05])
def test_the_last_pose_before_a_jump_of_the_clock_is_kept(window_s):
    before = list(events_of(200, 5))
    after = [replace(event, stamp_ns=event.stamp_ns + 1000 * SECOND) for event in before]
    settings = Settings(reorder_window=window_s, on_time_jump='hold')
    stamps_ns = replay(before + after, settings).trajectory.stamps_ns
    kept = stamps_ns[stamps_ns < 500 * SECOND]
    assert kept[-1] > before[-1].stamp_ns - SAMPLE_PERIOD_NS
    assert np.sum(stamps_ns > 500 * SECOND) >= len(kept) - 5


def test_of_events_with_one_stamp_the_last_one_counts():
    events = list(events_of(400, 3))
    updates = {}
    estimator = Estimator(Settings(), on_update=lambda new: updates.update({new.stamp_ns: new}))
    for event in events:
        estimator.add(event)
    trajectory = replay(events, Settings()).trajectory
    seen = [stamp_ns in updates for stamp_ns in trajectory.stamps_ns.tolist()]
    assert sum(seen) > 30
    expected = [updates[stamp_ns].pose for stamp_ns in trajectory.stamps_ns[seen].tolist()]
    assert_array_equal(trajectory.poses[seen], expected)


def test_covariances_are_collected_only_to_compare_errors_with():
    stamps_ns = np.array([0, 8 * SECOND])
    truth = Truth(stamps_ns, se3.exp(TWIST * stamps_ns[:, None] / SECOND), None)
    nothing = Truth(stamps_ns[:0], truth.poses[:0], None)

    result = replay(events_of(400, 7), Settings(), truth)
    assert result.pose_covariances.shape == (len(result.trajectory.poses), 6, 6)
    for missing in (nothing, None):
        assert replay(events_of(400, 7), Settings(), missing).pose_covariances is None


def test_what_was_seen_before_a_jump_is_not_smoothed_and_the_reason_is_given():
    before, after = events_of(100, 5), events_of(60, 5)
    later = [replace(event, stamp_ns=event.stamp_ns + 1000 * SECOND) for event in before]
    settings = Settings(on_time_jump='hold', reorder_window=0.5)
    result = replay([*later, *after], settings)
    assert result.estimator.jumps == 1
    smoothed = result.estimator.smooth()
    assert len(smoothed.stamps_ns) < result.observations
    assert (smoothed.stamps_ns < 1000 * SECOND).all()
    assert smoothed.since == 'the clock jumped'
