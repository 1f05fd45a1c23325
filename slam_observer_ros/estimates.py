"""What the estimator gives out: after each observation, and in hindsight."""

from __future__ import annotations

from dataclasses import dataclass
import math

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray

IMPLAUSIBLE = 4.0
"""Standard deviations as stated by which no calibration is off: something else is wrong."""


@dataclass(frozen=True, slots=True)
class Update:
    """The state right after an observation was used.

    Attributes
    ----------
    stamp_ns : int
        Stamp of the state, nanoseconds.
    pose : FloatArray
        (4, 4) estimated pose, body to world.
    ids : IntArray
        (m,) ids of the known landmarks that were seen.
    residuals : FloatArray
        (m, 3) their residuals r_i before the correction, metres, along the world's axes.
    rejected : BoolArray
        (m,) whether they were too far off to be used.
    lyapunov : float
        L (34) of these residuals, of rejected ones, too; k_i is ``gain_k`` whatever the gains.

    """

    stamp_ns: int
    pose: FloatArray
    ids: IntArray
    residuals: FloatArray
    rejected: BoolArray
    lyapunov: float


@dataclass(frozen=True, slots=True)
class CalibrationEstimate:
    """What was found out about one property of the velocity.

    Attributes
    ----------
    name : str
        Which: ``angular_scale_z``, ``linear_bias_x``, ``velocity_delay`` and so on.
    value, deviation : float
        Estimate and its standard deviation; of a scale, the factor that the velocity is
        multiplied by.
    unit : str
        Unit of both; '' for a factor.
    nominal, stated : float
        What it was taken for at the start, and the standard deviation that the settings state;
        infinite where it may drift away from there.

    """

    name: str
    value: float
    deviation: float
    unit: str
    nominal: float = 0.0
    stated: float = math.inf

    @property
    def trouble(self) -> str:
        """What is wrong if it is further from nominal than the settings can mean; else ''."""
        times = abs(self.value - self.nominal) / self.stated
        if times <= IMPLAUSIBLE:
            return ''
        return (
            f'{self.name} is {self.value:.3g}, {times:.0f} times its stated error '
            f'({self.stated:g}) from {self.nominal:g}: are signs, units and frames of velocity '
            'and points right?'
        )

    def __str__(self) -> str:
        """Write it with its uncertainty, of which at least two digits can be seen."""
        digits = 3
        if 0.0 < self.deviation < math.inf:
            digits = min(max(digits, 1 - math.floor(math.log10(self.deviation))), 9)
        return f'{self.value:.{digits}f} ± {self.deviation:.{digits}f} {self.unit}'.rstrip()


@dataclass(frozen=True, slots=True)
class Smoothed:
    """Trajectory and map, each pose estimated from all that was seen before and after.

    Attributes
    ----------
    stamps_ns : IntArray
        (s,) stamps of the observations, nanoseconds.
    poses : FloatArray
        (s, 4, 4) poses at these stamps, body to world.
    world_points : FloatArray
        (n, 3) landmarks, metres, world.
    ids : IntArray
        (n,) their ids.
    since : str
        What happened before the first of them, so that there is no hindsight of more, in words.

    """

    stamps_ns: IntArray
    poses: FloatArray
    world_points: FloatArray
    ids: IntArray
    since: str
