"""What was known at one instant of the pose, the calibration and the landmarks."""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.axes import EstimatedAxes

ANYWHERE_M = 1e3
"""Standard deviation of a landmark of which nothing is known, metres."""

EXACT_M = 1e-6
"""Standard deviation of what is said to be exact, metres."""


@dataclass(frozen=True, slots=True)
class Prior:
    """Estimates with the covariance of their errors: pose exp(η), c + dc and p_i + dp_i."""

    pose: FloatArray  # (4, 4) P
    calibration: FloatArray  # (c,)
    points: FloatArray  # (n, 3) landmarks that were known, metres; the first n of the map
    covariance: FloatArray  # (d + c + k n, d + c + k n) of (η, dc, dp)
    # Whether it is that of (η, dc, dy) instead, of y_i = P⁻¹ p_i as seen from the pose.
    is_relative: bool = False

    def relative(self, axes: EstimatedAxes) -> Prior:
        """Return the same knowledge, but of where the landmarks lie as seen from the pose.

        dy_i is Rᵀ dp_i − C_i η, with C_i the output matrix at y_i and R the pose's rotation.
        """
        d, k, first = axes.p, axes.point, self._first_point(axes)
        y = se3.transform(se3.inverse(self.pose), self.points)
        C, R = axes.output_matrix(y).reshape(-1, d), self.pose[:k, :k]
        covariance = self.covariance.copy()
        for rows in (covariance, covariance.T):  # a view: its rows are the columns
            rows[first:] = _turned(rows[first:], R.T) - C @ rows[:d]
        return replace(self, covariance=covariance, is_relative=True)

    def least_nonlinear(self, axes: EstimatedAxes) -> tuple[Prior, float]:
        """Return the prior in the coordinates, world's or body's, that heading changes least.

        And the standard deviation, rad, of the angle by which it may yet turn in these. A map that
        the robot has made may turn as a whole, and the pose with it, by more than one against the
        other: in world coordinates that is an error of second order in the angle. In a loaded map
        the pose alone may turn. After a blind stretch either may turn far.
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
        return max(float(np.trace(shared @ np.linalg.solve(regular, shared.T))), 0.0)

    def without(self, axes: EstimatedAxes, rows: IntArray) -> Prior:
        """Return the prior without the landmarks at ``rows``; those behind move up."""
        known, columns = self._known(axes, rows)
        return replace(
            self,
            points=np.delete(self.points, known, axis=0),
            covariance=np.delete(np.delete(self.covariance, columns, 0), columns, 1),
        )

    def with_unknown(self, axes: EstimatedAxes, rows: IntArray) -> Prior:
        """Return the prior with landmarks at ``rows`` that may be anywhere."""
        _, columns = self._known(axes, rows)
        covariance = self.covariance.copy()
        covariance[columns] = covariance[:, columns] = 0.0
        covariance[columns, columns] = ANYWHERE_M**2
        return replace(self, covariance=covariance)

    def normal_equations(
        self,
        axes: EstimatedAxes,
        information: FloatArray,
        pose: FloatArray,
        calibration: FloatArray,
        points: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Return Jᵀ W J and Jᵀ W e of the error e of estimates, by (η, dc, dp) of these.

        ``information`` is W, the inverse of the covariance; estimates are a pose (4, 4),
        calibration (c,) and points (n + …, 3).
        """
        d, k, first = axes.p, axes.point, self._first_point(axes)
        # The error of pose, calibration and landmarks, and its derivatives.
        eta = se3.log(se3.inverse(self.pose) @ pose)
        y = self._seen_from(pose, points[: len(self.points)])
        shifts = (y - self._seen_from(self.pose, self.points))[:, :k].ravel()
        error = np.concatenate([eta[axes.pose], calibration - self.calibration, shifts])
        J_eta = se3.left_jacobian_inverse(-eta)[axes.pose, axes.pose]
        C, R = np.zeros((len(shifts), d)), np.eye(k)
        if self.is_relative:
            C, R = axes.output_matrix(y).reshape(-1, d), pose[:k, :k]

        def pull_back(rows: FloatArray) -> FloatArray:
            """Return Jᵀ b for rows b, J = [[J_η, 0, 0], [0, I, 0], [−C, 0, Rᵀ for each point]]."""
            pulled: FloatArray = rows.copy()
            pulled[:d] = J_eta.T @ rows[:d] - C.T @ rows[first:]
            pulled[first:] = _turned(rows[first:], R)
            return pulled

        gradient = pull_back((information @ error)[:, None])[:, 0]
        return pull_back(pull_back(information).T), gradient

    def _seen_from(self, pose: FloatArray, points: FloatArray) -> FloatArray:
        """Return points (n, 3) in the frame in which they are known: a pose's or the world."""
        return se3.transform(se3.inverse(pose), points) if self.is_relative else points

    def _turns(self, axes: EstimatedAxes) -> slice:
        """Return the columns of the pose's angles, which come before its shifts."""
        return slice(axes.p - axes.point)

    def _first_point(self, axes: EstimatedAxes) -> int:
        """Return the first column of the landmarks."""
        return len(self.covariance) - axes.point * len(self.points)

    def _known(self, axes: EstimatedAxes, rows: IntArray) -> tuple[IntArray, IntArray]:
        """Return those of landmarks (m,) that were known, and their columns."""
        known, k = rows[rows < len(self.points)], axes.point
        return known, (self._first_point(axes) + k * known[:, None] + np.arange(k)).ravel()


def _turned(rows: FloatArray, R: FloatArray) -> FloatArray:
    """Return rows (k n, …), k of each landmark, turned by R (k, k)."""
    turned: FloatArray = R @ rows.reshape(-1, len(R), rows.shape[1])
    return turned.reshape(rows.shape)
