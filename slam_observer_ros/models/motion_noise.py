"""Noise of velocities, from the settings or from the messages, and how far it is stated wrong.

Turning and driving have a factor ρ_j of the variance each, found by maximum likelihood of the
residuals r before the gate, S = H P Hᵀ + R their covariance. The motion since the observation
before has added M_j = C N_j Cᵀ to it, N_j (p, p) to the covariance of ε, C_i = [−[ŷ_i]×, I]. With
θ_j = ln ρ_j the score and the Fisher information of an observation are

    g_j = ½ (w rᵀ S⁻¹ M_j S⁻¹ r − tr S⁻¹ M_j),      F_jk = ½ tr(S⁻¹ M_j S⁻¹ M_k),

and θ ← θ + (F̄ + I)⁻¹ (g − θ/n): F̄ is the sum of F with a memory of n observations, and I the
information of a prior, θ_j ~ N(0, 1). M_j has the rank of N_j, so u = Cᵀ S⁻¹ r and G = Cᵀ S⁻¹ C
are enough: rᵀ S⁻¹ M_j S⁻¹ r = uᵀ N_j u, tr S⁻¹ M_j = tr N_j G, 2 F_jk = tr N_j G N_k G.

A slip, a robot that was carried, and outliers are no noise of the odometry: points beyond the gate
are left out where most are within it, and the weight w lets no observation be further off than
one in a hundred is. Nothing is learnt where the odometry says that the robot stands, nor across
gaps and slips, whose noise is stated apart. The points' noise has no factor: where errors last,
innovations are small while errors are large.
"""

from __future__ import annotations

from copy import copy
from functools import lru_cache
import math
from typing import NamedTuple

import numpy as np

from slam_observer_ros.common.errors import significant
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.estimates import MotionFactor
from slam_observer_ros.lie.matrices import diagonal_blocks, limited, mahalanobis, solve_definite
from slam_observer_ros.models.held_velocities import HeldVelocities, squared_speeds
from slam_observer_ros.settings.estimator_settings import Settings, Vector3

# Standard deviations of a velocity that only say 'unknown': no robot turns or moves as fast.
MAX_SPEED_ERRORS = np.repeat([50.0, 1000.0], 3)

# Standard deviations of a motion in one gap, rad and m: it is as unknown as it can be. More would
# only drown all else that is known in rounding.
MAX_GAP_ERRORS = np.repeat([np.pi, 1000.0], 3)
MEMORY = 300  # observations over which the factors are found: they follow a change of the ground
MAX_STEP = 0.5  # change of ln ρ by one observation, at most

# Of ρ: a tenth to thirty times the standard deviation that is stated.
LEAST_LOGARITHM, LARGEST_LOGARITHM = math.log(1e-2), math.log(1e3)
RARE = 2.33  # standard deviations beyond which one in a hundred is

# Least ln ρ that is applied, by ``motion_noise_factor``; 'stated' applies none.
LEAST = {'stated': math.inf, 'at_least_stated': 0.0, 'auto': -math.inf}

# The motions that have a factor, and how the names of their noise begin.
KINDS = {'turning': 'angular', 'driving': 'linear'}
_IDENTITY_6, _PRIOR = np.eye(6), np.eye(2)
PRIOR_DEVIATION = 0.5  # of ln of a factor of the standard deviation at the start: half as for θ


class MotionFigures(NamedTuple):
    """How far velocities may be off."""

    densities: FloatArray  # (6,) variances of the motion per second, rad² and m²
    scales: FloatArray  # (6,) √s: square roots of the same at a speed of 1 rad/s or m/s
    factors: FloatArray  # (2,) of both, for turning and driving
    unknown: FloatArray  # (6,) variances per second of a motion without a velocity, rad² and m²


class Factors(NamedTuple):
    """From what the factors of the noise of the motion are found, changed in place."""

    shares: FloatArray  # (2, p, p) N_j of the motion since the last observation
    logs: FloatArray  # (2,) θ
    information: FloatArray  # (2, 2) F̄
    applied: FloatArray  # (2,)
    least: float  # least θ that is applied


class MotionNoise:
    """How far motions may be off, as settings or messages have it, times the ``factors``."""

    def __init__(self, settings: Settings) -> None:
        self._settings = s = settings
        self.factors = MotionFactors(settings)
        self._unknown_squared = (
            np.repeat([s.unknown_angular_motion, s.unknown_linear_motion], 3) ** 2
        )
        self._scale = np.array([*s.angular_scale_noise, *s.linear_scale_noise])

    def copy(self) -> MotionNoise:
        """Return an independent copy."""
        other = copy(self)
        other.factors = copy(self.factors)  # whose arrays are never changed in place
        return other

    def covariances(self, held: HeldVelocities) -> FloatArray:
        """Return what k motions may be off by: (k, 6, 6), rad² and m²."""
        variances, stated = motion_noise(held, self.figures)
        covariances: FloatArray = variances[:, :, None] * _IDENTITY_6
        return covariances if stated is None else covariances + stated

    @property
    def figures(self) -> MotionFigures:
        """How far velocities without a stated covariance may be off now."""
        s = self._settings
        densities = _squares(s.angular_velocity_noise, s.linear_velocity_noise)
        return MotionFigures(densities, self._scale, self.factors.applied, self._unknown_squared)

    def velocity_covariance(self, held: HeldVelocities) -> FloatArray:
        """Return what a single velocity may be off by: (6, 6), rad²/s² and m²/s²."""
        covariance: FloatArray = self.covariances(held)[0] / (held.dt_s[0] + held.gap_s[0]) ** 2
        return covariance


@lru_cache(maxsize=8)
def _squares(angular: Vector3, linear: Vector3) -> FloatArray:
    squares = np.array([*angular, *linear]) ** 2
    squares.setflags(write=False)
    return squares


def motion_noise(
    held: HeldVelocities, figures: MotionFigures
) -> tuple[FloatArray, FloatArray | None]:
    """Return the variances (k, 6) of motions, and the covariances (k, 6, 6) stated besides.

    In rad² and m². The variances are zero in a part, angular or linear, whose covariance is
    stated. None is returned for the covariances where no message states one.
    """
    dt_s, stated = held.dt_s[:, None], None
    # White noise of the stated density, and in proportion to the speed: by the mean of the motion
    # times another mean, as by its square motions that noise makes slower would count for more.
    variances: FloatArray = figures.densities * dt_s
    before_s, usual_s, until_s = held.before_s, held.usual_s, held.before_s + dt_s
    if np.count_nonzero(until_s > usual_s):  # as nearly never
        # The errors are new in each message. Held for t, longer than the usual T, one of them has
        # moved the robot by t/T times as much: t²/T, not t. Slip is as before.
        grown_s = until_s * np.maximum(until_s / usual_s, 1.0)
        grown_s -= before_s * np.maximum(before_s / usual_s, 1.0)
        variances = figures.densities * np.repeat(grown_s, 3, axis=1)
    if np.count_nonzero(figures.scales):
        variances += figures.scales**2 * squared_speeds(held) * dt_s
    variances = variances * figures.factors.repeat(3)
    if np.count_nonzero(held.is_stated):
        variances[np.repeat(held.is_stated, 3, axis=1)] = 0.0
        # A velocity has one error for as long as it is held, and the next message another one:
        # held for t it has moved the robot by t times its error, in however many motions.
        squared = dt_s * (2.0 * before_s + dt_s)  # (before + dt)² − before²
        grown_s = np.repeat(np.sqrt(squared * figures.factors), 3, axis=1)
        stated = limited(held.covariances, MAX_SPEED_ERRORS)
        stated = grown_s[:, :, None] * stated * grown_s[:, None, :]
    # In a gap the robot may do anything that is allowed.
    if np.count_nonzero(held.gap_s):
        variances += np.minimum(figures.unknown * held.gap_s[:, None], MAX_GAP_ERRORS**2)
    return variances, stated


def beyond_driving(points: FloatArray, residuals: FloatArray, settings: Settings) -> BoolArray:
    """Return which points (m, 3) are further off than the noise of driving explains.

    By the gate, and the noise of a second of driving, after which a robot whose velocity is zero
    is taken to stand. What is off by less is an error of the sensor, which stays while it does.
    ``residuals`` are (m, 3), metres.
    """
    turned_m = np.linalg.norm(points, axis=1) * max(settings.angular_velocity_noise)
    noise_m = np.hypot(max(settings.linear_velocity_noise), turned_m)
    off_m = np.linalg.norm(residuals, axis=1)
    return np.asarray(off_m > settings.rejection_threshold * noise_m)


class MotionFactors:
    """Factors ρ of the variances of turning and driving, and what they are found from."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._least = LEAST[settings.motion_noise_factor]
        # (2,) factors of the variances in force: of turning, and of driving
        self.applied: FloatArray = np.ones(2)
        self._logs = np.zeros(2)  # θ
        self._information = np.zeros((2, 2))  # F̄
        self._found = 0  # observations that they were found from
        # (2, p, p) N_j of the motion since the last one, none at first; None if unknown.
        self._shares: FloatArray | None = np.zeros(())

    @property
    def estimates(self) -> list[MotionFactor]:
        """What was found out, as factors of standard deviations; nothing before the first."""
        if not self._found:
            return []
        deviations = 0.5 * np.sqrt(np.diagonal(np.linalg.inv(self._information + _PRIOR)))
        factors, applied = np.exp(0.5 * self._logs).tolist(), np.sqrt(self.applied).tolist()
        each = zip(KINDS, factors, deviations.tolist(), applied, strict=True)
        return [
            MotionFactor(name, factor, deviation, applied, proposed(name, factor, self._settings))
            for name, factor, deviation, applied in each
        ]

    def move(self, shares: FloatArray | None) -> None:
        """Take in N_j (2, p, p) of a motion, as it was applied; None if that says nothing."""
        self._shares = None if shares is None or self._shares is None else self._shares + shares

    def learn(self, r: FloatArray, S: FloatArray, C: FloatArray) -> None:
        """Take in r (m, k), S (m k, m k) and C (m, k, p) since the last time, as they are used."""
        if (factors := self.flat()) is not None:
            degrees = np.full(len(r), r.shape[1])
            learn(factors, r, S, C, degrees, self._settings.rejection_threshold)
        self.take(factors)

    def flat(self) -> Factors | None:
        """Return the factors, and the motion to learn from, as plain arrays; None without one."""
        if self._shares is None or not self._shares.ndim:
            return None
        return Factors(
            self._shares,
            self._logs.copy(),
            self._information.copy(),
            self.applied.copy(),
            self._least,
        )

    def take(self, factors: Factors | None) -> None:
        """Take over factors of :meth:`flat` that have learnt."""
        self._shares = np.zeros(())
        if factors is not None:
            self._logs, self._information = factors.logs, factors.information
            self.applied = factors.applied
            self._found += 1

    def forget_motion(self) -> None:
        """Learn nothing of the motion until now from the next observation."""
        self._shares = np.zeros(())


def learn(
    factors: Factors, r: FloatArray, S: FloatArray, C: FloatArray, degrees: IntArray, gate: float
) -> None:
    """Let factors learn from r (m, k), S (m k, m k), C (m, k, p), of ``degrees`` (m,) each."""
    # As the likelihood at θ has it, which may be less than is applied.
    ratios = np.exp(factors.logs) / factors.applied
    N = ratios[:, None, None] * factors.shares
    C = C.reshape(-1, C.shape[2])
    if np.count_nonzero(ratios != 1.0):
        S = S + C.dot((N - factors.shares).sum(axis=0)).dot(C.T)
    factors.information[:], factors.logs[:] = learnt(
        factors.logs, factors.information, *gated_score(r, S, C, N, degrees, gate)
    )
    if factors.least < math.inf:
        factors.applied[:] = np.exp(np.maximum(factors.logs, factors.least))


def gated_score(
    r: FloatArray, S: FloatArray, C: FloatArray, N: FloatArray, degrees: IntArray, gate: float
) -> tuple[FloatArray, FloatArray]:
    """Return g (2,) and F (2, 2) of residuals r (m, k), without some few that are too far off."""
    solved = solve_definite(S, np.column_stack([r.ravel(), C]))
    squared, (m, k) = float(r.ravel().dot(solved[:, 0])), r.shape
    # No residual is further out than all of them together are.
    if squared > gate**2:
        passed = mahalanobis(r, diagonal_blocks(S, k)) <= gate
        if m < 2 * np.count_nonzero(passed) < 2 * m:
            used = np.flatnonzero(np.repeat(passed, k))
            S = S[np.ix_(used, used)]
            return gated_score(r[passed], S, C[used], N, degrees[passed], gate)
    q = int(degrees.sum())
    return score(C.T.dot(solved[:, 0]), C.T.dot(solved[:, 1:]), N, squared, q)


def proposed(name: str, factor: float, settings: Settings) -> str:
    """Return the settings that state a factor of the noise of ``'turning'`` or ``'driving'``."""
    names = [f'{KINDS[name]}_velocity_noise', f'{KINDS[name]}_scale_noise']
    stated = {each: getattr(settings, each) for each in names}
    return ', '.join(
        f'{each}: [{", ".join(significant(factor * value, 2) for value in values)}]'
        for each, values in stated.items()
        if any(values)
    )


def score(
    u: FloatArray, G: FloatArray, N: FloatArray, squared: float, q: int
) -> tuple[FloatArray, FloatArray]:
    """Return g (2,) and F (2, 2), of q residuals at the squared distance rᵀ S⁻¹ r."""
    # What χ² of q degrees of freedom exceeds once in a hundred times (R. A. Fisher)
    rare = 0.5 * (math.sqrt(2.0 * q - 1.0) + RARE) ** 2
    w, NG = min(1.0, rare / max(squared, 1.0)), N.dot(G)
    g = 0.5 * (w * N.dot(u).dot(u) - N.reshape(2, -1).dot(G.ravel()))
    F = 0.5 * NG.reshape(2, -1).dot(NG.swapaxes(1, 2).reshape(2, -1).T)
    return g, F


def learnt(
    logs: FloatArray, information: FloatArray, g: FloatArray, F: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return F̄ (2, 2) and θ (2,) after an observation of g and F."""
    information = (1.0 - 1.0 / MEMORY) * information + F
    change = np.linalg.solve(information + _PRIOR, g - logs / MEMORY)
    logs = logs + np.minimum(np.maximum(change, -MAX_STEP), MAX_STEP)
    return information, np.minimum(np.maximum(logs, LEAST_LOGARITHM), LARGEST_LOGARITHM)
