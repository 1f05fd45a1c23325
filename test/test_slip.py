"""A robot that is not where odometry has it, told from outliers and from landmarks that moved."""

from __future__ import annotations

from dataclasses import replace

import gain_worlds
from gain_worlds import START_NS
import numpy as np
import pytest

from slam_observer_ros.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.geometry import se3
from slam_observer_ros.settings import Settings

PLANAR = Settings(two_d_mode=True, reorder_window=0.0)
SPATIAL = Settings(reorder_window=0.0)
modes = pytest.mark.parametrize('settings', [PLANAR, SPATIAL], ids=['planar', 'spatial'])
seeds = pytest.mark.parametrize('seed', range(4))


def seconds(event):
    return (event.stamp_ns - START_NS) * 1e-9


def run(world, settings):
    """Return the estimator and how far the position is off after each observation, by time."""
    estimator, errors_m = Estimator(settings), {}
    for event in world.events:
        assert estimator.add(event)
        if isinstance(event, ObservationEvent):
            shift = estimator.pose[:3, 3] - world.true_pose(event.stamp_ns)[:3, 3]
            errors_m[seconds(event)] = np.linalg.norm(shift)
    return estimator, errors_m


def with_slip(world, turn_rad):
    """Let odometry miss a turn at 30 s; nothing is seen for 4 s, then one landmark at a time."""
    events = []
    for event in world.events:
        if isinstance(event, VelocityEvent) and 30.0 <= seconds(event) < 32.0:
            turned = np.array([0.0, 0.0, turn_rad / 2.0, 0.0, 0.0, 0.0])
            event = replace(event, body_velocity=event.body_velocity + turned)
        if isinstance(event, ObservationEvent) and seconds(event) >= 30.0:
            if seconds(event) < 34.0:
                continue
            event = event.select(np.arange(len(event.ids)) == 0)
        events.append(event)
    return replace(world, events=events)


@seeds
@pytest.mark.parametrize('turn_rad', [0.5, -0.8])
def test_a_slip_is_found_out_by_the_second_landmark_that_contradicts_odometry(seed, turn_rad):
    world = with_slip(gain_worlds.drive(PLANAR, 60.0, seed, noise=0.5), turn_rad)
    estimator, errors_m = run(world, PLANAR)
    assert estimator.counts['slip'] == 1
    assert estimator.counts['moved_landmark'] == 0
    assert max(error_m for time_s, error_m in errors_m.items() if time_s > 50.0) < 0.25
    _, lost_m = run(world, replace(PLANAR, max_hypotheses=1))
    assert max(lost_m.values()) > 3.0


@modes
@seeds
def test_a_robot_that_is_carried_is_found_again_at_once(settings, seed):
    world = gain_worlds.drive(settings, 40.0, seed, noise=0.5)
    carried = se3.exp(np.array([0.0, 0.0, 0.8, 1.5, -1.0, 0.0]))

    def seen_from_there(_, event):
        if seconds(event) < 20.0:
            return event
        start = world.true_pose(START_NS + 20_000_000_000)
        moved = start @ carried @ se3.inverse(start)
        pose = world.true_pose(event.stamp_ns)
        return replace(event, points=se3.transform(moved_back(pose, moved), event.points))

    estimator, _ = run(world.with_observations(seen_from_there), settings)
    start = world.true_pose(START_NS + 20_000_000_000)
    pose = start @ carried @ se3.inverse(start) @ world.true_pose(world.events[-1].stamp_ns)
    assert estimator.counts['slip'] >= 1
    assert np.linalg.norm(estimator.pose[:3, 3] - pose[:3, 3]) < 0.3


def moved_back(pose, moved):
    """Return where a point in the body frame is seen by a robot at ``moved`` pose instead."""
    return se3.inverse(moved @ pose) @ pose


@modes
@seeds
@pytest.mark.parametrize('shift_m', [1.0, 4.0])
def test_one_observation_that_is_garbled_as_a_whole_does_not_move_the_robot(
    settings, seed, shift_m
):
    world = gain_worlds.drive(settings, 40.0, seed, noise=0.5)
    off = se3.exp(np.array([0.0, 0.0, 0.5, shift_m, shift_m, 0.0]))

    def garble(_, event):
        is_off = seconds(event) in (20.0, 25.0, 30.0)
        return replace(event, points=se3.transform(off, event.points)) if is_off else event

    estimator, errors_m = run(world.with_observations(garble), settings)
    _, plain_m = run(world, settings)
    assert estimator.counts['slip'] == 0
    assert max(errors_m.values()) < max(plain_m.values()) + 0.1


@modes
@pytest.mark.parametrize('shift_m', [1.0, 2.0])
def test_a_landmark_that_moved_and_is_seen_alone_does_not_throw_the_pose(settings, shift_m):
    """However long; what is seen next tells that it was the landmark."""
    world = gain_worlds.drive(settings, 60.0, 1, noise=0.5, landmarks=6)
    counts = np.bincount(np.concatenate([event.ids for event in world.observations()]))
    one = int(np.argmax(counts))

    def change(_, event):
        if not 30.0 <= seconds(event) < 36.0:
            return event
        event = event.select(event.ids == one)
        back = world.true_pose(event.stamp_ns)[:3, :3].T
        return replace(event, points=event.points + back @ [shift_m, 0.0, 0.0])

    estimator, errors_m = run(world.with_observations(change), settings)
    _, plain_m = run(world, settings)
    assert estimator.counts['rejected_landmark'] >= 1
    assert max(errors_m.values()) < max(plain_m.values()) + 0.3
