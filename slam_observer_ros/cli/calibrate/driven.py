"""What a recording's velocities are like, and settings under which their calibration is found."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.events import AngularVelocityEvent, Event, ObservationEvent, VelocityEvent
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.parameter_table import Value

ROTATION, TRANSLATION = (0.1,) * 3, (0.1,) * 3
"""How a sensor may be mounted: some 6° and 10 cm off what is stated."""

SCALE, BIAS, DELAY_S = 0.1, 0.02, 0.3
"""How far scales, of ranges and velocities, a gyroscope's zero (rad/s) and a clock may be off."""

NOISY = 0.05
"""Share of noise in the velocities, squared, beyond which a known map shows no scale of theirs."""

_PER_MEDIAN = 1.4826
"""Standard deviation over the median of the absolute value, of normal distributions."""


@dataclass(frozen=True, slots=True)
class Driven:
    """Per axis (6,), angular first: root mean square of the velocity, and its ``noise_share``.

    That is the square of how noisy the mean between two observations is, over that of what it
    usually is: by so much noise that passes for motion makes a scale too small. It is 1 on an
    axis along which nothing moves.
    """

    rms: FloatArray
    noise_share: FloatArray


def driven(events: Sequence[Event]) -> Driven:
    """Return what the velocities of a recording are like."""
    seen_ns = np.array([event.stamp_ns for event in events if isinstance(event, ObservationEvent)])
    every_ns = float(np.median(np.diff(seen_ns))) if len(seen_ns) > 1 else 0.0
    velocities = [event for event in events if isinstance(event, VelocityEvent)]
    V = np.array([event.body_velocity for event in velocities]).reshape(-1, 6)
    found = _of_axes(np.array([event.stamp_ns for event in velocities]), V, every_ns)
    turns = [event for event in events if isinstance(event, AngularVelocityEvent)]
    if turns:  # which are used in place of the others
        W = np.array([event.angular_velocity for event in turns])
        of_turns = _of_axes(np.array([event.stamp_ns for event in turns]), W, every_ns)
        for mine, other in zip(found, of_turns, strict=True):
            mine[:3] = other
    return Driven(*found)


def opened(
    settings: Settings, kept: Collection[str], motion: Driven, is_surveyed: bool
) -> Settings:
    """Return settings that know little of all that is calibrated, but for those to be ``kept``.

    With neither a surveyed map nor a scale of the wheels that is known, that of ranges is as
    stated: nothing shows how large a map is, but noise in metres, which makes a smaller one more
    likely. Noise in proportion to the speed is
    taken to be the same all the time: as noisy velocities state it, those too small by chance
    would weigh more, and scales come out too large.
    """
    is_usable = motion.noise_share < (NOISY if is_surveyed else 1.0)
    scales = np.where(is_usable, SCALE, 0.0)
    stated = np.array([settings.angular_velocity_noise, settings.linear_velocity_noise])
    growing = np.array([settings.angular_scale_noise, settings.linear_scale_noise])
    noise = np.hypot(stated, growing * motion.rms.reshape(2, 3))
    least: dict[str, Value] = {
        'sensor_rotation_stddev': ROTATION,
        'sensor_translation_stddev': TRANSLATION,
        'range_scale_stddev': SCALE,
        'angular_bias_stddev': (BIAS,) * 3,
        'velocity_delay_stddev': DELAY_S,
    }
    wide: dict[str, Any] = {
        name: _at_least(getattr(settings, name), value) for name, value in least.items()
    }
    if not is_surveyed and 'linear_scale_stddev' not in kept:
        wide['range_scale_stddev'] = 0.0
    wide |= {
        'angular_scale_stddev': tuple(scales[:3].tolist()),
        'linear_scale_stddev': tuple(scales[3:].tolist()),
    }
    return replace(
        settings,
        **{name: value for name, value in wide.items() if name not in kept},
        angular_velocity_noise=tuple(noise[0].tolist()),
        linear_velocity_noise=tuple(noise[1].tolist()),
        angular_scale_noise=(0.0, 0.0, 0.0),
        linear_scale_noise=(0.0, 0.0, 0.0),
        calibration_drift=0.0,
        smoothing_window=0,
        localization_mode='uncertain' if is_surveyed else 'off',
    )


def _at_least(stated: Value, least: Value) -> Value:
    entries = np.maximum(stated, least).tolist()
    return tuple(entries) if isinstance(entries, list) else float(entries)


def _of_axes(stamps_ns: IntArray, V: FloatArray, every_ns: float) -> tuple[FloatArray, FloatArray]:
    """Return the root mean squares of velocities (k, q), and the shares of noise in them."""
    if len(V) < 3 or every_ns <= 0.0:
        return np.zeros(V.shape[1]), np.ones(V.shape[1])
    period_ns = float(np.median(np.diff(stamps_ns)))
    variances = 0.5 * (_PER_MEDIAN * np.median(np.abs(np.diff(V, axis=0)), axis=0)) ** 2
    count = max(round(every_ns / max(period_ns, 1.0)), 1)
    squares = _mean_squares(V, count)
    share = np.where(squares > 0.0, variances / count / np.maximum(squares, 1e-30), 1.0)
    a_second = max(round(NANOSECONDS_PER_SECOND / max(period_ns, 1.0)), 1)
    return np.sqrt(_mean_squares(V, a_second)), np.minimum(share, 1.0)


def _mean_squares(V: FloatArray, count: int) -> FloatArray:
    """Return those of the means of so many velocities (k, q) in a row."""
    count = min(count, len(V))
    means = V[: len(V) // count * count].reshape(-1, count, V.shape[1]).mean(axis=1)
    return np.asarray((means**2).mean(axis=0))
