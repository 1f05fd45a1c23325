"""Slips in the smoother: what a filter believed in, and all that was seen confirms or not."""

from __future__ import annotations

from dataclasses import replace

import gain_worlds
from gain_worlds import START_NS
import numpy as np
import pytest

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.tracking.matching import match
from slam_observer_ros.tracking.slip import slip

PLANAR = Settings(two_d_mode=True, reorder_window=0.0, smoothing_window=0)
SPATIAL = replace(PLANAR, two_d_mode=False)
modes = pytest.mark.parametrize('settings', [PLANAR, SPATIAL], ids=['planar', 'spatial'])
seeds = pytest.mark.parametrize('seed', range(2))

SLIPS_S = 15.0, 25.0


def seconds(event):
    return (event.stamp_ns - START_NS) / 1e9


def slips_now(event):
    return isinstance(event, ObservationEvent) and seconds(event) in SLIPS_S


@modes
@seeds
def test_a_slip_that_was_none_leaves_nothing_in_what_is_smoothed(settings, seed):
    world = gain_worlds.drive(settings, 40.0, seed, noise=0.5)
    misled, plain = Estimator(settings), gain_worlds.estimate(world, settings)
    for event in world.events:
        if slips_now(event):
            misled._timeline.synchronise(event)
            state = misled._hypotheses.best
            slip(state, match(state, replace(event, points=event.points + [0.5, 0.5, 0.0])))
        assert misled.add(event)
    assert misled.counts['slip'] == len(SLIPS_S)
    smoothed, expected = misled.smooth(), plain.smooth()
    assert smoothed.slips == 0
    np.testing.assert_allclose(smoothed.poses, expected.poses, atol=1e-3)
    np.testing.assert_allclose(smoothed.world_points, expected.world_points, atol=1e-3)


@modes
@seeds
@pytest.mark.parametrize('turn_rad', [0.6, 2.5])
def test_a_slip_that_was_one_stays_one_in_what_is_smoothed(settings, seed, turn_rad):
    """By as much as odometry could hardly have missed, and by far more."""
    world = gain_worlds.drive(settings, 40.0, seed, noise=0.5)
    # What the robot does, and odometry does not report: all is seen from elsewhere from then on.
    strayed = se3.exp(np.array([0.0, 0.0, turn_rad, 0.8, -0.5, 0.0]))
    moved = {time_s: world.true_pose(START_NS + round(time_s * 1e9)) for time_s in SLIPS_S}

    def true_pose(stamp_ns):
        pose = world.true_pose(stamp_ns)
        for time_s, start in reversed(moved.items()):
            if stamp_ns >= START_NS + round(time_s * 1e9):
                pose = start @ strayed @ se3.inverse(start) @ pose
        return pose

    def seen_from_there(_, event):
        back = se3.inverse(true_pose(event.stamp_ns)) @ world.true_pose(event.stamp_ns)
        return replace(event, points=se3.transform(back, event.points))

    estimator = gain_worlds.estimate(world.with_observations(seen_from_there), settings)
    smoothed = estimator.smooth()
    assert smoothed.slips == estimator.counts['slip'] == len(SLIPS_S)
    truth = np.array([true_pose(stamp_ns) for stamp_ns in smoothed.stamps_ns.tolist()])
    off_m = np.linalg.norm(smoothed.poses[:, :3, 3] - truth[:, :3, 3], axis=1)
    assert off_m.max() < 0.3


def test_wheels_that_spin_for_a_while_are_smoothed_as_well_as_if_they_had_not():
    """A second and a half, over several observations: the slip is spread over as many links."""
    world = gain_worlds.drive(PLANAR, 40.0, 1, noise=0.5)

    def spinning(event):
        is_now = isinstance(event, VelocityEvent) and 20.0 <= seconds(event) < 21.5
        turned = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        return replace(event, body_velocity=event.body_velocity + turned) if is_now else event

    slipped = replace(world, events=[spinning(event) for event in world.events])
    estimator = gain_worlds.estimate(slipped, PLANAR)
    smoothed = estimator.smooth()
    assert smoothed.slips > 0
    truth = np.array([world.true_pose(stamp_ns) for stamp_ns in smoothed.stamps_ns.tolist()])
    off_m = np.linalg.norm(smoothed.poses[:, :3, 3] - truth[:, :3, 3], axis=1)
    assert off_m.max() < 0.3
