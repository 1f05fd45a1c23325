"""Poses between those of an estimate that has few."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.evaluation.trajectory import Trajectory
from slam_observer_ros.geometry import se3


def filled(estimate: Trajectory, motion: Trajectory, stamps_ns: IntArray) -> Trajectory:
    """Return an estimate at other stamps (m,), as a motion that drifts passed through it.

    The motion, such as dead reckoning, may be in another world. From each estimated pose on its
    shape is kept; what it misses the next one by is made up for in proportion to the time. Before
    the first and after the last pose it is as it is. Where no motion is known, the estimate is
    returned at its own stamps.
    """
    if len(motion) < 2 or not len(estimate):
        return estimate
    reckoned, wanted = _moved_to(motion, estimate.stamps_ns), _moved_to(motion, stamps_ns)
    # What the motion misses each next pose by, and which share of that it has missed by then.
    arrivals = estimate.poses[:-1] @ se3.inverse(reckoned[:-1]) @ reckoned[1:]
    misses = np.concatenate(
        [se3.log(se3.inverse(arrivals) @ estimate.poses[1:]), np.zeros((1, 6))]
    )
    before = np.searchsorted(estimate.stamps_ns, stamps_ns, side='right') - 1
    start = np.maximum(before, 0)
    durations_ns = np.append(np.diff(estimate.stamps_ns), 1)
    shares = (stamps_ns - estimate.stamps_ns[start]) / durations_ns[start] * (before >= 0)
    moved = estimate.poses[start] @ se3.inverse(reckoned[start]) @ wanted
    return Trajectory(stamps_ns, moved @ se3.exp(shares[:, None] * misses[start]))


def _moved_to(motion: Trajectory, stamps_ns: IntArray) -> FloatArray:
    """Return the poses (m, 4, 4) of a motion at any stamps (m,), beyond its ends going on."""
    before = np.searchsorted(motion.stamps_ns, stamps_ns, side='right') - 1
    before = np.clip(before, 0, len(motion) - 2)
    elapsed_ns = stamps_ns - motion.stamps_ns[before]
    fraction = elapsed_ns / np.diff(motion.stamps_ns)[before]
    # No further than that by as much as the last two are apart.
    limited = np.clip(fraction, 0.0, 2.0)
    return se3.interpolate(motion.poses[before], motion.poses[before + 1], limited)
