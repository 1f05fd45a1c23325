"""TUM files, as other programs read them."""

from __future__ import annotations

from decimal import Decimal
from pathlib import Path

import numpy as np

from slam_observer_ros.lie import se3, so3
from slam_observer_ros.recordings.trajectory import Trajectory


def read_tum(path: Path) -> Trajectory:
    """Read lines of ``t x y z qx qy qz qw`` after a comment, stamps to the nanosecond."""
    comment, *lines = path.read_text(encoding='ascii').splitlines()
    assert comment.startswith('#')
    rows = [line.split() for line in lines]
    stamps_ns = np.array([int(Decimal(row[0]) * 10**9) for row in rows], dtype=np.int64)
    numbers = np.array([row[1:] for row in rows], dtype=np.float64).reshape(-1, 7)
    return Trajectory(stamps_ns, se3.pose(so3.from_quaternion(numbers[:, 3:]), numbers[:, :3]))
