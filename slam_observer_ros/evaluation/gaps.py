"""Poses between those of an estimate that has few."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.evaluation.trajectory import interpolate, Trajectory
from slam_observer_ros.geometry import se3


def fill_gaps(estimate: Trajectory, motion: Trajectory) -> Trajectory:
    """Add the poses between those of an estimate, as a motion that drifts passed through them.

    The motion, such as dead reckoning, may be in another world. From each estimated pose on its
    shape is kept; what it misses the next one by is made up for in proportion to the time.
    """
    reckoned, covered = interpolate(motion, estimate.stamps_ns, max_gap_ns=np.iinfo(np.int64).max)
    if covered.sum() < 2:
        return estimate
    # What lies between the poses that the motion covers
    stamps_ns, poses = estimate.stamps_ns[covered], estimate.poses[covered]
    reckoned = reckoned[covered]
    between = (motion.stamps_ns > stamps_ns[0]) & (motion.stamps_ns < stamps_ns[-1])
    between &= ~np.isin(motion.stamps_ns, stamps_ns)
    wanted_ns = motion.stamps_ns[between]
    before = np.searchsorted(stamps_ns, wanted_ns) - 1

    # What the motion misses each next pose by, shared out over the time
    arrivals = poses[:-1] @ se3.inverse(reckoned[:-1]) @ reckoned[1:]
    misses = se3.log(se3.inverse(arrivals) @ poses[1:])
    shares = (wanted_ns - stamps_ns[before]) / np.diff(stamps_ns)[before]
    moved = poses[before] @ se3.inverse(reckoned[before]) @ motion.poses[between]
    filled = moved @ se3.exp(shares[:, None] * misses[before])
    return Trajectory.from_samples(
        [*estimate.stamps_ns.tolist(), *wanted_ns.tolist()], [*estimate.poses, *filled]
    )
