"""What is tuned: the noise figures, and nothing else, by a factor for each kind of error.

Figures of one kind keep their proportions: how much of an error grows with the speed or with the
range, and along which axis it is, a recording seldom shows. One that is zero stays zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import Any

import numpy as np

from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.parameter_table import table, Value

_ROWS = {row.name: row for row in table(Settings)}


@dataclass(frozen=True, slots=True)
class NoiseKind:
    """A kind of error, and the parameters that say how large it is."""

    name: str
    parameters: tuple[str, ...]


_OF_MOTION = (
    NoiseKind('turning', ('angular_velocity_noise', 'angular_scale_noise')),
    NoiseKind('driving', ('linear_velocity_noise', 'linear_scale_noise')),
)
_OF_POINTS = {
    'range_bearing': (
        NoiseKind('range', ('range_noise', 'range_scale_noise')),
        NoiseKind('bearing', ('bearing_noise',)),
    ),
    'fiducial': (NoiseKind('pixels', ('pixel_noise',)),),
    'cartesian': (NoiseKind('points', ('point_noise',)),),
    'stereo': (
        NoiseKind('pixels', ('pixel_noise',)),
        NoiseKind('disparity', ('disparity_noise',)),
    ),
}


def kinds_of(settings: Settings) -> list[NoiseKind]:
    """Return the kinds of error that settings state, each with its figures that are not zero."""
    return [*of_motion(settings), *of_points(settings)]


def of_motion(settings: Settings) -> list[NoiseKind]:
    """Return those of velocities."""
    return _stated(_OF_MOTION, settings)


def of_points(settings: Settings) -> list[NoiseKind]:
    """Return those of points."""
    return _stated(_OF_POINTS[settings.observation_model], settings)


def _stated(possible: Sequence[NoiseKind], settings: Settings) -> list[NoiseKind]:
    kinds = []
    for kind in possible:
        stated = tuple(name for name in kind.parameters if np.any(getattr(settings, name)))
        if stated:
            kinds.append(NoiseKind(kind.name, stated))
    return kinds


def scaled(
    settings: Settings, kinds: Sequence[NoiseKind], log_factors: Sequence[float]
) -> Settings:
    """Return settings whose figures of each kind have grown by a factor, given as its logarithm.

    None gets smaller or larger than its parameter may be.
    """
    values: dict[str, Any] = {}
    for kind, log_factor in zip(kinds, log_factors, strict=True):
        for name in kind.parameters:
            values[name] = _scaled(name, getattr(settings, name), math.exp(log_factor))
    return replace(settings, **values)


def _scaled(name: str, value: Value, factor: float) -> Value:
    row = _ROWS[name]
    entries = value if isinstance(value, tuple) else (float(value),)
    within = tuple(min(max(factor * entry, row.minimum), row.maximum) for entry in entries)
    return within if isinstance(value, tuple) else within[0]
