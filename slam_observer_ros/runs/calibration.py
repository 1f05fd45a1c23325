"""What recordings show of sensor and odometry, and whether it holds on what was held out.

It is estimated with wide priors; what no filter estimates is what makes a drive most likely.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cache
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import optimize

from slam_observer_ros.common.errors import UsageError
from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND, to_ns
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import CalibrationEstimate, DELAY_NAME, MotionFactor
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import (
    AngularVelocityEvent,
    Event,
    ObservationEvent,
    UNKNOWN_ID,
    VelocityEvent,
)
from slam_observer_ros.lie.axes import axes_of
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.models.calibration import OF_VELOCITY
from slam_observer_ros.models.sensing import cosines, LEAST_COSINE
from slam_observer_ros.recordings.opening import sha256_of
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.recordings.trajectory import Truth
from slam_observer_ros.runs.mistakes import ROTATION
from slam_observer_ros.runs.recorders import Likelihood, LikelihoodRecorder
from slam_observer_ros.runs.replay import replay
from slam_observer_ros.runs.result import Request
from slam_observer_ros.settings.estimator_settings import MAX_DELAY_S, Settings
from slam_observer_ros.settings.parameter_table import table, Value

Advance = Callable[[], None]  # called at each run
BLOCKS = 20  # parts of a recording in time by which it is judged whether a gain may be chance
SURE = 2.0  # standard deviations by which the likelihood must grow

WORSE_ERROR = 1.05
WORSE_CONSISTENCY = 1.5  # factors by which the error, or how far the ANEES is from 1, may grow


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """How settings do on what was held out; errors are None where the truth is not known."""

    likelihood: Likelihood
    configuration_rmse_m: float | None
    configuration_anees: float | None


@dataclass(frozen=True, slots=True)
class Verdict:
    """Figures of what was held out, before and after; the ``objection`` is '' if all is better.

    Log likelihoods are per observation; errors are root mean squares over the recordings, and
    ANEES means; None where the truth is not known.
    """

    log_likelihood: tuple[float, float]
    gain: float
    gain_deviation: float
    error_m: tuple[float, float] | None
    anees: tuple[float, float] | None
    objection: str


def judge(before: Sequence[Judged], after: Sequence[Judged]) -> Verdict:
    """Compare settings on the recordings that were held out, in the same order."""
    likelihoods = [[each.likelihood for each in one] for one in (before, after)]
    per_before, per_after = (
        sum(each.total for each in one) / sum(each.count for each in one) for one in likelihoods
    )
    gain, deviation = growth(*likelihoods)
    error_m = _means(before, after, 'configuration_rmse_m', 2.0)
    anees = _means(before, after, 'configuration_anees', 1.0)
    objection = ''
    if not gain > SURE * deviation:
        objection = (
            f'the log likelihood changes by {gain:.1f} ± {deviation:.1f}, which may be chance'
        )
    elif error_m is not None and error_m[1] > WORSE_ERROR * error_m[0]:
        objection = f'the error grows from {error_m[0]:.3g} to {error_m[1]:.3g} m'
    elif anees is not None:
        off = [abs(math.log(value)) for value in anees]
        if off[1] > off[0] + math.log(WORSE_CONSISTENCY):
            objection = f'the ANEES goes from {anees[0]:.2g} to {anees[1]:.2g}, away from 1'
    return Verdict((per_before, per_after), gain, deviation, error_m, anees, objection)


def growth(before: Sequence[Likelihood], after: Sequence[Likelihood]) -> tuple[float, float]:
    """Return by how much the log likelihood of recordings grows, and the deviation of that.

    By how much it grows in each of some parts of a recording shows what chance does.
    """
    gains = []
    for pair in zip(before, after, strict=True):
        stamps_ns = np.concatenate([one.stamps_ns for one in pair])
        edges = np.linspace(stamps_ns.min(), stamps_ns.max() + 1, BLOCKS + 1)
        of_before, of_after = (
            np.histogram(one.stamps_ns, edges, weights=one.shares * one.log_densities)[0]
            for one in pair
        )
        gains.append(of_after - of_before)
    each = np.concatenate(gains)
    return float(each.sum()), float(np.std(each) * math.sqrt(len(each)))


def _means(
    before: Sequence[Judged], after: Sequence[Judged], name: str, power: float
) -> tuple[float, float] | None:
    """Return the means of a figure, or of a power of it; None if one is not known."""
    known = [
        [value for each in one if (value := getattr(each, name)) is not None]
        for one in (before, after)
    ]
    if not all(known):
        return None
    of_before, of_after = (
        float(np.mean(np.array(values) ** power)) ** (1.0 / power) for values in known
    )
    return of_before, of_after


HELD_OUT_SHARE = 1.0 / 3.0  # part of a recording, at its end, held out where no other is


@dataclass(frozen=True, slots=True, eq=False)
class Material:
    """A recording's events; those from ``split_ns`` on are held out, of what is trained on."""

    path: Path
    sha256: str
    events: Sequence[Event]
    truth: Truth
    reach_m: float
    split_ns: int
    landmark_map: LandmarkMap | None = None

    def likelihood(self, settings: Settings) -> Likelihood:
        """Return how likely the part to train on is."""
        return self.trained(settings)[1]

    def trained(self, settings: Settings) -> tuple[Estimator, Likelihood]:
        """Return what comes of the part to train on; a UsageError if it is not in the map."""
        recorder = self._recorder(settings)
        estimator = Estimator(settings, on_update=recorder.note_update, judges_innovations=True)
        if self.landmark_map is not None:
            estimator.load_map(self.landmark_map)
        for event in self.events:
            if event.stamp_ns < self.split_ns:
                estimator.add(event)
        estimator.flush()
        if problem := estimator.localisation_problem:
            raise UsageError(
                f'{self.path}: the pose in the map was not found: {problem.what}; {problem.remedy}'
            )
        return estimator, recorder.likelihood

    def judged(self, settings: Settings) -> Judged:
        """Return how settings do on the part that is held out, after all that was before it."""
        recorder, is_held_out = self._recorder(settings), self.truth.stamps_ns >= self.split_ns
        stamps_ns, poses = self.truth.stamps_ns[is_held_out], self.truth.poses[is_held_out]
        truth = replace(self.truth, stamps_ns=stamps_ns, poses=poses)
        result = replay(self.events, settings, truth, self.landmark_map, recorders=[recorder])
        likelihood = recorder.likelihood
        return Judged(
            likelihood.select(likelihood.stamps_ns >= self.split_ns),
            result.configuration.rmse_m,
            result.configuration.anees,
        )

    def _recorder(self, settings: Settings) -> LikelihoodRecorder:
        return LikelihoodRecorder(axes_of(settings.two_d_mode).point, self.reach_m)


def read_material(
    request: Request, path: Path, held_out_share: float, landmark_map: LandmarkMap | None
) -> Material:
    """Read a recording as is asked for; its last part is to be held out."""
    with Recording(path) as recording:
        selected, inputs, truth = replace(request, recording=path).select_inputs(recording)
        events = list(recording.events(selected, inputs, request.settings.velocity_timeout))
    seen = [event for event in events if isinstance(event, ObservationEvent) and len(event.ids)]
    if not seen:
        raise UsageError(f'{path}: no landmark is seen')
    ids = np.concatenate([event.ids for event in seen])
    if 2 * np.count_nonzero(ids == UNKNOWN_ID) > len(ids):
        raise UsageError(
            f'{path}: it needs landmarks with ids: without, what is taken for which depends on '
            'the noise itself'
        )
    first_ns, last_ns = (f(event.stamp_ns for event in events) for f in (min, max))
    split_ns = last_ns + 1 - round(held_out_share * (last_ns + 1 - first_ns))
    reach_m = max(float(np.linalg.norm(event.points, axis=1).max()) for event in seen)
    digest = sha256_of(path)
    return Material(path, digest, events, truth, reach_m, split_ns, landmark_map)


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """What was found; the ``depth_gain`` is of the log likelihood, and has its deviation."""

    parts: list[CalibrationEstimate]  # c
    correlations: FloatArray  # (c, c)
    has_no_size: bool  # a common scale of wheels and ranges changes nothing that is seen
    range_is_depth: bool
    depth_gain: tuple[float, float] | None  # of depth over range; None if it can't be
    noise: list[NoiseFactor]  # of points; where it alone is looked for, of motion, too
    factors: list[MotionFactor]
    too_noisy: list[str]  # scales of velocities that were not looked for

    @property
    def frames(self) -> set[str]:
        """The frames of the sensors; '' is the base frame."""
        return {
            part.name.partition('/')[2]
            for part in self.parts
            if part.name.startswith(('sensor_', 'range_scale'))
        }


TRANSLATION = (0.1,) * 3  # how far from where it is stated a sensor may be mounted, metres

SCALE, RANGE_BIAS_M, BIAS, DELAY_S = 0.1, 0.2, 0.02, 0.3
"""How far scales, of ranges and velocities, all ranges from one landmark, a gyroscope's zero
(rad/s) and a clock may be off."""

NOISY = 0.05  # share of noise in the velocities beyond which a known map shows no scale of theirs
_PER_MEDIAN = 1.4826  # standard deviation over the median of absolute values, if normal


class Driven(NamedTuple):
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
        'range_bias_stddev': RANGE_BIAS_M if is_surveyed else 0.0,
        'angular_bias_stddev': (BIAS,) * 3,
        'velocity_delay_stddev': DELAY_S,
    }
    wide: dict[str, Any] = {
        name: np.maximum(getattr(settings, name), value) for name, value in least.items()
    }
    if not is_surveyed and 'linear_scale_stddev' not in kept:
        wide['range_scale_stddev'] = 0.0
    wide |= {'angular_scale_stddev': scales[:3], 'linear_scale_stddev': scales[3:]}
    wide = {name: value for name, value in wide.items() if name not in kept}
    wide |= {'angular_velocity_noise': noise[0], 'linear_velocity_noise': noise[1]}
    values: dict[str, Any] = {
        name: tuple(value.tolist()) if np.ndim(value) else float(value)
        for name, value in wide.items()
    }
    return replace(
        settings,
        **values,
        angular_scale_noise=(0.0, 0.0, 0.0),
        linear_scale_noise=(0.0, 0.0, 0.0),
        calibration_drift=0.0,
        smoothing_window=0,
        localization_mode='uncertain' if is_surveyed else 'off',
    )


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


DELAY_STEPS_S = (0.1, 0.05)  # steps of the search for the delay, and of its curvature
MOSTLY_NOISE = 0.5  # share of noise in a velocity beyond which nothing moves along its axis
MAX_BEHIND = 0.01  # share of points so far off the axis that the sensor measures no depth along it


class CalibrationFinder:
    """Finds what ``material`` shows; what is ``kept`` is as settings state it."""

    def __init__(
        self, material: Material, settings: Settings, kept: Collection[str], advance: Advance
    ) -> None:
        self._material, self._stated, self._kept = material, settings, kept
        self._advance, self._motion = advance, driven(material.events)
        self._open = opened(settings, kept, self._motion, material.landmark_map is not None)

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
        noise = []
        if not keeps_noise:
            likelihoods = [self._material.likelihood]
            kinds = kinds_of(settings, of_motion=False)
            noise = search_noise(likelihoods, settings, kinds, self._advance)
        settings = scaled(settings, [one.kind for one in noise], [one.log for one in noise])
        estimator, _ = self._run(settings)
        # A filter seems to know what only shows where it has linearised: a common scale.
        smoothed = estimator.smooth()
        # Noise of the velocities makes their scales uncertain, too.
        names = [entry.name for entry in OF_VELOCITY[:6]]
        shares = dict(zip(names, self._motion.noise_share, strict=True))
        parts = []
        for part in smoothed.calibration:
            if part.name == DELAY_NAME and delay is not None:
                part = delay
            elif '_scale_' in part.name:
                uncertain = math.hypot(part.deviation, part.value * shares[part.name])
                part = replace(part, deviation=min(uncertain, part.stated))
            parts.append(part)
        # Scales of velocities that move, but are so noisy that it would not show.
        widths = np.array([*self._open.angular_scale_stddev, *self._open.linear_scale_stddev])
        hidden = (self._motion.noise_share < MOSTLY_NOISE) & (widths == 0.0)
        possible = np.arange(6)[axes_of(settings.two_d_mode).pose]
        too_noisy = {names[i] for i in possible if hidden[i]}
        return Found(
            parts,
            smoothed.calibration_correlations,
            self._material.landmark_map is None and not settings.range_scale_stddev,
            settings.range_is_depth,
            depth_gain,
            noise,
            estimator.motion_factors,
            sorted(name for name in too_noisy if f'{name[:-2]}_stddev' not in self._kept),
        )

    def _run(self, settings: Settings) -> tuple[Estimator, Likelihood]:
        self._advance()
        return self._material.trained(settings)

    def _depth_or_range(self, settings: Settings) -> tuple[Settings, tuple[float, float] | None]:
        """Return settings as depth or range, what is surely more likely, and depth's gain."""
        behind = [
            cosines(event.lines_of_sight, event.sensor_axis) <= LEAST_COSINE
            for event in self._material.events
            if isinstance(event, ObservationEvent) and len(event.ids) and event.kinds is None
        ]
        # Else all is before the sensor; half points have no direction, or no range.
        if not behind or np.mean(np.concatenate(behind)) > MAX_BEHIND:
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

        @cache
        def log_likelihood(delay_s: float) -> float:
            self._advance()
            return delayed(self._material, delay_s).likelihood(fixed).total

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


def find_noise(materials: Sequence[Material], settings: Settings, advance: Advance) -> Found:
    """Return the noise of motion and points that recordings show together, and nothing else."""
    likelihoods = [material.likelihood for material in materials]
    noise = search_noise(likelihoods, settings, kinds_of(settings), advance)
    if not noise:
        raise UsageError('no noise figure has an effect: messages state all covariances')
    return Found([], np.empty((0, 0)), False, settings.range_is_depth, None, noise, [], [])


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


# The most likely noise figures: a factor for each kind of error. Figures of one kind keep their
# proportions: how much of an error grows with the speed or with the range, and along which axis it
# is, a recording seldom shows. One that is zero stays zero.

_ROWS = {row.name: row for row in table(Settings)}


class NoiseKind(NamedTuple):
    """A kind of error, and the parameters that say how large it is."""

    name: str
    parameters: tuple[str, ...]


_OF_MOTION = (
    ('turning', ('angular_velocity_noise', 'angular_scale_noise')),
    ('driving', ('linear_velocity_noise', 'linear_scale_noise')),
)
_OF_POINTS: dict[str, tuple[tuple[str, tuple[str, ...]], ...]] = {
    'range_bearing': (
        ('range', ('range_noise', 'range_scale_noise')),
        ('bearing', ('bearing_noise',)),
    ),
    'fiducial': (('pixels', ('pixel_noise',)),),
    'cartesian': (('points', ('point_noise',)),),
    'stereo': (('pixels', ('pixel_noise',)), ('disparity', ('disparity_noise',))),
}


def kinds_of(
    settings: Settings, of_motion: bool = True, of_points: bool = True
) -> list[NoiseKind]:
    """Return the kinds of error that settings state, each with its figures that are not zero."""
    points = _OF_POINTS[settings.observation_model]
    kinds = [
        NoiseKind(name, tuple(each for each in parameters if np.any(getattr(settings, each))))
        for name, parameters in (*_OF_MOTION * of_motion, *points * of_points)
    ]
    return [kind for kind in kinds if kind.parameters]


def scaled(
    settings: Settings, kinds: Sequence[NoiseKind], log_factors: Sequence[float]
) -> Settings:
    """Return settings whose figures of each kind have grown by a factor, given as its logarithm.

    None gets smaller or larger than its parameter may be.
    """
    values: dict[str, Any] = {}
    for kind, log_factor in zip(kinds, log_factors, strict=True):
        for name in kind.parameters:
            row, factor = _ROWS[name], math.exp(log_factor)
            within = np.clip(factor * np.array(getattr(settings, name)), row.minimum, row.maximum)
            values[name] = tuple(within.tolist()) if within.ndim else float(within)
    return replace(settings, **values)


LARGEST = math.log(32.0)  # logarithm of the factor by which a figure changes at most

FIRST_STEP = math.log(2.0)
CURVATURE_STEP = 0.2
"""Steps of the search at first, and by which the curvature is measured, as logarithms."""

EVALUATIONS = 12  # how often the likelihood is computed at most in the search, for each factor
TOLERANCE = 0.03  # how near the factors come to the most likely ones, as a share

NO_EFFECT = 0.1
"""Change of the log likelihood, by twice and by half the noise, below which a factor has none.

The factor would be known to 20 times itself at best.
"""

DIGITS = 3  # significant digits of a noise figure; it is seldom known to so many

Objective = Callable[[FloatArray], float]


@dataclass(frozen=True, slots=True)
class NoiseFactor:
    """By which factor the noise of a kind is another than stated: its logarithm, ± so much."""

    kind: NoiseKind
    log: float
    deviation: float

    def __str__(self) -> str:
        """Return the factor and its interval of 95 % as text."""
        factor = math.exp(self.log)
        if not math.isfinite(self.deviation):
            return f'× {factor:.2g}, but the recording says little of it'
        low, high = (math.exp(self.log + sign * 2.0 * self.deviation) for sign in (-1, 1))
        return f'× {factor:.2g} ({low:.2g} to {high:.2g})'


def without_effect(objective: Objective, n: int) -> list[int]:
    """Return which of n factors change nothing."""
    nominal, steps = objective(np.zeros(n)), FIRST_STEP * np.eye(n)
    changes = [[objective(sign * step) - nominal for sign in (1.0, -1.0)] for step in steps]
    return [i for i, change in enumerate(changes) if np.max(np.abs(change)) < NO_EFFECT]


def most_likely(objective: Objective, n: int) -> tuple[FloatArray, FloatArray]:
    """Return logarithms (n,) of the most likely factors, from 1 on, and their deviations (n,).

    These are by the curvature of the log likelihood, where all others are unknown, too; infinite
    where it has no maximum there.
    """
    if not n:
        return np.zeros(0), np.zeros(0)
    simplex = np.vstack([np.zeros(n), FIRST_STEP * np.eye(n)])
    result = optimize.minimize(
        lambda x: -objective(x),
        np.zeros(n),
        method='Nelder-Mead',
        bounds=[(-LARGEST, LARGEST)] * n,
        options={
            'initial_simplex': simplex,
            'maxfev': EVALUATIONS * n,
            'xatol': TOLERANCE,
            'fatol': 0.5 * TOLERANCE,
        },
    )
    x, h = np.asarray(result.x, dtype=np.float64), CURVATURE_STEP
    steps, middle = h * np.eye(n), objective(x)
    sides = np.array([[objective(x + step), objective(x - step)] for step in steps])
    H = np.diag(2.0 * middle - sides.sum(axis=1)) / h**2  # of minus the log likelihood
    for i in range(n):
        for j in range(i):
            both = objective(x + steps[i] + steps[j])
            H[i, j] = H[j, i] = (sides[i, 0] + sides[j, 0] - middle - both) / h**2
    # Where it has no maximum nothing is known.
    deviations = np.full(n, math.inf)
    curved = np.flatnonzero(np.diagonal(H) > 0.0)
    while len(curved):
        part = H[np.ix_(curved, curved)]
        values, vectors = np.linalg.eigh(part)
        if values[0] > 0.0:
            deviations[curved] = np.sqrt(np.diagonal(np.linalg.inv(part)))
            break
        curved = np.delete(curved, np.argmax(np.abs(vectors[:, 0])))
    return x, deviations


def remembered(objective: Callable[[Sequence[float]], float]) -> Objective:
    """Return a function that computes nothing twice."""
    known = cache(objective)
    return lambda x: known(tuple(x.tolist()))


def search_noise(
    trained_on: Sequence[Callable[[Settings], Likelihood]],
    settings: Settings,
    kinds: Sequence[NoiseKind],
    advance: Advance,
) -> list[NoiseFactor]:
    """Return the most likely factors of the kinds of noise that have an effect.

    ``trained_on`` give the likelihood of each recording, and ``advance`` is called at each step.
    Raises a UsageError if nothing is seen twice.
    """
    counts = [likelihood(settings).count for likelihood in trained_on]
    if not all(counts):
        raise UsageError('nothing is seen twice in what is trained on')

    def log_likelihood(kinds: Sequence[NoiseKind], log_factors: Sequence[float]) -> float:
        advance()
        tried = scaled(settings, kinds, log_factors)
        likelihoods = [likelihood(tried) for likelihood in trained_on]
        return sum(one.mean * count for one, count in zip(likelihoods, counts, strict=True))

    idle = without_effect(remembered(lambda x: log_likelihood(kinds, x)), len(kinds))
    effective = [kind for number, kind in enumerate(kinds) if number not in idle]
    found = most_likely(remembered(lambda x: log_likelihood(effective, x)), len(effective))
    logs, deviations = (values.tolist() for values in found)
    return [NoiseFactor(*each) for each in zip(effective, logs, deviations, strict=True)]


def rounded(value: Value) -> Value:
    """Return a figure, or a vector of them, as it is written."""
    entries = [float(f'{entry:.{DIGITS}g}') for entry in np.ravel(value).tolist()]
    return tuple(entries) if isinstance(value, tuple) else entries[0]
