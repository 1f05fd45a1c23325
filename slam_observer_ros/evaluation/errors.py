"""Exceptions of the evaluation package."""

from __future__ import annotations

from slam_observer_ros.errors import SlamObserverError


class EvaluationError(SlamObserverError):
    """A trajectory, its file or a pair of point sets can't be evaluated."""
