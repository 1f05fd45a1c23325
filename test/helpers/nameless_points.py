"""Events whose points lost their ids, and an estimator that stands among points."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID, VelocityEvent
from slam_observer_ros.settings.estimator_settings import Settings

PLANAR = Settings(two_d_mode=True, reorder_window=0.0)
SPATIAL = Settings(reorder_window=0.0)


def observe(estimator, time_s, points, ids=None):
    """Add an observation of body points with ids, by default none."""
    ids = np.full(len(points), UNKNOWN_ID) if ids is None else np.array(ids)
    event = ObservationEvent(round(time_s * 1e9), ids, np.array(points, dtype=float))
    assert estimator.add(event)


def creep(estimator, time_s):
    """Report next to no velocity; where it is exactly zero, the robot stands, and knows it."""
    stand(estimator, time_s, (0, 0, 0, 1e-9, 0, 0))


def stand(estimator, time_s, body_velocity=(0, 0, 0, 0, 0, 0)):
    assert estimator.add(VelocityEvent(round(time_s * 1e9), np.array(body_velocity, dtype=float)))
