"""The step by the compiled core where it was built, and else by its reference in numpy."""

from __future__ import annotations

import os

from slam_observer_ros.common.process import compiled, VARIABLE
from slam_observer_ros.filter import step
from slam_observer_ros.filter.flat_arrays import (
    Advanced,
    FilterState,
    Interval,
    Limits,
    Observed,
    Seen,
)
from slam_observer_ros.filter.landmark_table import Landmarks
from slam_observer_ros.filter.robust import AT_ONCE
from slam_observer_ros.models.held_velocities import Velocities
from slam_observer_ros.models.motion_noise import Factors, MotionFigures
from slam_observer_ros.models.point_noise import PointFigures

COMPILED = compiled('filter._core')


def description() -> str:
    """Say which of the two it is, and why."""
    if COMPILED is not None:
        return 'C'
    if os.environ.get(VARIABLE) == 'numpy':
        return f'numpy, as {VARIABLE} says'
    return 'numpy, three times slower: the core was not compiled, or from other sources'


MOST_WORK = 1e7
"""Multiplications of a correction of P beyond which numpy, with BLAS, takes less time."""


def advance(
    x: FilterState,
    velocities: Velocities,
    interval: Interval,
    figures: MotionFigures,
    out: Advanced,
) -> int:
    """As :func:`.step.advance`, in C but for what is unusual."""
    if COMPILED is not None:
        status: int = COMPILED.advance(x, velocities, interval, figures, out)
        if status != step.UNUSUAL:
            return status
    return step.advance(x, velocities, interval, figures, out)


def observe(
    x: FilterState,
    landmarks: Landmarks,
    seen: Seen,
    figures: PointFigures,
    limits: Limits,
    factors: Factors | None,
    out: Observed,
) -> int:
    """As :func:`.step.observe`, by whichever of the two takes less time."""
    arguments = x, landmarks, seen, figures, limits, factors, out
    m = len(seen.rows)
    if COMPILED is not None and m <= AT_ONCE and m * x.size**2 <= MOST_WORK / 3.0:
        status: int = COMPILED.observe(*arguments)
        if status != step.UNUSUAL:
            return status
    return step.observe(*arguments)
