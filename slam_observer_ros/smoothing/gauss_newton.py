"""The smoothed trajectory and map: Gauss–Newton on the group over all that was seen.

The unknowns are a first pose and the S poses at which landmarks were observed, the n landmarks
and the calibration c. They are moved by Â_s ← Â_s exp(η_s), p_i ← p_i + dp_i and
c ← c + dc. Of a landmark with an orientation dp_i ends in its turn, B̂_i ← exp(ω_i) B̂_i.
Landmarks and calibration together are called the border. The normal equations

    [ T   B ] [ η      ]     [ g ]
    [ Bᵀ  D ] [ dc, dp ] = − [ h ]

have a block-tridiagonal T, since odometry links each pose to the next one only; so an iteration
costs O(S n²), not O(S³). Where the calibration drifts, each pose has one of its own, in T.
Outliers are reweighted in each iteration (Huber).
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from types import ModuleType
from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_array

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.events import POINT
from slam_observer_ros.filter.arrays import UNKNOWN_RAD
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.axes import EstimatedAxes, PLANAR
from slam_observer_ros.lie.matrices import transpose
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.smoothing.bordered_chain import (
    ChainFactors,
    COMPILED,
    Equations,
    landmark_columns,
)
from slam_observer_ros.smoothing.keyframes import inverse, Keyframes, Solution
from slam_observer_ros.smoothing.observations import NO_SENSORS, normal, Observations, SensedPoints
from slam_observer_ros.smoothing.prior import Prior


@dataclass(frozen=True, slots=True)
class Step:
    """One Gauss–Newton step."""

    start: Solution  # where all was linearised
    end: Solution
    factors: ChainFactors  # of the equations at ``start``, so its marginal is of (η, dc, dp) there


MOST_HALVED = 8  # times at most that a step is halved


class _LinkErrors(NamedTuple):
    """How far motions are off at a solution, and what their derivatives are made of."""

    e: FloatArray  # (S, d)
    twists: FloatArray  # (S, 6) ln of the motions that are left
    eta: FloatArray  # (S, 6) F_s (c − c_s), by which calibration has changed the motions
    back: FloatArray  # (S, 4, 4) from each pose to the one before
    led: FloatArray  # (S, 4, 4) and on again by the motion


class Smoother:
    """Gauss–Newton iterations over a prior and the keyframes since.

    ``axes`` are the d of the pose, k of a point and q of a turn that are estimated; of the
    settings, ``huber_threshold`` and ``rejection_threshold`` weigh outliers, and
    ``calibration_drift`` says whether there is one calibration, of the border, or one at each of
    the chain's poses.
    ``sensed`` are the points where their sensors are calibrated.
    """

    def __init__(
        self,
        axes: EstimatedAxes,
        prior: Prior,
        keyframes: Keyframes,
        settings: Settings,
        sensed: SensedPoints | None = None,
    ) -> None:
        self._axes, self._prior, self._keyframes = axes, prior, keyframes
        self._settings, self._sensed = settings, sensed
        self._observations = Observations(axes, keyframes, settings, sensed)
        self._unknowns = axes.point + axes.turn  # of a landmark: its position, then its turn
        drifts, c = settings.calibration_drift > 0.0, len(prior.calibration)
        self._chained, self._shared = (c, 0) if drifts else (0, c)
        self._link_information = inverse(keyframes.links.covariances)
        if drifts:
            d, of_motions = axes.p, self._link_information
            self._link_information = np.zeros((len(of_motions), d + c, d + c))
            self._link_information[:, :d, :d] = of_motions
            self._link_information[:, d:, d:] = inverse(keyframes.drift_covariances)
        self._prior_information = inverse(prior.covariance)
        self._is_usual = not axes.turn and not drifts
        self._as_given = self._observations
        self._are_half = np.flatnonzero(keyframes.kinds != POINT)

    def smooth(
        self, start: Solution, iterations: int, tolerance: float, gated: bool = True
    ) -> Step:
        """Iterate from ``start``; return the last step.

        That is the first which moves neither the last pose nor the border by ``tolerance`` (m,
        rad), or the last of ``iterations``. If ``gated``, what a filter rejects has less weight.
        """
        for _ in range(iterations):
            if len(self._are_half):
                self._complete(start)
            factors = self._factors(start, gated)
            change, border_change = factors.solve()
            step = Step(start, self._moved(start, change, border_change), factors)
            if max(np.abs(change[-1]).max(), np.abs(border_change).max(initial=0.0)) < tolerance:
                break
            start = step.end
        return step

    def descend(
        self, start: Solution, iterations: int, tolerance: float, slack: float = 0.0
    ) -> tuple[Step, float]:
        """Return the last step, as :meth:`smooth`, and the cost at its end, which is the least.

        A step that would go up by more than ``slack`` is halved until it does not: so far from the
        end it is too long.
        """
        cost = self.cost(start)  # which completes half points as well
        for _ in range(iterations):
            factors = self._factors(start, gated=False)
            change, border_change = factors.solve()
            before, cost = cost, math.inf
            for share in 0.5 ** np.arange(MOST_HALVED):
                end = self._moved(start, share * change, share * border_change)
                if (cost := self.cost(end)) < before + slack:
                    break
            step = Step(start, end if cost < before else start, factors)
            if cost > before - tolerance:
                break
            start = step.end
        return step, min(cost, before)

    def evidence(self, step: Step, cost: float) -> float:
        """Return −2 ln of the likelihood of all that was seen, wherever it was seen from.

        By Laplace, about what :meth:`descend` found: landmarks may be anywhere, one in each m^k.
        As in :mod:`.joint_compatibility` the noise's own 1 / √|2π R| are left out.
        """
        known = np.linalg.slogdet(self._link_information)[1].sum()
        known += np.linalg.slogdet(self._prior_information)[1]
        known += self._axes.point * np.log(self._keyframes.shares).sum()
        new = len(step.end.points) - len(self._prior.points)
        free = self._axes.point * new * math.log(2.0 * math.pi)
        return cost + step.factors.log_det() - float(known) - free

    def cost(self, solution: Solution) -> float:
        """Return −2 ln of the likelihood of all at a solution, but for a constant."""
        if len(self._are_half):
            self._complete(solution)
        error = self._link_errors(solution).e
        cost = float(np.einsum('si,sij,sj->', error, self._link_information, error))
        at = solution.poses[0], solution.calibrations[0], solution.points, solution.orientations
        error = self._prior.errors(self._axes, *at)[0]
        cost += float(error @ self._prior_information @ error)
        if (besides := self._prior.besides) is not None:
            values = solution.calibrations[0]
            cost += float(values @ (besides[0] @ values - 2.0 * besides[1]))
        return cost + self._observations.cost(solution)

    def _complete(self, solution: Solution) -> None:
        """Complete half points by a solution."""
        keyframes, sensed = self._as_given.completed(solution, self._are_half)
        self._keyframes, self._sensed = keyframes, sensed
        self._observations = Observations(self._axes, keyframes, self._settings, sensed)

    def motion_errors(self, solution: Solution) -> FloatArray:
        """Return by how much the motions are off (S, d), as right perturbations, rad and m."""
        return self._link_errors(solution).e[:, : self._axes.p]

    def ungated(self, start: Solution) -> Solution:
        """Return ``start``, if something is gated there after an iteration without the gate."""
        if not self._observations.some_are_gated(start):
            return start
        return self._moved(start, *self._factors(start, gated=False).solve())

    def _factors(self, solution: Solution, gated: bool) -> ChainFactors:
        equations = self._linearise(solution, gated)
        if (besides := self._prior.besides) is not None:
            information, vector = besides
            c, d = len(vector), self._axes.p
            gradient = information @ solution.calibrations[0] - vector
            if self._shared:
                equations.corner[:c, :c] += information
                equations.border_gradient[:c] += gradient
            else:
                equations.diagonal[0, d:, d:] += information
                equations.gradient[0, d:] += gradient
        return ChainFactors(equations)

    def _moved(
        self, solution: Solution, change: FloatArray, border_change: FloatArray
    ) -> Solution:
        d, c = self._axes.p, self._shared
        eta = np.zeros((len(change), 6))
        eta[:, self._axes.pose] = change[:, :d]
        landmark_changes = border_change[c:].reshape(-1, self._unknowns)
        shifts, turns = np.hsplit(landmark_changes, [self._axes.point])
        return Solution(
            solution.poses @ se3.exp(eta),
            solution.calibrations + (border_change[:c] if c else change[:, d:]),
            solution.points + self._axes.full_points(shifts),
            so3.exp(self._axes.full_turns(turns)) @ solution.orientations,
        )

    def _linearise(self, solution: Solution, gated: bool = True) -> Equations:
        if COMPILED is not None and self._is_usual:
            return self._linearised_by(COMPILED, solution, gated)
        equations, n = self._no_equations(solution), len(solution.points)
        k, (S, d) = self._unknowns, equations.gradient.shape
        # What the observations say of poses, landmarks, and of both together.
        H, gradient = self._observations.normal_equations(solution, self._chained, gated)
        poses, landmarks = equations.poses, equations.landmarks
        columns = landmark_columns(np.arange(n), self._shared, k)
        end = d + k  # beyond are sensors
        of_landmarks = _sum_by(landmarks, n, H[:, d:end, d:end])
        equations.corner[columns[:, :, None], columns[:, None]] = of_landmarks
        equations.border_gradient[columns] = _sum_by(landmarks, n, gradient[:, d:end])
        equations.diagonal[:] = _sum_by(poses, S, H[:, :d, :d])
        equations.gradient[:] = _sum_by(poses, S, gradient[:, :d])
        equations.seen[:] = H[:, :d, d:end]
        if H.shape[1] > end:
            self._add_sensors(equations, H[:, end:], gradient[:, end:])
        self._add_prior(equations, solution)
        self._add_motions(equations, solution)
        return equations

    def _no_equations(self, solution: Solution) -> Equations:
        """Return equations of the right sizes that say nothing yet."""
        c, k, keyframes = self._shared, self._unknowns, self._keyframes
        d, S, b = self._axes.p + self._chained, len(solution.poses), c + k * len(solution.points)
        return Equations(
            diagonal=np.zeros((S, d, d)),
            above=np.zeros((S - 1, d, d)),
            shared=np.zeros((S, d, c)),
            poses=keyframes.keyframes + 1,
            landmarks=keyframes.landmarks,
            seen=np.zeros((len(keyframes.landmarks), d, k)),
            first=np.zeros((d, b)),
            corner=np.zeros((b, b)),
            gradient=np.zeros((S, d)),
            border_gradient=np.zeros(b),
        )

    def _linearised_by(self, compiled: ModuleType, solution: Solution, gated: bool) -> Equations:
        """Return the same by ``_gauss_newton.c``."""
        equations, keyframes = self._no_equations(solution), self._keyframes
        prior, links, settings = self._prior, keyframes.links, self._settings
        information, calibration = self._prior_information, solution.calibrations[0]
        sensed = NO_SENSORS if self._sensed is None else self._sensed.flat(calibration)
        gate = settings.rejection_threshold if gated else 0.0
        parts = (
            equations,
            (prior.pose, prior.calibration, prior.points, information, prior.is_relative),
            (links.motions, links.sensitivities, self._link_information, keyframes.calibrations),
            (keyframes.points, keyframes.information, keyframes.shares, *sensed),
            (solution.poses, calibration, solution.points),
            (gate, settings.huber_threshold, self._axes.p == PLANAR.p),
        )
        # An array may be a view of another one.
        compiled.linearise(
            *(
                tuple(np.ascontiguousarray(x) if isinstance(x, np.ndarray) else x for x in part)
                for part in parts
            )
        )
        return equations

    def _add_sensors(self, equations: Equations, H: FloatArray, gradient: FloatArray) -> None:
        """Add what observations say of sensors, the last c_s entries of c: H (M, c_s, q)."""
        c, k, (S, d) = self._shared, self._unknowns, equations.gradient.shape
        n = (len(equations.corner) - c) // k
        sensors, columns = slice(c - H.shape[1], c), landmark_columns(np.arange(n), c, k).ravel()
        of_landmarks = _sum_by(equations.landmarks, n, transpose(H[:, :, d : d + k]))
        of_landmarks = of_landmarks.reshape(-1, H.shape[1])
        equations.shared[:, :, sensors] += _sum_by(equations.poses, S, transpose(H[:, :, :d]))
        equations.corner[columns, sensors] += of_landmarks
        equations.corner[sensors, columns] += of_landmarks.T
        equations.corner[sensors, sensors] += np.sum(H[:, :, d + k :], axis=0)
        equations.border_gradient[sensors] += np.sum(gradient, axis=0)

    def _add_prior(self, equations: Equations, solution: Solution) -> None:
        information, gradient = self._prior.normal_equations(
            self._axes,
            self._prior_information,
            solution.poses[0],
            solution.calibrations[0],
            solution.points,
            solution.orientations,
        )
        d = self._axes.p + self._chained
        known = len(gradient) - d
        equations.diagonal[0] += information[:d, :d]
        equations.first[:, :known] += information[:d, d:]
        equations.corner[:known, :known] += information[d:, d:]
        equations.gradient[0] += gradient[:d]
        equations.border_gradient[:known] += gradient[d:]
        # Of the turns of landmarks since then nothing was known.
        new = landmark_columns(
            np.arange(len(self._prior.points), len(solution.points)), self._shared, self._unknowns
        )[:, self._axes.point :].ravel()
        equations.corner[new, new] += UNKNOWN_RAD**-2

    def _add_motions(self, equations: Equations, solution: Solution) -> None:
        """Add e_s = log((M_s exp(F_s (c − c_s)))⁻¹ Â_{s−1}⁻¹ Â_s) of each motion M_s."""
        d, c = self._axes.p + self._chained, self._shared
        J, error = self._links(solution)
        H, gradient = normal(J, self._link_information, error)
        # The blocks of the poses before (:-1) and after (1:), and of the calibration.
        equations.diagonal[:-1] += H[:, :d, :d]
        equations.diagonal[1:] += H[:, d : 2 * d, d : 2 * d]
        equations.above[:] += H[:, :d, d : 2 * d]
        equations.shared[:-1] += H[:, :d, 2 * d :]
        equations.shared[1:] += H[:, d : 2 * d, 2 * d :]
        equations.corner[:c, :c] += np.sum(H[:, 2 * d :, 2 * d :], axis=0)
        equations.gradient[:-1] += gradient[:, :d]
        equations.gradient[1:] += gradient[:, d : 2 * d]
        equations.border_gradient[:c] += np.sum(gradient[:, 2 * d :], axis=0)

    def _links(self, solution: Solution) -> tuple[FloatArray, FloatArray]:
        """Return derivatives of e_s (S, d) by poses and calibration; drift adds c_s − c_{s−1}."""
        error, twists, eta, back, led = self._link_errors(solution)
        # Derivatives by the pose after a motion, by that before, and by the calibration.
        J_to = self._estimated(se3.left_jacobian_inverse(-twists))
        J_from = -J_to @ self._estimated(se3.adjoint(back))
        F = self._keyframes.links.sensitivities
        if F.shape[2]:
            J_off = -J_to @ self._estimated(se3.adjoint(led) @ se3.left_jacobian(-eta))
            F = J_off @ F
        if not self._chained:
            return np.concatenate([J_from, J_to, F], axis=2), error
        # (S, d + c, 2 d + 2 c), by both poses and their calibrations
        d, c = F.shape[1:]
        J = np.zeros((len(F), d + c, 2 * (d + c)))
        J[:, :d, :d], J[:, :d, d : d + c], J[:, :d, d + c : -c] = J_from, F, J_to
        J[:, d:, d : d + c], J[:, d:, -c:] = -np.eye(c), np.eye(c)
        return J, error

    def _link_errors(self, solution: Solution) -> _LinkErrors:
        """Return how far motions are off, and what their derivatives are made of."""
        # The motions, had they been computed with this calibration.
        keyframes, links, pose = self._keyframes, self._keyframes.links, self._axes.pose
        eta = np.zeros((len(keyframes.calibrations), 6))
        off = solution.calibrations[:-1] - keyframes.calibrations
        eta[:, pose] = (links.sensitivities @ off[:, :, None])[:, :, 0]
        back = se3.inverse(solution.poses[1:]) @ solution.poses[:-1]
        led = back @ (links.motions @ se3.exp(eta))
        twists = se3.log(se3.inverse(led))
        error = twists[:, pose]
        if self._chained:
            error = np.hstack([error, np.diff(solution.calibrations, axis=0)])
        return _LinkErrors(error, twists, eta, back, led)

    def _estimated(self, matrices: FloatArray) -> FloatArray:
        """Return the rows and columns (S, d, d) of (S, 6, 6) on the axes that are estimated."""
        pose = self._axes.pose
        return matrices[:, pose, pose]


def _sum_by(labels: IntArray, count: int, values: FloatArray) -> FloatArray:
    """Return the sum of the ``values`` (M, …) of each label (count, …)."""
    M = len(labels)
    selection = csc_array((np.ones(M), labels, np.arange(M + 1)), (count, M))
    sums: FloatArray = selection @ values.reshape(M, math.prod(values.shape[1:]))
    return sums.reshape(count, *values.shape[1:])
