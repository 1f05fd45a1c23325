"""What a recording shows: estimated with wide priors, and what else is likely by comparison."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
import math
from typing import Any

import numpy as np

from slam_observer_ros.cli.calibration_stated import COMMON_SCALE, Found, trades
from slam_observer_ros.cli.held_out import judge, Judged, Material, SURE
from slam_observer_ros.cli.noise_search import (
    kinds_of,
    NoiseFactor,
    of_points,
    scaled,
    search_noise,
)
from slam_observer_ros.common.errors import UsageError
from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND, to_ns
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import CalibrationEstimate, DELAY_NAME
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import AngularVelocityEvent, Event, ObservationEvent, VelocityEvent
from slam_observer_ros.lie.axes import axes_of
from slam_observer_ros.models.calibration import OF_VELOCITY
from slam_observer_ros.models.sensing import cosines, LEAST_COSINE
from slam_observer_ros.runs.accuracy import Likelihood
from slam_observer_ros.settings.estimator_settings import MAX_DELAY_S, Settings
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

    That is the variance of the mean between two observations over the variance which it
    usually has: by so much noise that passes for motion makes a scale too small. It is 1 on an
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

    With neither a surveyed map nor a known scale of the wheels, the scale of ranges is as
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
    """Return the deviations of the means of so many velocities (k, q) in a row."""
    count = min(count, len(V))
    means = V[: len(V) // count * count].reshape(-1, count, V.shape[1]).mean(axis=1)
    return np.asarray((means**2).mean(axis=0))


DELAY_STEPS_S = (0.1, 0.05)
"""Steps by which the delay is searched, and its likelihood's curvature found."""

MOSTLY_NOISE = 0.5
"""Share of noise in a velocity beyond which nothing moves along its axis."""

MAX_BEHIND = 0.01
"""Share of the points so far off the sensor's axis that it does not measure depth along that."""


class CalibrationFinder:
    """Finds what ``material`` shows; what is ``kept`` is as settings state it.

    ``advance`` is called at each run.
    """

    def __init__(
        self,
        material: Material,
        settings: Settings,
        kept: Collection[str],
        advance: Callable[[], None],
    ) -> None:
        self._material, self._stated, self._kept = material, settings, kept
        self._advance = advance
        self._motion = driven(material.events)
        is_surveyed = material.landmark_map is not None
        self._open = opened(settings, kept, self._motion, is_surveyed)

    def find(self, keeps_noise: bool = False) -> Found:
        """Return what is found; a UsageError says if there is too little to see."""
        _, likelihood = self._run(self._open)
        if not likelihood.count:
            raise UsageError(f'{self._material.path}: nothing is seen twice in what is trained on')
        settings, depth_gain = self._depth_or_range(self._open)
        delay = self._delay(settings)
        if delay is not None:
            self._material = delayed(self._material, delay.value)
            settings = replace(
                settings, velocity_delay=0.0, velocity_delay_stddev=min(delay.deviation, 0.1)
            )
        noise = [] if keeps_noise else self._noise(settings)
        settings = scaled(settings, [one.kind for one in noise], [one.log for one in noise])
        estimator, _ = self._run(settings)
        # A filter seems to know what only shows where it has linearised: a common scale.
        smoothed = estimator.smooth()
        parts = [self._part(part, delay) for part in smoothed.calibration]
        pairs = trades(parts, smoothed.calibration_correlations)
        if self._material.landmark_map is None and not settings.range_scale_stddev:
            pairs.insert(0, COMMON_SCALE)
        return Found(
            parts,
            pairs,
            settings.range_is_depth,
            depth_gain,
            noise,
            estimator.motion_factors,
            self._too_noisy(),
        )

    def _too_noisy(self) -> list[str]:
        """Return the scales of velocities that move, but are so noisy that it would not show."""
        share, stated = self._motion.noise_share, self._open
        widths = np.array([*stated.angular_scale_stddev, *stated.linear_scale_stddev])
        hidden = (share < MOSTLY_NOISE) & (widths == 0.0)
        possible = np.arange(6)[axes_of(stated.two_d_mode).pose]
        names = {OF_VELOCITY[i].name for i in possible if hidden[i]}
        return sorted(name for name in names if f'{name[:-2]}_stddev' not in self._kept)

    def _run(self, settings: Settings) -> tuple[Estimator, Likelihood]:
        self._advance()
        return self._material.trained(settings)

    def _depth_or_range(self, settings: Settings) -> tuple[Settings, tuple[float, float] | None]:
        """Return settings as depth or range, what is surely more likely, and depth's gain."""
        if not _may_be_depth(self._material):
            return replace(settings, range_is_depth=False), None
        (_, of_range), (_, of_depth) = (
            self._run(replace(settings, range_is_depth=is_depth)) for is_depth in (False, True)
        )
        gain, deviation = growth([of_range], [of_depth])
        if 'range_is_depth' not in self._kept and abs(gain) > SURE * deviation:
            settings = replace(settings, range_is_depth=gain > 0.0)
        return settings, (gain, deviation)

    def _delay(self, settings: Settings) -> CalibrationEstimate | None:
        """Return the most likely delay, by what is likely where all else is calibrated for it.

        The filter's own estimate is drawn towards zero by noise of the velocities; and velocities
        that are stamped late are there before they are known.
        """
        if not settings.velocity_delay_stddev:
            return None
        fixed = replace(settings, velocity_delay=0.0, velocity_delay_stddev=0.0)
        known: dict[float, float] = {}

        def log_likelihood(delay_s: float) -> float:
            if delay_s not in known:
                self._advance()
                known[delay_s] = delayed(self._material, delay_s).likelihood(fixed).total
            return known[delay_s]

        best_s, deviation_s = self._stated.velocity_delay, math.inf
        for step_s in DELAY_STEPS_S:
            best_s, deviation_s = _maximum(log_likelihood, best_s, step_s)
        prior_s = settings.velocity_delay_stddev
        return CalibrationEstimate(
            DELAY_NAME,
            best_s,
            min(deviation_s, prior_s),
            's',
            nominal=self._stated.velocity_delay,
            stated=prior_s,
        )

    def _noise(self, settings: Settings) -> list[NoiseFactor]:
        """Return the most likely noise of points."""
        likelihoods = [self._material.likelihood]
        return search_noise(likelihoods, settings, of_points(settings), self._advance)

    def _part(
        self, part: CalibrationEstimate, delay: CalibrationEstimate | None
    ) -> CalibrationEstimate:
        """Return a part with all that is known to be uncertain of it."""
        if part.name == DELAY_NAME and delay is not None:
            return delay
        if '_scale_' not in part.name:
            return part
        names = [entry.name for entry in OF_VELOCITY]
        noise = part.value * self._motion.noise_share[names.index(part.name)]
        return replace(part, deviation=min(math.hypot(part.deviation, noise), part.stated))


def find_noise(
    materials: Sequence[Material], settings: Settings, advance: Callable[[], None]
) -> Found:
    """Return the noise of motion and points that recordings show together, and nothing else."""
    likelihoods = [material.likelihood for material in materials]
    noise = search_noise(likelihoods, settings, kinds_of(settings), advance)
    if not noise:
        raise UsageError('no noise figure has an effect: messages state all covariances')
    return Found([], [], settings.range_is_depth, None, noise, [], [])


def delayed(material: Material, delay_s: float) -> Material:
    """Return the same with velocities as they take effect if they do so later by a delay."""
    by_ns = to_ns(delay_s)
    events = [
        event
        if isinstance(event, ObservationEvent)
        else replace(event, stamp_ns=event.stamp_ns + by_ns)
        for event in material.events
    ]
    events.sort(key=lambda event: event.stamp_ns)
    return replace(material, events=events)


def _maximum(
    objective: Callable[[float], float], start: float, step: float
) -> tuple[float, float]:
    """Return where a function has its maximum, a parabola there, and its deviation."""
    left, middle, right = objective(start - step), objective(start), objective(start + step)
    while max(left, right) > middle and abs(start) < MAX_DELAY_S:
        if right > left:
            start, left, middle = start + step, middle, right
            right = objective(start + step)
        else:
            start, middle, right = start - step, left, middle
            left = objective(start - step)
    curvature = (2.0 * middle - left - right) / step**2
    if curvature <= 0.0:
        return start, math.inf
    shift = 0.5 * (right - left) / step / curvature
    return start + min(max(shift, -step), step), curvature**-0.5


def _may_be_depth(material: Material) -> bool:
    """Return whether all that is seen is before the sensor."""
    seen = [event for event in material.events if isinstance(event, ObservationEvent)]
    behind = [
        cosines(event.lines_of_sight, event.sensor_axis) <= LEAST_COSINE
        for event in seen
        if len(event.ids)
    ]
    return bool(np.mean(np.concatenate(behind)) <= MAX_BEHIND)


def growth(before: Sequence[Likelihood], after: Sequence[Likelihood]) -> tuple[float, float]:
    """Return by how much the log likelihood of recordings grows, and the deviation of that."""
    verdict = judge(*([Judged(one, None, None) for one in each] for each in (before, after)))
    return verdict.gain, verdict.gain_deviation
