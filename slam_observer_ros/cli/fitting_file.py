"""Which shipped parameter file fits a recording, by how the robot moves and what it sees."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import VelocityEvent
from slam_observer_ros.messages.detections import APRILTAGS
from slam_observer_ros.messages.poses import TRANSFORMS
from slam_observer_ros.recording.reader import Recording

MOST_EVENTS = 20_000
"""Events of a recording that are looked at, from its start."""

OUT_OF_PLANE = 0.1
"""Share of turning or of speed beyond which a robot is not on a floor."""

REPEATED = 0.5
"""Share of the velocities that are exactly the one before beyond which they are commands."""


def fitting_file(path: Path) -> tuple[str, str]:
    """Return the name of a shipped parameter file, and in words why it fits a recording."""
    with Recording(path) as recording:
        selected = recording.find_topics()
        kind = selected.landmarks.message_type
        events = islice(recording.events(selected), MOST_EVENTS)
        velocities = np.array(
            [event.body_velocity for event in events if isinstance(event, VelocityEvent)]
        ).reshape(-1, 6)
    flat = _is_flat(velocities)
    where = 'the robot stays on a floor' if flat else 'it tilts or climbs: two_d_mode: false'
    if kind == TRANSFORMS:
        return 'tags_on_tf', f'tags are on /tf, and {where}'
    if kind == APRILTAGS:
        return 'apriltags', f'landmarks are AprilTags, and {where}'
    if not flat:
        return 'stereo_inertial', 'it tilts or climbs, as what is moved by hand or flies'
    if _are_commands(velocities):
        return (
            'wheeled_bearing_range',
            f'{where}, and its velocities are commands: most are exactly the one before',
        )
    return 'wheeled_robot', f'{where}, and its velocities are measured'


def _is_flat(velocities: FloatArray) -> bool:
    """Return whether hardly any of the motion is out of the plane z = 0."""
    squares = (velocities**2).sum(axis=0)
    tilting, climbing = squares[:2].sum(), squares[5]
    limit = OUT_OF_PLANE**2
    return bool(tilting <= limit * squares[:3].sum() and climbing <= limit * squares[3:].sum())


def _are_commands(velocities: FloatArray) -> bool:
    moving = velocities[velocities.any(axis=1)]
    if len(moving) < 2:
        return False
    return bool(np.mean((moving[1:] == moving[:-1]).all(axis=1)) > REPEATED)
