"""What is learnt of the odometry apart from slips and from what is carried."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
import math

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimates import CalibrationEstimate, MotionFactor
from slam_observer_ros.models.motion_noise import MEMORY, PRIOR_DEVIATION, proposed
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.tracking.slip import LAST_TEST_NS, UNSEEN_NS

SAMPLE_NS = LAST_TEST_NS // 10
"""How often it is looked at what was learnt: slips show within ten looks."""


SETTLES_NS = UNSEEN_NS + SAMPLE_NS  # how long what disturbs may go on after it has shown


class Undisturbed:
    """What is learnt of the odometry while nothing else explains what is seen.

    Until it is known that wheels slip, or that the robot or a landmark is carried, it passes for
    a delay or for noise of the odometry, and what was learnt then stays. A value v that is known
    to σ has learnt v/σ² and 1/σ², which are sums over observations. What has come to them since
    the time in which such a thing shows is left out: for good if it does, and until then.
    """

    def __init__(self) -> None:
        # (2,) v/σ² and 1/σ² by name: as they were last, and what is left out of them
        self._last: dict[str, FloatArray] = {}
        self._left_out: dict[str, FloatArray] = {}
        # Stamps, and what was learnt between each and the one before.
        self._recent: deque[tuple[int, dict[str, FloatArray]]] = deque()
        self._next_ns = 0
        self._settled_ns = -1
        self._observations = 0
        self._signs: Sequence[int] = ()
        self.is_disturbed = False  # by something that has shown since the last look

    def is_due(self, stamp_ns: int, signs: Sequence[int]) -> bool:
        """Note an observation, and counts of what disturbs; return whether it is time to look."""
        self.is_disturbed |= signs != self._signs
        self._signs = signs
        self._observations += 1
        return not 0 < self._next_ns - stamp_ns <= SAMPLE_NS

    def look(
        self,
        stamp_ns: int,
        calibration: Sequence[CalibrationEstimate],
        factors: Sequence[MotionFactor],
    ) -> None:
        """Take in what has been learnt by now."""
        self._next_ns = stamp_ns + SAMPLE_NS
        forgotten = (1.0 - 1.0 / MEMORY) ** self._observations
        keep = {part.name: 1.0 for part in calibration} | {
            factor.name: forgotten for factor in factors
        }
        self._observations = 0
        sums = {part.name: _learnt(part) for part in calibration}
        sums |= {factor.name: _learnt_of_noise(factor) for factor in factors}
        zero = np.zeros(2)
        self._left_out = {n: keep[n] * self._left_out.get(n, zero) for n in sums}
        for _, growth in self._recent:
            growth.update({n: keep[n] * growth.get(n, zero) for n in sums})
        new = {n: each - keep[n] * self._last.get(n, zero) for n, each in sums.items()}
        self._last = sums
        self._recent.append((stamp_ns, new))
        while not 0 <= stamp_ns - self._recent[0][0] <= LAST_TEST_NS:
            self._recent.popleft()
        if self.is_disturbed:
            self._settled_ns = stamp_ns + SETTLES_NS
        if 0 <= self._settled_ns - stamp_ns <= SETTLES_NS:
            self._left_out = self._without_recent()
            self._recent.clear()
        self.is_disturbed = False

    def end(self) -> None:
        """Count what was learnt last: nothing more will show."""
        self._recent.clear()

    def of_calibration(self, part: CalibrationEstimate) -> CalibrationEstimate:
        """Return an estimate of the calibration without what is left out."""
        prior = part.stated**-2.0
        value, deviation = self._clean(part.name, part.value - part.nominal, prior)
        return replace(part, value=part.nominal + value, deviation=max(deviation, part.deviation))

    def of_noise(self, factor: MotionFactor, settings: Settings) -> MotionFactor:
        """Return a factor of the noise without what is left out."""
        log, deviation = self._clean(factor.name, math.log(factor.factor), PRIOR_DEVIATION**-2.0)
        clean = math.exp(log)
        return replace(
            factor,
            factor=clean,
            deviation=max(deviation, factor.deviation),
            proposed=proposed(factor.name, clean, settings),
        )

    def _without_recent(self) -> dict[str, FloatArray]:
        """Return all that is left out, with what was learnt of late."""
        left_out = dict(self._left_out)
        for _, growth in self._recent:
            for name, each in growth.items():
                left_out[name] = left_out.get(name, np.zeros(2)) + each
        return left_out

    def _clean(self, name: str, now: float, prior: float) -> tuple[float, float]:
        """Return how far off a value is, and its deviation, ± 1/√``prior`` at the start.

        It is at most as far off as ``now``.
        """
        left_out: Mapping[str, FloatArray] = self._without_recent()
        pull, information = self._last.get(name, np.zeros(2)) - left_out.get(name, np.zeros(2))
        if information <= 0.0:
            return 0.0, math.inf
        off = pull / (information + prior)
        clean = math.copysign(min(abs(off), abs(now)), off) if off * now > 0.0 else 0.0
        return clean, 1.0 / math.sqrt(information + prior)


def _learnt(part: CalibrationEstimate) -> FloatArray:
    """Return v/σ² and 1/σ² of how far it is off, less what was known at the start."""
    information = part.deviation**-2.0
    return np.array([information * (part.value - part.nominal), information - part.stated**-2.0])


def _learnt_of_noise(factor: MotionFactor) -> FloatArray:
    information = factor.deviation**-2.0
    return np.array([information * math.log(factor.factor), information - PRIOR_DEVIATION**-2.0])
