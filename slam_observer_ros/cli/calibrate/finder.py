"""What a recording shows: estimated with wide priors, and what else is likely by comparison."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
import math

import numpy as np

from slam_observer_ros.cli.calibrate.driven import driven, opened
from slam_observer_ros.cli.calibrate.stated import Found
from slam_observer_ros.cli.calibrate.trades import COMMON_SCALE, trades
from slam_observer_ros.cli.tune.material import Material
from slam_observer_ros.cli.tune.noise_kinds import NoiseKind, of_points, scaled
from slam_observer_ros.cli.tune.search import search_noise
from slam_observer_ros.cli.tune.verdict import judge, Judged, SURE
from slam_observer_ros.common.errors import UsageError
from slam_observer_ros.common.stamps import to_ns
from slam_observer_ros.estimates import CalibrationEstimate, DELAY_NAME
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.geometry.axes import axes_of
from slam_observer_ros.runs.likelihood import Likelihood
from slam_observer_ros.sensor_models.calibration import NAMES
from slam_observer_ros.sensor_models.sensing import cosines, LEAST_COSINE
from slam_observer_ros.settings.estimator_settings import MAX_DELAY_S, Settings

DELAY_STEPS_S = (0.1, 0.05)
"""Steps by which the delay is searched, and its likelihood's curvature found."""

MOSTLY_NOISE = 0.5
"""Share of noise in a velocity beyond which nothing moves along its axis."""

MAX_BEHIND = 0.01
"""Share of the points so far off the sensor's axis that it does not measure depth along that."""


class Finder:
    """Finds what ``material`` shows, of which settings state a part that is ``kept``.

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
        settings = scaled(settings, [kind for kind, *_ in noise], [log for _, log, _ in noise])
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
        names = {NAMES[i] for i in possible if hidden[i]}
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
        gain, deviation = growth(of_range, of_depth)
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

    def _noise(self, settings: Settings) -> list[tuple[NoiseKind, float, float]]:
        """Return the kinds of noise of points, with ln of their most likely factors, ± so much."""
        kinds, found = search_noise(
            [self._material.likelihood], settings, of_points(settings), self._advance
        )
        logs, deviations = found.log_factors.tolist(), found.deviations.tolist()
        return list(zip(kinds, logs, deviations, strict=True))

    def _part(
        self, part: CalibrationEstimate, delay: CalibrationEstimate | None
    ) -> CalibrationEstimate:
        """Return a part with all that is known to be uncertain of it."""
        if part.name == DELAY_NAME and delay is not None:
            return delay
        if '_scale_' not in part.name:
            return part
        noise = part.value * self._motion.noise_share[NAMES.index(part.name)]
        return replace(part, deviation=min(math.hypot(part.deviation, noise), part.stated))


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


def growth(before: Likelihood, after: Likelihood) -> tuple[float, float]:
    """Return by how much a log likelihood grows, and the deviation of that."""
    verdict = judge([Judged(before, None, None)], [Judged(after, None, None)])
    return verdict.gain, verdict.gain_deviation
