"""A sparse estimate is filled with the motion that led through it."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from slam_observer_ros.lie import se3
from slam_observer_ros.recordings.trajectory import filled, Trajectory

SECONDS = np.arange(0.0, 20.0, 0.1)
STAMPS_NS = np.rint(SECONDS * 1e9).astype(np.int64)
V = np.array([0.0, 0.1, 0.4, 1.0, 0.0, 0.0])
DRIFT = np.array([0.0, 0.0, 0.01, 0.02, 0.01, 0.0])
ELSEWHERE = se3.exp(np.array([0.3, -0.2, 1.0, 5.0, -3.0, 2.0]))

TRUE = Trajectory(STAMPS_NS, se3.exp(SECONDS[:, None] * V))
DRIFTING = Trajectory(STAMPS_NS, ELSEWHERE @ se3.exp(SECONDS[:, None] * (V + DRIFT)))


def at(rows):
    return Trajectory(TRUE.stamps_ns[rows], TRUE.poses[rows])


def test_blind_stretches_are_filled_along_the_way_that_was_driven():
    rows = np.array([10, 11, 90, 150])  # all but half a turn is between two of them
    all_of_it = filled(at(rows), DRIFTING, STAMPS_NS)
    assert_array_equal(all_of_it.stamps_ns, STAMPS_NS)
    assert_allclose(all_of_it.poses[rows], TRUE.poses[rows], atol=1e-12)
    # Of a metre of drift in a gap hardly anything is left.
    assert_allclose(all_of_it.positions[10:151], TRUE.positions[10:151], atol=0.05)
    # Before the first pose and after the last one it drifts on from there.
    assert_allclose(all_of_it.positions[:10], TRUE.positions[:10], atol=0.05)
    assert_allclose(all_of_it.positions[151:171], TRUE.positions[151:171], atol=0.1)


def test_stamps_of_estimate_and_motion_need_not_be_those_that_are_asked_for():
    wanted_ns = STAMPS_NS[25:55] + 30_000_000
    estimate = at(np.array([20, 60]))
    sparse = Trajectory(DRIFTING.stamps_ns[::2] + 10_000_000, DRIFTING.poses[::2])
    expected = se3.exp(wanted_ns[:, None] * 1e-9 * V)[:, :3, 3]
    assert_allclose(filled(estimate, sparse, wanted_ns).positions, expected, atol=0.05)


def test_a_motion_that_ends_a_little_early_goes_on_as_it_did():
    short = Trajectory(DRIFTING.stamps_ns[:100], DRIFTING.poses[:100])
    end = filled(at(np.array([50, 90])), short, STAMPS_NS[[100]])
    assert_allclose(end.positions, TRUE.positions[[100]], atol=0.05)


def test_where_no_motion_is_known_the_estimate_stays_as_it_is():
    empty = Trajectory(np.empty(0, dtype=np.int64), np.empty((0, 4, 4)))
    rows = np.array([10, 90, 150])
    assert_array_equal(filled(at(rows), empty, STAMPS_NS).stamps_ns, STAMPS_NS[rows])
    assert len(filled(empty, DRIFTING, STAMPS_NS)) == 0
