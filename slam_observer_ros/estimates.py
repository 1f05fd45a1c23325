"""What the estimator gives out: updates, calibration, noise, counts; and what is kept of a run."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
import math

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray

UNUSED_POINTS = {
    'rejected_landmark': 'rejected',
    'unknown_id': 'without id',
    'repeated_id': 'of a repeated id',
    'reserved_id': 'of a reserved id',
    'surplus_point': 'more than max_points',
    'impossible_id': 'of an impossible id',
    'bad_point': 'with NaN in what is stated of them',
    'unmapped_landmark': 'not mapped',
    'waiting_point': 'half points of landmarks that are not known yet',
}
"""Names under which observed points that are not used are counted, and what they are."""

DELAY_NAME = 'velocity_delay'
"""Name of the delay of velocities."""


def used_points(counts: Counter[str]) -> int:
    """Return how many points were used, from :attr:`.Estimator.counts`."""
    return counts['observed_point'] - sum(counts[name] for name in UNUSED_POINTS)


def point_share(counts: Counter[str], name: str) -> float:
    """Return the share of the points that ``name`` counts, from :attr:`.Estimator.counts`."""
    return counts[name] / max(counts['observed_point'], 1)


@dataclass(frozen=True, slots=True)
class NormalisedInnovation:
    """Residuals of m landmarks, judged by what the filter expected of them before the correction.

    ``nis`` is the normalised innovation squared of all that were used, together: χ² of so many
    ``degrees_of_freedom`` where all noise is as stated; None where no joint covariance is known.
    ``log_densities`` are natural logarithms of what the filter expected, of each residual given
    all used before it, in 1/m^k; −∞ where it was not used. ``shares`` are below 1 for
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

    Residuals are from before the correction, along the axes that the world had then: it may have
    been the robot's own frame, and the observation have shown where that lies in a loaded map. The
    rejected ones were too far off to be used. ``lyapunov`` is L (34) of all; k_i is ``gain_k``
    whatever the gains. Landmarks ``moved_ids`` are taken to be somewhere else from now on.
    ``innovation`` is None unless the estimator was asked for it.
    """

    stamp_ns: int
    pose: FloatArray  # (4, 4) body to world
    ids: IntArray  # (m,) landmarks that were known before
    residuals: FloatArray  # (m, 3) r_i, metres
    rejected: BoolArray  # (m,)
    lyapunov: float
    moved_ids: IntArray
    innovation: NormalisedInnovation | None = None


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
    def for_people(self) -> tuple[float, str]:
        """The factor to the unit that people read, and that unit: degrees for radians."""
        if not self.unit.startswith('rad'):
            return 1.0, self.unit
        return math.degrees(1.0), self.unit.replace('rad', '°', 1)

    def __str__(self) -> str:
        """Write it with its uncertainty, at least two digits of it."""
        factor, unit = self.for_people
        value, deviation = factor * self.value, factor * self.deviation
        digits = 3
        if 0.0 < deviation < math.inf:
            digits = min(max(digits, 1 - math.floor(math.log10(deviation))), 9)
        return f'{value:.{digits}f} ± {deviation:.{digits}f} {unit}'.rstrip()


@dataclass(frozen=True, slots=True)
class MotionFactor:
    """Noise of the odometry over the stated noise: in ``'turning'`` or in ``'driving'``.

    Factors are of standard deviations: ``factor`` was found, and ``applied`` is in force. The
    logarithm of ``factor`` has the standard ``deviation``; the ``proposed`` settings state this
    factor.
    """

    name: str
    factor: float
    deviation: float
    applied: float
    proposed: str

    def __str__(self) -> str:
        """Write the factor found, and the one in force."""
        found = f'{self.factor:.2f} × as stated (± {100.0 * self.deviation:.0f} %)'
        return f'{found}, taken as {self.applied:.2f} ×'


@dataclass(frozen=True, slots=True)
class RangePower:
    """The power of the cosine off its axis with which a sensor's ranges grow: 1 for depths."""

    value: float
    deviation: float


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
    orientations: FloatArray  # (n, 3, 3) of the landmarks, world, zero where unknown
    calibration: list[CalibrationEstimate]  # c, of the last pose if it drifts
    calibration_correlations: FloatArray  # (c, c)


@dataclass(frozen=True, slots=True, eq=False)
class Instant:
    """The estimate at one stamp; covariances are None where the gains know none."""

    stamp_ns: int
    pose: FloatArray  # (4, 4) body to world
    pose_covariance: FloatArray | None  # (6, 6) rotation vector, position; world, rad² and m²
    ids: IntArray  # (n,)
    world_points: FloatArray  # (n, 3) metres
    landmark_covariances: FloatArray | None  # (n, 3, 3) world, m²
    calibration: tuple[CalibrationEstimate, ...]
    dropped: Counter[str]  # messages so far, by reason


@dataclass(frozen=True, slots=True, eq=False)
class Innovations:
    """All residuals of a run, one row each, and its u observations of known landmarks.

    ``distances`` are in standard deviations; ``weights`` are 0 for what was gated and below 1 for
    what was taken with caution; ``moved`` is what was taken to be somewhere else from then on.
    """

    stamps_ns: IntArray  # (m,)
    ids: IntArray  # (m,)
    distances: FloatArray  # (m,)
    residuals: FloatArray  # (m, 3) metres, world
    weights: FloatArray  # (m,)
    moved: BoolArray  # (m,)
    update_stamps_ns: IntArray  # (u,)
    nis: FloatArray  # (u,) NaN where no joint covariance is known, or nothing was used
    degrees_of_freedom: IntArray  # (u,)
    lyapunov: FloatArray  # (u,)

    @property
    def residuals_m(self) -> FloatArray:
        """(m,) lengths of the residuals, metres."""
        lengths: FloatArray = np.linalg.norm(self.residuals, axis=1)
        return lengths

    @property
    def mean_nis(self) -> float | None:
        """NIS per degree of freedom over the run, 1 is consistent; None if none is known."""
        total = int(self.degrees_of_freedom.sum())
        return float(np.nansum(self.nis) / total) if total else None
