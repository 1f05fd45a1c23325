"""Pose, calibration and landmarks as they were known at one instant."""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

import numpy as np
from scipy.linalg import block_diag

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.filter.arrays import UNKNOWN_RAD
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.axes import EstimatedAxes
from slam_observer_ros.lie.matrices import solve_definite, transpose
from slam_observer_ros.smoothing.keyframes import EXACT_M

ANYWHERE_M = 1e3  # standard deviation of an unknown landmark, metres


@dataclass(frozen=True, slots=True)
class Prior:
    """Estimates with the covariance of their errors: pose exp(η), c + dc and p_i + dp_i.

    Where orientations B_i are estimated, dp_i ends in the turn ω_i of exp(ω_i) B_i, on
    as many of its axes as ``axes`` have.
    """

    pose: FloatArray  # (4, 4) P
    calibration: FloatArray  # (c,)
    points: FloatArray  # (n, 3) landmarks that were known, metres; the first n of the map
    orientations: FloatArray  # (n, 3, 3) of these, zero where unknown or not estimated
    covariance: FloatArray  # (d + c + k n, d + c + k n) of (η, dc, dp)
    # Whether the covariance is of (η, dc, dy) instead, with y_i = P⁻¹ p_i as seen from the pose;
    # then orientations are as seen from there, too.
    is_relative: bool = False
    # Λ (c, c) and λ (c,) of the calibration that has been measured besides: −ln p = ½ cᵀΛc − λᵀc
    besides: tuple[FloatArray, FloatArray] | None = None

    def relative(self, axes: EstimatedAxes) -> Prior:
        """Return the same knowledge, but of where the landmarks lie as seen from the pose.

        dy_i is Rᵀ dp_i − C_i η, with C_i the output matrix at y_i and R the pose's rotation.
        """
        d, first = axes.p, self._first_point(axes)
        y = se3.transform(se3.inverse(self.pose), self.points)
        C, R = self._output_matrix(axes, y).reshape(-1, d), self._rotation(axes, self.pose)
        covariance = self.covariance.copy()
        for rows in (covariance, covariance.T):  # a view: its rows are the columns
            rows[first:] = _turned(rows[first:], R.T) - C @ rows[:d]
        return replace(self, covariance=covariance, is_relative=True)

    def least_nonlinear(self, axes: EstimatedAxes) -> tuple[Prior, float]:
        """Return the prior in the coordinates, world's or body's, that heading changes least.

        Return the standard deviation, rad, of the angle by which it may yet turn in these, too. A
        map that the robot has made may turn as a whole and together with the pose, further than
        one may turn against the other: in world coordinates that is an error of second order in
        the angle. In a loaded map the pose alone may turn, after a blind stretch either, and far.
        """
        turns = self._turns(axes)
        together = self._turned_together(axes)
        alone = float(np.trace(self.covariance[turns, turns])) - together
        if together < alone:
            return self, math.sqrt(together)
        relative = self.relative(axes)
        return relative, math.sqrt(relative._turned_together(axes))

    def _turned_together(self, axes: EstimatedAxes) -> float:
        """Return the variance of the pose's angle as far as landmarks are turned with it, rad²."""
        turns, first = self._turns(axes), self._first_point(axes)
        shared, own = self.covariance[turns, first:], self.covariance[first:, first:]
        least = EXACT_M**2 + np.finfo(np.float64).eps * np.trace(own)
        regular = own + least * np.eye(len(own))
        return max(float(np.trace(shared @ solve_definite(regular, shared.T))), 0.0)

    def without(self, axes: EstimatedAxes, rows: IntArray) -> Prior:
        """Return the prior without the landmarks at ``rows``; those behind move up."""
        known, columns = self._known(axes, rows)
        if not len(known):
            return self
        return replace(
            self,
            points=np.delete(self.points, known, axis=0),
            covariance=np.delete(np.delete(self.covariance, columns, 0), columns, 1),
            orientations=np.delete(self.orientations, known, axis=0),
        )

    def with_calibration(
        self, axes: EstimatedAxes, values: FloatArray, variances: FloatArray
    ) -> Prior:
        """Return the prior with more of a calibration (c,), independent of all else."""
        first, more = self._first_point(axes), len(values)
        at = np.append(np.arange(first), np.arange(first, len(self.covariance)) + more)
        covariance = np.zeros((len(self.covariance) + more,) * 2)
        covariance[np.ix_(at, at)] = self.covariance
        new = np.arange(first, first + more)
        covariance[new, new] = variances
        calibration, besides = np.append(self.calibration, values), self.besides
        if besides is not None:
            information, vector = besides
            besides = np.pad(information, (0, more)), np.pad(vector, (0, more))
        return replace(self, calibration=calibration, covariance=covariance, besides=besides)

    def knowing(self, information: FloatArray, vector: FloatArray) -> Prior:
        """Return the prior with more that is known of the calibration ``besides``."""
        if self.besides is not None:
            information, vector = information + self.besides[0], vector + self.besides[1]
        return replace(self, besides=(information, vector))

    def with_unknown(self, axes: EstimatedAxes, rows: IntArray) -> Prior:
        """Return the prior with landmarks at ``rows`` that may be anywhere."""
        _, columns = self._known(axes, rows)
        unknown = replace(self, covariance=_with_unknown(self.covariance, columns, ANYWHERE_M))
        return unknown.with_unknown_turns(axes, rows)

    def with_unknown_turns(self, axes: EstimatedAxes, rows: IntArray) -> Prior:
        """Return the prior with landmarks at ``rows`` that may be turned in any way."""
        known, columns = self._known(axes, rows)
        orientations = self.orientations.copy()
        orientations[known] = 0.0
        turns = columns.reshape(len(known), self._unknowns(axes))[:, axes.point :].ravel()
        covariance = _with_unknown(self.covariance, turns, UNKNOWN_RAD)
        return replace(self, covariance=covariance, orientations=orientations)

    def normal_equations(
        self,
        axes: EstimatedAxes,
        information: FloatArray,
        pose: FloatArray,
        calibration: FloatArray,
        points: FloatArray,
        orientations: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Return Jᵀ W J and Jᵀ W e of the error e of estimates, by (η, dc, dp) of these.

        ``information`` is W, the inverse of the covariance; estimates are a pose (4, 4),
        calibration (c,), points (n + …, 3) and orientations (n + …, 3, 3).
        """
        d, k, first = axes.p, self._unknowns(axes), self._first_point(axes)
        error, eta, y, turns = self.errors(axes, pose, calibration, points, orientations)
        # Its derivatives.
        J_turns = axes.turn_covariances(so3.left_jacobian_inverse(turns))
        J_eta = se3.left_jacobian_inverse(-eta)[axes.pose, axes.pose]
        C, R = np.zeros((len(error) - first, d)), np.eye(k)
        if self.is_relative:
            C, R = self._output_matrix(axes, y).reshape(-1, d), self._rotation(axes, pose)

        def pull_back(rows: FloatArray) -> FloatArray:
            """Return Jᵀ b for rows b, J = [[J_η, 0, 0], [0, I, 0], [−C, 0, Rᵀ]], by J_turns."""
            pulled: FloatArray = rows.copy()
            of_turns = pulled[first:].reshape(len(J_turns), k, rows.shape[1])[:, axes.point :]
            of_turns[:] = transpose(J_turns) @ of_turns
            rows = pulled.copy()
            pulled[:d] = J_eta.T @ rows[:d] - C.T @ rows[first:]
            pulled[first:] = _turned(rows[first:], R)
            return pulled

        gradient = pull_back((information @ error)[:, None])[:, 0]
        return pull_back(pull_back(information).T), gradient

    def errors(
        self,
        axes: EstimatedAxes,
        pose: FloatArray,
        calibration: FloatArray,
        points: FloatArray,
        orientations: FloatArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the error of pose, calibration and landmarks, and which of it is nonlinear.

        That are the pose's twist (6,), and points as they are seen and their turns (n, 3).
        """
        eta = se3.log(se3.inverse(self.pose) @ pose)
        y = self._seen_from(pose, points[: len(self.points)])
        shifts = (y - self._seen_from(self.pose, self.points))[:, : axes.point]
        turns = self._turns_from(pose, orientations[: len(self.points)])
        shifts = np.hstack([shifts, axes.turns(turns)])
        off = [eta[axes.pose], calibration - self.calibration, shifts.ravel()]
        return np.concatenate(off), eta, y, turns

    def _seen_from(self, pose: FloatArray, points: FloatArray) -> FloatArray:
        """Return points (n, 3) in the frame in which they are known: a pose's or the world."""
        return se3.transform(se3.inverse(pose), points) if self.is_relative else points

    def _turns_from(self, pose: FloatArray, orientations: FloatArray) -> FloatArray:
        """Return turns (n, 3) from known orientations to others (n, 3, 3), 0 if one is unknown."""
        are_known = self.orientations.any(axis=(1, 2)) & orientations.any(axis=(1, 2))
        before, now = self.orientations[are_known], orientations[are_known]
        if self.is_relative:
            before, now = self.pose[:3, :3].T @ before, pose[:3, :3].T @ now
        turns = np.zeros((len(orientations), 3))
        turns[are_known] = so3.log(now @ transpose(before))
        return turns

    def _unknowns(self, axes: EstimatedAxes) -> int:
        """Return how many unknowns a landmark has."""
        return axes.point + axes.turn

    def _output_matrix(self, axes: EstimatedAxes, y: FloatArray) -> FloatArray:
        """Return (n, k, d) blocks: how the pose moves and turns landmarks at ``y`` (n, 3)."""
        C = axes.output_matrix(y)
        turns = np.eye(axes.turn, axes.p)
        return np.concatenate([C, np.tile(turns, (len(y), 1, 1))], axis=1)

    def _rotation(self, axes: EstimatedAxes, pose: FloatArray) -> FloatArray:
        """Return R (k, k) of a pose, for the unknowns of a landmark."""
        R, turned = pose[: axes.point, : axes.point], axes.turn_covariances(pose[None, :3, :3])[0]
        full: FloatArray = block_diag(R, turned)
        return full

    def _turns(self, axes: EstimatedAxes) -> slice:
        """Return the columns of the pose's angles, which come before its shifts."""
        return slice(axes.p - axes.point)

    def _first_point(self, axes: EstimatedAxes) -> int:
        """Return the first column of the landmarks."""
        return len(self.covariance) - self._unknowns(axes) * len(self.points)

    def _known(self, axes: EstimatedAxes, rows: IntArray) -> tuple[IntArray, IntArray]:
        """Return which of the landmarks (m,) were known, and their columns."""
        known, k = rows[rows < len(self.points)], self._unknowns(axes)
        return known, (self._first_point(axes) + k * known[:, None] + np.arange(k)).ravel()


def _with_unknown(covariance: FloatArray, columns: IntArray, sigma: float) -> FloatArray:
    """Return a covariance in which ``columns`` are independent of all else, and all but free."""
    changed: FloatArray = covariance.copy()
    changed[columns] = changed[:, columns] = 0.0
    changed[columns, columns] = sigma**2
    return changed


def _turned(rows: FloatArray, R: FloatArray) -> FloatArray:
    """Return rows (k n, …), k of each landmark, turned by R (k, k)."""
    turned: FloatArray = R @ rows.reshape(-1, len(R), rows.shape[1])
    return turned.reshape(rows.shape)
