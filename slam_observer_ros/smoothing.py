"""The whole trajectory and map in hindsight: Gauss–Newton on the group over all that was seen.

The unknowns are a first pose and the S poses at which landmarks were observed, the n landmarks
and the velocity's calibration c. They are moved by Â_s ← Â_s exp(η_s), p_i ← p_i + dp_i and
c ← c + dc. Landmarks and calibration together are called the border. The normal equations

    [ T   B ] [ η      ]     [ g ]
    [ Bᵀ  D ] [ dc, dp ] = − [ h ]

have a block-tridiagonal T, since odometry links each pose to the next one only; so an iteration
costs O(S n²), not O(S³). Outliers are reweighted in each iteration (Huber).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded

from slam_observer_ros.axes import Axes
from slam_observer_ros.geometry import se3, so3
from slam_observer_ros.settings import Settings
from slam_observer_ros.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Prior:
    """What was known before the first frame.

    Attributes
    ----------
    pose : FloatArray
        (4, 4) pose to which the first motion leads on.
    calibration : FloatArray
        (c,) estimate of the calibration.
    points : FloatArray
        (n, 3) landmarks already known then, metres; the first n of the map.
    covariance : FloatArray
        (d + c + k n, d + c + k n) covariance of (η, dc, dp).

    """

    pose: FloatArray
    calibration: FloatArray
    points: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class Frames:
    """S frames with M observed points: what happened since the prior.

    Attributes
    ----------
    motions : FloatArray
        (S, 4, 4) pose of each frame in the one before it; the first in the prior's pose.
    motion_covariances : FloatArray
        (S, d, d) covariance of each motion as a right perturbation.
    sensitivities : FloatArray
        (S, d, c) derivative of each motion by the calibration, as a right perturbation.
    calibrations : FloatArray
        (S, c) calibration with which each motion was computed.
    frames : IntArray
        (M,) in which frame each point was observed.
    landmarks : IntArray
        (M,) which landmark it is.
    points : FloatArray
        (M, 3) where it was seen, metres, body frame.
    shifts : FloatArray
        (M, 3) how far it had moved by itself by then, metres.
    information : FloatArray
        (M, k, k) inverse covariance of it, body frame, 1/m².

    """

    motions: FloatArray
    motion_covariances: FloatArray
    sensitivities: FloatArray
    calibrations: FloatArray
    frames: IntArray
    landmarks: IntArray
    points: FloatArray
    shifts: FloatArray
    information: FloatArray


@dataclass(frozen=True, slots=True)
class Solution:
    """Estimates in hindsight.

    Attributes
    ----------
    poses : FloatArray
        (S + 1, 4, 4) pose of the prior, then of each frame.
    calibration : FloatArray
        (c,) calibration of the velocity.
    points : FloatArray
        (n, 3) landmarks, metres; of those that move, where they would be had they not.

    """

    poses: FloatArray
    calibration: FloatArray
    points: FloatArray


@dataclass(slots=True)
class _Equations:
    """The normal equations, block by block; S + 1 poses of d axes and a border of b unknowns."""

    diagonal: FloatArray  # (S + 1, d, d)
    above: FloatArray  # (S, d, d) block of poses s and s + 1
    border: FloatArray  # (S + 1, d, b)
    corner: FloatArray  # (b, b)
    gradient: FloatArray  # (S + 1, d)
    border_gradient: FloatArray  # (b,)


class Smoother:
    """Gauss–Newton iterations over a prior and frames.

    Parameters
    ----------
    axes : Axes
        Which axes are estimated: d of the pose, k of a point.
    prior : Prior
        What was known before the first frame.
    frames : Frames
        What happened since.
    settings : Settings
        ``huber_threshold`` and ``rejection_distance``.

    """

    def __init__(self, axes: Axes, prior: Prior, frames: Frames, settings: Settings) -> None:
        self._axes = axes
        self._prior = prior
        self._frames = frames
        self._settings = settings
        self._motion_information = _inverse(frames.motion_covariances)
        self._prior_information = _inverse(prior.covariance)

    def smooth(self, start: Solution, iterations: int, tolerance: float) -> Solution:
        """Iterate from ``start`` until no unknown moves by more than ``tolerance`` (m, rad)."""
        solution = start
        for _ in range(iterations):
            change, border_change = _Factors(self._linearise(solution)).solve()
            solution = self._moved(solution, change, border_change)
            if max(np.abs(change).max(), np.abs(border_change).max(initial=0.0)) < tolerance:
                break
        return solution

    def marginal(self, solution: Solution) -> FloatArray:
        """Return the covariance of (η, dc, dp), η being that of the last pose."""
        return _Factors(self._linearise(solution)).marginal()

    def _moved(
        self, solution: Solution, change: FloatArray, border_change: FloatArray
    ) -> Solution:
        c = len(solution.calibration)
        eta = np.zeros((len(change), 6))
        eta[:, self._axes.pose] = change
        return Solution(
            solution.poses @ se3.exp(eta),
            solution.calibration + border_change[:c],
            solution.points + self._axes.full_points(border_change[c:]),
        )

    def _linearise(self, solution: Solution) -> _Equations:
        d, S = len(self._axes.pose), len(solution.poses)
        b = len(solution.calibration) + self._axes.point * len(solution.points)
        equations = _Equations(
            np.zeros((S, d, d)),
            np.zeros((S - 1, d, d)),
            np.zeros((S, d, b)),
            np.zeros((b, b)),
            np.zeros((S, d)),
            np.zeros(b),
        )
        self._add_prior(equations, solution)
        self._add_motions(equations, solution)
        self._add_observations(equations, solution)
        return equations

    def _add_prior(self, equations: _Equations, solution: Solution) -> None:
        prior, d, k = self._prior, len(self._axes.pose), self._axes.point
        eta, pose = se3.log(se3.inverse(prior.pose) @ solution.poses[0]), self._axes.pose
        shifts = (solution.points[: len(prior.points)] - prior.points)[:, :k]
        off = solution.calibration - prior.calibration
        error = np.concatenate([eta[pose], off, shifts.ravel()])
        information, known = self._prior_information.copy(), len(error) - d
        J = se3.left_jacobian_inverse(-eta)[np.ix_(pose, pose)]
        information[:d] = J.T @ information[:d]
        pull = information @ error
        information[:, :d] = information[:, :d] @ J
        equations.diagonal[0] += information[:d, :d]
        equations.border[0, :, :known] += information[:d, d:]
        equations.corner[:known, :known] += information[d:, d:]
        equations.gradient[0] += pull[:d]
        equations.border_gradient[:known] += pull[d:]

    def _add_motions(self, equations: _Equations, solution: Solution) -> None:
        """Add e_s = log((M_s exp(F_s (c − c_s)))⁻¹ Â_{s−1}⁻¹ Â_s) of each motion M_s."""
        frames, pose, c = self._frames, self._axes.pose, len(solution.calibration)
        eta = np.zeros((len(frames.motions), 6))
        off = solution.calibration - frames.calibrations
        eta[:, pose] = (frames.sensitivities @ off[:, :, None])[:, :, 0]
        step = se3.inverse(solution.poses[:-1]) @ solution.poses[1:]
        error = se3.log(se3.inverse(frames.motions @ se3.exp(eta)) @ step)
        J_right = se3.left_jacobian_inverse(-error)
        J_to = J_right[:, pose][:, :, pose]
        J_from = -(J_right @ se3.adjoint(se3.inverse(step)))[:, pose][:, :, pose]
        J_off = se3.left_jacobian_inverse(error) @ se3.left_jacobian(-eta)
        F = -J_off[:, pose][:, :, pose] @ frames.sensitivities
        W = self._motion_information
        We = W @ error[:, pose, None]
        equations.diagonal[1:] += so3.transpose(J_to) @ W @ J_to
        equations.diagonal[:-1] += so3.transpose(J_from) @ W @ J_from
        equations.above += so3.transpose(J_from) @ W @ J_to
        equations.border[1:, :, :c] += so3.transpose(J_to) @ W @ F
        equations.border[:-1, :, :c] += so3.transpose(J_from) @ W @ F
        equations.corner[:c, :c] += np.sum(so3.transpose(F) @ W @ F, axis=0)
        equations.gradient[1:] += (so3.transpose(J_to) @ We)[:, :, 0]
        equations.gradient[:-1] += (so3.transpose(J_from) @ We)[:, :, 0]
        equations.border_gradient[:c] += np.sum(so3.transpose(F) @ We, axis=0)[:, 0]

    def _add_observations(self, equations: _Equations, solution: Solution) -> None:
        """Add R_Âᵀ (p_i − x_Â) − y of each observed point, with Huber's weight."""
        frames, k = self._frames, self._axes.point
        poses = solution.poses[frames.frames + 1]
        R = poses[:, :3, :3]
        arms = solution.points[frames.landmarks] + frames.shifts - poses[:, :3, 3]
        predicted = (so3.transpose(R) @ arms[:, :, None])[:, :, 0]
        error = (predicted - frames.points)[:, :k]
        J_pose = -self._axes.output_matrix(predicted)
        J_point = so3.transpose(R)[:, :k, :k]
        W = frames.information * self._weights(error)[:, None, None]
        We = W @ error[:, :, None]
        rows = frames.frames + 1
        columns = len(solution.calibration) + k * frames.landmarks[:, None] + np.arange(k)
        axes = np.arange(len(self._axes.pose))
        np.add.at(equations.diagonal, rows, so3.transpose(J_pose) @ W @ J_pose)
        np.add.at(equations.gradient, rows, (so3.transpose(J_pose) @ We)[:, :, 0])
        np.add.at(
            equations.border,
            (rows[:, None, None], axes[:, None], columns[:, None, :]),
            so3.transpose(J_pose) @ W @ J_point,
        )
        np.add.at(
            equations.corner,
            (columns[:, :, None], columns[:, None, :]),
            so3.transpose(J_point) @ W @ J_point,
        )
        np.add.at(equations.border_gradient, columns, (so3.transpose(J_point) @ We)[:, :, 0])

    def _weights(self, error: FloatArray) -> FloatArray:
        """Return Huber's weights (M,), which fall off faster where a filter would reject."""
        huber, rejection = self._settings.huber_threshold, self._settings.rejection_distance
        squared = (error[:, None, :] @ self._frames.information @ error[:, :, None])[:, 0, 0]
        weights: FloatArray = np.minimum(1.0, rejection**2 / np.maximum(squared, rejection**2))
        if huber > 0.0:
            weights = weights * huber / np.sqrt(np.maximum(squared, huber**2))
        return weights


class _Factors:
    """Factors of the normal equations: banded for the poses, dense for the border."""

    def __init__(self, equations: _Equations) -> None:
        S, d, b = equations.border.shape
        self._d = d
        self._chain = cholesky_banded(_banded(equations.diagonal, equations.above))
        border = equations.border.reshape(S * d, b)
        self._gradient = equations.gradient.ravel()
        self._eliminated = self._solve_chain(border)
        self._corner = cho_factor(equations.corner - border.T @ self._eliminated)
        self._border = border
        self._border_gradient = equations.border_gradient

    def solve(self) -> tuple[FloatArray, FloatArray]:
        """Return the changes (S, d) of the poses and (b,) of the border."""
        chain = self._solve_chain(self._gradient)
        border: FloatArray = -cho_solve(
            self._corner, self._border_gradient - self._border.T @ chain
        )
        return (-chain - self._eliminated @ border).reshape(-1, self._d), border

    def marginal(self) -> FloatArray:
        """Return the covariance (d + b, d + b) of the last pose and the border."""
        d, b = self._d, self._border.shape[1]
        last = np.zeros((len(self._gradient), d))
        last[-d:] = np.eye(d)
        corner = cho_solve(self._corner, np.eye(b))
        tail = self._eliminated[-d:]
        covariance = np.empty((d + b, d + b))
        covariance[:d, :d] = self._solve_chain(last)[-d:] + tail @ corner @ tail.T
        covariance[:d, d:] = -tail @ corner
        covariance[d:, :d] = covariance[:d, d:].T
        covariance[d:, d:] = corner
        return covariance

    def _solve_chain(self, right: FloatArray) -> FloatArray:
        return np.asarray(cho_solve_banded((self._chain, False), right), dtype=np.float64)


def _banded(diagonal: FloatArray, above: FloatArray) -> FloatArray:
    """Return the upper banded form (2 d, S d) of a block-tridiagonal matrix."""
    S, d = diagonal.shape[:2]
    band = np.zeros((2 * d, S, d))
    for row in range(d):
        for column in range(row, d):
            band[2 * d - 1 + row - column, :, column] = diagonal[:, row, column]
        for column in range(d):
            band[d - 1 + row - column, 1:, column] = above[:, row, column]
    return band.reshape(2 * d, S * d)


def _inverse(covariances: FloatArray) -> FloatArray:
    """Return inverses of covariances (…, d, d), taking what is exact to be known to 1e-6."""
    jitter = 1e-12 * np.eye(covariances.shape[-1])
    return np.asarray(np.linalg.inv(covariances + jitter), dtype=np.float64)
