"""What a replay measures: the poses of the estimator and of the velocities alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
import pytest

from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.geometry import se3
from slam_observer_ros.recording.truth import Truth
from slam_observer_ros.replay import replay
from slam_observer_ros.sampling import SAMPLE_PERIOD_NS
from slam_observer_ros.settings import Settings

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


def test_there_is_no_dead_reckoning_without_velocities():
    result = replay(events_of(100, 5, has_velocities=False), Settings())
    assert len(result.dead_reckoning.poses) == 0
    assert len(result.trajectory.poses) > 0


def test_covariances_are_collected_only_to_compare_errors_with():
    stamps_ns = np.array([0, 8 * SECOND])
    truth = Truth(stamps_ns, se3.exp(TWIST * stamps_ns[:, None] / SECOND), None)
    nothing = Truth(stamps_ns[:0], truth.poses[:0], None)

    result = replay(events_of(400, 7), Settings(), truth)
    assert result.pose_covariances.shape == (len(result.trajectory.poses), 6, 6)
    for lacking in (nothing, None):
        assert replay(events_of(400, 7), Settings(), lacking).pose_covariances is None


def test_what_was_seen_before_a_jump_is_not_smoothed_and_hindsight_says_why():
    before, after = events_of(100, 5), events_of(60, 5)
    later = [replace(event, stamp_ns=event.stamp_ns + 1000 * SECOND) for event in before]
    settings = Settings(on_time_jump='hold', reorder_window=0.5)
    result = replay([*later, *after], settings)
    assert result.estimator.jumps == 1
    smoothed = result.estimator.smooth()
    assert len(smoothed.stamps_ns) < result.observations
    assert (smoothed.stamps_ns < 1000 * SECOND).all()
    assert smoothed.since == 'the clock jumped'
