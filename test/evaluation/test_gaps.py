"""A sparse estimate is filled with the motion that led through it."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from slam_observer_ros.evaluation.gaps import fill_gaps
from slam_observer_ros.evaluation.trajectory import Trajectory
from slam_observer_ros.geometry import se3

SECONDS = np.arange(0.0, 20.0, 0.1)
STAMPS_NS = np.rint(SECONDS * 1e9).astype(np.int64)
V = np.array([0.0, 0.1, 0.4, 1.0, 0.0, 0.0])
DRIFT = np.array([0.0, 0.0, 0.01, 0.02, 0.01, 0.0])
ELSEWHERE = se3.exp(np.array([0.3, -0.2, 1.0, 5.0, -3.0, 2.0]))

TRUE = Trajectory(STAMPS_NS, se3.exp(SECONDS[:, None] * V))
DRIFTING = Trajectory(STAMPS_NS, ELSEWHERE @ se3.exp(SECONDS[:, None] * (V + DRIFT)))


def at(rows):
    return Trajectory(TRUE.stamps_ns[rows], TRUE.poses[rows])


def test_a_blind_stretch_is_filled_along_the_way_that_was_driven():
    rows = np.array([10, 11, 90, 150])  # all but half a turn is between two of them
    filled = fill_gaps(at(rows), DRIFTING)
    assert_array_equal(filled.stamps_ns, STAMPS_NS[10:151])
    kept = np.isin(filled.stamps_ns, STAMPS_NS[rows])
    assert_array_equal(filled.poses[kept], TRUE.poses[rows])
    # Of a metre of drift in a gap hardly anything is left.
    assert_allclose(filled.positions, TRUE.positions[10:151], atol=0.05)


def test_poses_between_the_stamps_of_the_motion_are_kept():
    stamps_ns = STAMPS_NS[[20, 60]] + 30_000_000
    estimate = Trajectory(stamps_ns, se3.exp(stamps_ns[:, None] * 1e-9 * V))
    filled = fill_gaps(estimate, DRIFTING)
    assert_array_equal(filled.stamps_ns, [stamps_ns[0], *STAMPS_NS[21:61], stamps_ns[1]])
    assert_allclose(filled.positions[1:-1], TRUE.positions[21:61], atol=0.05)


def test_poses_of_before_and_after_the_motion_are_kept():
    motion = Trajectory(DRIFTING.stamps_ns[20:160], DRIFTING.poses[20:160])
    rows = np.array([10, 40, 60, 180])
    assert_array_equal(fill_gaps(at(rows), motion).stamps_ns, STAMPS_NS[[10, *range(40, 61), 180]])


def test_a_motion_with_pauses_is_used_as_well():
    sparse = Trajectory(DRIFTING.stamps_ns[::20], DRIFTING.poses[::20])  # every two seconds
    filled = fill_gaps(at(np.array([30, 90])), sparse)
    assert_array_equal(filled.stamps_ns, STAMPS_NS[[30, 40, 60, 80, 90]])


def test_where_no_motion_is_known_the_estimate_stays_as_it_is():
    empty = Trajectory(np.empty(0, dtype=np.int64), np.empty((0, 4, 4)))
    short = Trajectory(DRIFTING.stamps_ns[:15], DRIFTING.poses[:15])
    for motion in (empty, short):
        filled = fill_gaps(at(np.array([10, 90, 150])), motion)
        assert_array_equal(filled.stamps_ns, STAMPS_NS[[10, 90, 150]])
    assert len(fill_gaps(empty, DRIFTING)) == 0
