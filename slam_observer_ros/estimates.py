"""What the estimator gives out: updates, calibration, noise, smoothed run, names of its counts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
import math

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray

UNUSED_POINTS = {
    'rejected_landmark': 'rejected',
    'unknown_id': 'without id',
    'repeated_id': 'of a repeated id',
    'reserved_id': 'of a reserved id',
    'unweighed_point': 'more than can be weighed',
    'impossible_id': 'of an impossible id',
    'unmapped_landmark': 'not mapped',
}
"""Names under which observed points that are not used are counted, and what they are."""

MAX_REJECTED = 0.1
"""Share of the points beyond which they are more than a sensor's outliers."""

MAX_REJECTED_ORIENTATIONS = 0.5
"""Share of the points beyond which they are more than the flips of small or frontal tags."""

NOTABLE_DELAY_S, CERTAIN = 0.1, 3.0
"""Least delay of velocities that is worth a finding, and by how many of its deviations."""

DELAY_NAME = 'velocity_delay'
"""Name of the delay of velocities."""

IMPLAUSIBLE = 4.0
"""Stated standard deviations by which no calibration is off: something else is wrong."""


NOTABLY_NOISIER = 1.5
"""Factor of the noise of the odometry from which it is named as a problem."""


def used_points(counts: Counter[str]) -> int:
    """Return how many points were used, from :attr:`.Estimator.counts`."""
    return counts['observed_point'] - sum(counts[name] for name in UNUSED_POINTS)


def point_share(counts: Counter[str], name: str) -> float:
    """Return the share of the points that ``name`` counts, from :attr:`.Estimator.counts`."""
    return counts[name] / max(counts['observed_point'], 1)


@dataclass(frozen=True, slots=True)
class NormalisedInnovation:
    """Residuals of m landmarks, judged by what the filter expected of them before the correction.

    ``nis`` is the normalised innovation squared of those that were used, together: χ² of so many
    ``degrees_of_freedom`` where all noise is as stated; None where no joint covariance is known.
    ``log_densities`` are natural logarithms of what the filter expected, of each residual given
    those used before it, in 1/m^k; −∞ of those that were not used. ``shares`` are below 1 for
    observations whose error has not changed since the last one.
    """

    distances: FloatArray  # (m,) Mahalanobis distance of each; zero if no noise is known
    weights: FloatArray  # (m,) Huber's, 0 for a rejected one
    nis: float | None
    degrees_of_freedom: int
    log_densities: FloatArray  # (m,)
    shares: FloatArray  # (m,)


@dataclass(frozen=True, slots=True)
class Update:
    """The state at ``stamp_ns``, right after an observation of m known landmarks was used.

    Residuals are those before the correction, along the world's axes; the rejected ones were too
    far off to be used. ``lyapunov`` is L (34) of them all; k_i is ``gain_k`` whatever the gains.
    Those of ``moved_ids`` are taken to be somewhere else from now on.
    ``innovation`` is None unless the estimator was asked for it.
    """

    stamp_ns: int
    pose: FloatArray  # (4, 4) body to world
    ids: IntArray  # (m,)
    residuals: FloatArray  # (m, 3) r_i, metres
    rejected: BoolArray  # (m,)
    lyapunov: float
    moved_ids: IntArray
    innovation: NormalisedInnovation | None = None


MOUNTED = {
    'sensor_rotation': (
        (
            'further rolled to the right/further rolled to the left',
            'further down/further up',
            'further to the left/further to the right',
        ),
        ('roll', 'pitch', 'yaw'),
    ),
    'sensor_translation': (
        (
            'further forward/further back',
            'further to the left/further to the right',
            'higher/lower',
        ),
        ('x', 'y', 'z'),
    ),
}
"""In words, by axis, how a sensor is mounted whose turn or shift is positive/negative."""


@dataclass(frozen=True, slots=True)
class CalibrationEstimate:
    """What was found out about one property of the velocity, or of a sensor.

    ``name`` is ``angular_scale_z``, ``linear_bias_x``, ``velocity_delay`` and so on; a scale is
    the factor that the velocity is multiplied by, its ``unit`` is ''. ``nominal`` is the value at
    the start, ``stated`` the standard deviation that the settings state, infinite where the value
    may drift away from there.
    """

    name: str
    value: float
    deviation: float
    unit: str
    nominal: float = 0.0
    stated: float = math.inf

    @property
    def problem(self) -> str:
        """What is wrong if it is further from nominal than the settings can mean; else ''."""
        times = abs(self.value - self.nominal) / self.stated
        if times <= IMPLAUSIBLE:
            return ''
        factor, unit = self.for_people
        value, stated, nominal = factor * self.value, factor * self.stated, factor * self.nominal
        return (
            f'{self.name} is {value:.3g}, {times:.0f} times its stated error ({stated:.3g}) '
            f'from {nominal:g}{f" {unit}" if unit else ""}: are signs, units and frames of '
            'velocity and points right?'
        )

    @property
    def advice(self) -> str:
        """What to set so that a sensor is stated as it was found to be; '' if it is, or no sensor.

        It is found where it is three standard deviations off, and those have become a third.
        """
        name, _, frame = self.name.partition('/')
        off, sensor = self.value - self.nominal, frame or 'the sensor'
        if abs(off) < 3.0 * self.deviation or 3.0 * self.deviation > self.stated:
            return ''
        if name == 'range_scale':
            set_to = f'set range_scale: {self.value:.4f}'
            return f'ranges of {sensor} are to be multiplied by {self}: {set_to}'
        part, _, axis = name.rpartition('_')
        if part not in MOUNTED:
            return ''
        factor, unit = self.for_people
        words, entries = MOUNTED[part]
        towards = words['xyz'.index(axis)].split('/')[int(off < 0.0)]
        entry = entries['xyz'.index(axis)]
        return (
            f'{sensor} is mounted {abs(factor * off):.2g} ± {factor * self.deviation:.2g} {unit} '
            f'{towards} than /tf says: add {off:.4f} to {entry} of its transform or sensor_pose'
        )

    @property
    def for_people(self) -> tuple[float, str]:
        """The factor from ``unit`` to that which people read, and that: degrees for radians."""
        if not self.unit.startswith('rad'):
            return 1.0, self.unit
        return math.degrees(1.0), self.unit.replace('rad', '°', 1)

    def __str__(self) -> str:
        """Write it with its uncertainty, of which at least two digits can be seen."""
        factor, unit = self.for_people
        value, deviation = factor * self.value, factor * self.deviation
        digits = 3
        if 0.0 < deviation < math.inf:
            digits = min(max(digits, 1 - math.floor(math.log10(deviation))), 9)
        return f'{value:.{digits}f} ± {deviation:.{digits}f} {unit}'.rstrip()


def calibration_problems(calibration: Iterable[CalibrationEstimate]) -> list[str]:
    """Return what there is to say of estimates: a delay first, as scales make up for it."""
    parts = list(calibration)
    for part in parts:
        notable_s = max(NOTABLE_DELAY_S, CERTAIN * part.deviation)
        if part.name == DELAY_NAME and abs(part.value) > notable_s:
            when = 'late' if part.value > 0.0 else 'early'
            return [
                f'The odometry takes effect {abs(part.value):.2f} s {when}: mind it in the driver '
                '(Tune the noise).'
            ]
    return [part.problem for part in parts if part.problem]


@dataclass(frozen=True, slots=True)
class MotionFactor:
    """How noisy the odometry is over what is stated: in ``'turning'`` or in ``'driving'``.

    Factors are of standard deviations: ``factor`` was found, and ``applied`` is in force.
    ``deviation`` is that of the logarithm of ``factor``, and ``proposed`` are the settings that
    state what was found.
    """

    name: str
    factor: float
    deviation: float
    applied: float
    proposed: str

    @property
    def problem(self) -> str:
        """What to state if the odometry is clearly noisier than stated; else ''."""
        is_clear = math.log(self.factor) > IMPLAUSIBLE * self.deviation
        if self.factor < NOTABLY_NOISIER or not is_clear:
            return ''
        remedy = f'set {self.proposed}' if self.proposed else 'state more'
        return (
            f'the odometry is {self.factor:.1f} × noisier in {self.name} than stated: {remedy}, '
            'or let its messages state larger covariances'
        )

    def __str__(self) -> str:
        """Write what was found, and what is made of it."""
        found = f'{self.factor:.2f} × as stated (± {100.0 * self.deviation:.0f} %)'
        return f'{found}, taken as {self.applied:.2f} ×'


@dataclass(frozen=True, slots=True)
class Smoothed:
    """Trajectory and map, each pose estimated from all that was seen before and after.

    ``since`` says in words what happened before the first of them, so that no more is smoothed.
    Of the slips since then that the estimator has counted, ``slips`` are confirmed by all of that.
    """

    stamps_ns: IntArray  # (s,) of the observations
    poses: FloatArray  # (s, 4, 4) at these, body to world
    world_points: FloatArray  # (n, 3) landmarks, metres, world
    ids: IntArray  # (n,)
    since: str
    slips: int
    # (n, 3, 3) of the landmarks, world, zero where unknown; None if it is not estimated
    orientations: FloatArray | None = None
