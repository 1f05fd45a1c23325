"""What the estimator gives out: updates, calibration, noise, counts; and what is kept of a run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import Enum
import math
from typing import Any, TYPE_CHECKING

import numpy as np

from slam_observer_ros.common.findings import in_brief
from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from typing_extensions import Self


class _Counted(Enum):
    """What points or landmarks are counted as, under its value, in :attr:`.Estimator.counts`.

    ``words`` say the same, and ``remedy`` what to do where these are many.
    """

    words: str
    remedy: str

    def __new__(cls, name: str, words: str, remedy: str = '') -> Self:
        """Let the value be the name."""
        counted = object.__new__(cls)
        counted._value_, counted.words, counted.remedy = name, words, remedy
        return counted


class Reason(_Counted):
    """Why a point that was observed is not used: each such point has exactly one reason."""

    # fmt: off
    REJECTED = ('rejected_landmark', 'rejected', 'see by how much with replay --explain ID, and '
                'look at signs, units, frames and noise')
    NO_ID = 'unknown_id', 'without id', 'let the sensor give ids, or set gains: riccati'
    REPEATED_ID = 'repeated_id', 'of a repeated id', 'give each landmark an id of its own'
    RESERVED_ID = 'reserved_id', 'of a reserved id', 'give these landmarks other ids'
    SURPLUS = 'surplus_point', 'more than max_points', 'let the sensor send fewer points'
    IMPOSSIBLE_ID = ('impossible_id', 'of an impossible id', 'look at what the driver writes '
                     'there; -1 is a point without id')
    BAD = ('bad_point', 'with NaN in what is stated of them', 'let the driver state numbers; all '
           'zeros mean that a covariance is unknown')
    UNMAPPED = ('unmapped_landmark', 'not mapped', 'load the map of this place, or set '
                'max_landmarks higher')
    WAITING = ('waiting_point', 'half points of landmarks that are not known yet', 'drive a '
               'curve: they enter once one place fits')
    CARRIED = ('carried_point', 'of landmarks that move with the robot', 'do nothing if the robot '
               'carries them; where they stay behind they are used again')
    # fmt: on


class Change(_Counted):
    """What became of a landmark itself."""

    FOUND = 'new_landmark', 'new in the map'
    MOVED = 'moved_landmark', 'moved: it is where it was seen now'
    MERGED = 'merged_landmark', 'merged with another landmark, which it is'
    FORGOTTEN = 'forgotten_landmark', 'forgotten to make room (max_landmarks), or after a flood'
    UNSUPPORTED = 'unsupported_landmark', 'forgotten: hardly exists, by what was seen and missed'
    CARRIED = 'carried_landmark', 'moves with the robot'


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a point or landmark when an observation of ``stamp_ns`` was used."""

    stamp_ns: int
    landmark_id: int
    what: Reason | Change


class Outcomes(Counter[str]):
    """Counts of points and landmarks by what became of them; and each of them, if it is ``kept``.

    What is kept is a chain, which a copy shares: hypotheses are copied at every observation.
    """

    def __init__(self, *args: Any, is_kept: bool = False) -> None:
        super().__init__(*args)
        self.is_kept = is_kept
        self._chain: Any = None

    def copy(self) -> Outcomes:
        """Return an independent copy."""
        other = Outcomes(self, is_kept=self.is_kept)
        other._chain = self._chain
        return other

    def note(self, what: Reason | Change, ids: IntArray, stamp_ns: int) -> None:
        """Count points or landmarks (m,) of which ``what`` has become of."""
        if len(ids):
            self[what.value] += len(ids)
            if self.is_kept:
                self._chain = (self._chain, what, ids, stamp_ns)

    def add(self, other: Outcomes) -> None:
        """Take in what others have counted and kept."""
        self.update(other)
        for what, ids, stamp_ns in list(other._links())[::-1]:
            self._chain = (self._chain, what, ids, stamp_ns)

    def _links(self) -> Iterator[tuple[Reason | Change, IntArray, int]]:
        link = self._chain
        while link is not None:
            link, what, ids, stamp_ns = link
            yield what, ids, stamp_ns

    @property
    def each(self) -> list[Outcome]:
        """What was kept, in the order in which it happened."""
        kept = list(self._links())[::-1]
        return [Outcome(t, i, what) for what, ids, t in kept for i in ids.tolist()]


DELAY_NAME = 'velocity_delay'  # name of the delay of velocities


def used_points(counts: Counter[str]) -> int:
    """Return how many points were used, from :attr:`.Estimator.counts`."""
    return counts['observed_point'] - sum(counts[reason.value] for reason in Reason)


def most_frequent(counts: Counter[str], among: Iterable[Reason] = Reason) -> Reason | None:
    """Return the reason for which most points are not used; None where all are used."""
    reason = max(among, key=lambda each: counts[each.value])
    return reason if counts[reason.value] else None


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
    kinds: IntArray | None = None  # (m,) of half points, as events have them; None: whole ones


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
class Ambiguity:
    """A time in which what was seen without ids fitted several maps, of which one was shown."""

    since_ns: int  # stamps of the first observation after which it was so, and of the last one
    until_ns: int
    position: FloatArray  # (3,) where the robot was shown at its beginning, metres, world
    probability: float  # least one, meanwhile, that the map shown was right
    ids: IntArray  # (n,) landmarks of it that others of these maps had elsewhere, or had not

    @property
    def lasts_ns(self) -> int:
        """How long it has lasted, nanoseconds."""
        return self.until_ns - self.since_ns

    @property
    def figures(self) -> dict[str, float | str]:
        """What the finding ``ambiguous_map`` says of it: seconds, and metres in the world."""
        x, y, _ = self.position.tolist()
        ids = in_brief([str(i) for i in self.ids.tolist()], joint=', ') or 'seen once alone'
        where = {'lasts_s': to_s(self.lasts_ns), 'x': x, 'y': y}
        return where | {'probability': self.probability, 'ids': ids}


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
    # (d,) landmarks that other maps which fit have elsewhere, or have not
    doubted_ids: IntArray
    seen: Update | None = None  # what was seen last, if that was lately


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
