"""What observed points, and how their tags are turned, say of poses and landmarks.

Errors are along the axes of the pose from which a landmark was seen: R_Âᵀ (p_i − x_Â) − y of its
position, and log(R_Âᵀ B̂_i Zᵀ) of its orientation B̂_i, which is moved by B̂_i ← exp(ω_i) B̂_i.
What a calibrated sensor shows, y and Z, depends on its calibration, too.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypeAlias

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.filter.arrays import flip_verdicts
from slam_observer_ros.filter.robust import huber_loss
from slam_observer_ros.lie import so3
from slam_observer_ros.lie.axes import EstimatedAxes
from slam_observer_ros.lie.matrices import transpose
from slam_observer_ros.lie.sensor_mounting import (
    completed_lines,
    directions_of,
    LEAST_M,
    MEASURED,
    measured_axes,
    Sensed,
    sensitivity,
    shown_at,
    turning,
    UNMEASURED_M,
    without_bias,
)
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.smoothing.keyframes import Keyframes, Solution

# What C reads of the sensors of M points, see :meth:`SensedPoints.flat`.
FlatSensed: TypeAlias = tuple[IntArray, FloatArray, FloatArray, FloatArray, IntArray]

# The same where none is calibrated.
NO_SENSORS = None, None, None, np.empty((0, 8)), np.empty((0, 8), dtype=np.int64)


class SensedPoints:
    """M points; the last ``count`` entries c_s of the calibration belong to their sensors.

    ``stated`` (s, 8) has the values of s sensors, and ``columns`` (s, 8) where in the calibration
    (c,) those are that are estimated, −1 for others.
    """

    def __init__(self, sensed: Sensed, stated: FloatArray, columns: IntArray, c: int) -> None:
        self._sensed, self._of_sensors = sensed, (stated, columns)
        self._stated, self._columns = stated[sensed.sensors], columns[sensed.sensors]
        self._are_estimated = self._columns >= 0
        self._first = int(np.min(columns, where=columns >= 0, initial=c))
        self.count = c - self._first

    def shown(self, calibrations: FloatArray) -> FloatArray:
        """Return y (M, 3), metres, body frame, with one calibration for each point (M, c)."""
        return shown_at(self._values(calibrations), self._sensed)

    def sensitivity(self, calibrations: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return D (M, 3, c_s), for points that should be at ``predicted`` (M, 3), body frame."""
        values = self._values(calibrations)
        arms = predicted - self._sensed.origins - values[:, 3:6]
        return self._estimated(sensitivity(values, arms))

    def flat(self, calibration: FloatArray) -> FlatSensed:
        """Return sensors (M,), their origins and arms (M, 3), values and columns (s, 8)."""
        sensed, (stated, columns) = self._sensed, self._of_sensors
        estimated = np.append(calibration, 0.0)[columns]
        values = np.where(columns >= 0, estimated, stated)
        return sensed.sensors, sensed.origins, sensed.arms, values, columns

    def completed(
        self,
        half: IntArray,
        calibrations: FloatArray,
        predicted: FloatArray,
        kinds: IntArray,
        k: int,
    ) -> tuple[SensedPoints, FloatArray, FloatArray]:
        """Return the same with points ``half`` (h,) as predicted (h, 3) where not measured.

        And their lines of sight (h, 3) as shown and as expected, body frame.
        """
        values, sensed = self._values(calibrations)[half], self._sensed
        R, scales = so3.exp(values[:, :3]), np.exp(values[:, 6:7])
        lines = predicted - sensed.origins[half] - values[:, 3:6]
        lines[:, k:] = 0.0
        expected = (transpose(R) @ lines[:, :, None])[:, :, 0] / scales
        expected = without_bias(expected, -values[:, 7]) * expected
        arms = sensed.arms.copy()
        arms[half] = completed_lines(arms[half], expected, kinds)
        before = scales * (R @ sensed.arms[half, :, None])[:, :, 0]
        shown, c = replace(sensed, arms=arms), calibrations.shape[1]
        return SensedPoints(shown, *self._of_sensors, c), before, lines

    def turns(self, calibrations: FloatArray) -> FloatArray:
        """Return exp(ψ) (M, 3, 3), by which seen orientations are turned."""
        return so3.exp(self._values(calibrations)[:, :3])

    def turning(self, calibrations: FloatArray) -> FloatArray:
        """Return J(ψ) (M, 3, c_s): how orientations turn with the calibration."""
        return self._estimated(turning(self._values(calibrations)))

    def _values(self, calibrations: FloatArray) -> FloatArray:
        """Return ψ, d, s and b (M, 8) of each point's sensor."""
        if not self.count:
            return self._stated
        estimated = np.take_along_axis(calibrations, np.maximum(self._columns, 0), axis=1)
        return np.where(self._are_estimated, estimated, self._stated)

    def _estimated(self, D: FloatArray) -> FloatArray:
        """Return the columns (M, 3, c_s) of D (M, 3, 8) that are estimated, of its own sensor."""
        estimated = np.zeros((len(D), 3, self.count))
        rows, parts = np.nonzero(self._are_estimated)
        estimated[rows, :, self._columns[rows, parts] - self._first] = D[rows, :, parts]
        return estimated


class Observations:
    """M observations of landmarks; ``sensed`` are the points of calibrated sensors."""

    def __init__(
        self,
        axes: EstimatedAxes,
        keyframes: Keyframes,
        settings: Settings,
        sensed: SensedPoints | None = None,
    ) -> None:
        self._axes, self._keyframes, self._settings = axes, keyframes, settings
        self._sensed = sensed

    def normal_equations(
        self, solution: Solution, chained: int, gated: bool = True
    ) -> tuple[FloatArray, FloatArray]:
        """Return the equations (M, q, q) and their gradients (M, q), with Huber's weights.

        The q unknowns are the pose in the chain, whose last ``chained`` ones are a calibration,
        and the landmark: its position, then its turn if that is estimated. Without a chained
        calibration sensors follow. If ``gated``, points that a filter would reject weigh less.
        """
        keyframes, k = self._keyframes, self._axes.point
        R, predicted, error = self._of_points(solution)
        J_point = transpose(R)[:, :k, :k]
        C = self._axes.output_matrix(predicted)
        squared = _squared_distances(error, keyframes.information)
        counted = keyframes.shares * self._weights(squared, gated)
        information = keyframes.information * counted[:, None, None]
        D = np.empty((len(error), k, 0))
        if self._sensed is not None:
            D = self._sensed.sensitivity(self._calibrations(solution), predicted)[:, :k]
        unturned = np.zeros((len(error), k, self._axes.turn))
        J = _joined(-C, chained, np.concatenate([J_point, unturned], axis=2), -D)
        H, gradient = normal(J, information, error)
        # An orientation counts for as little as the point it was seen with.
        tags, counted = keyframes.turns.points, keyframes.shares * self._falloff(squared, gated)
        of_turns = self._of_turns(solution, R[tags], chained, counted[tags], gated)
        H[tags] += of_turns[0]
        gradient[tags] += of_turns[1]
        return H, gradient

    def completed(
        self, solution: Solution, half: IntArray
    ) -> tuple[Keyframes, SensedPoints | None]:
        """Return keyframes and sensors' points with half points as a solution has the rest."""
        keyframes, k, sensed = self._keyframes, self._axes.point, self._sensed
        predicted, kinds = self._of_points(solution)[1][half], keyframes.kinds[half]
        points = keyframes.points
        if sensed is None:
            origins = keyframes.origins[half]
            before, expected = points[half] - origins, predicted - origins
            expected[:, k:] = 0.0
            points = points.copy()
            points[half] = origins + completed_lines(before, expected, kinds)
        else:
            sensed, before, expected = sensed.completed(
                half, self._calibrations(solution), predicted, kinds, k
            )
        information = keyframes.information.copy()
        information[half] = _expected(before, expected, information[half], kinds)
        return replace(keyframes, points=points, information=information), sensed

    def cost(self, solution: Solution) -> float:
        """Return −2 ln of the likelihood of all points, as Huber has it, but for a constant."""
        squared = _squared_distances(self._of_points(solution)[2], self._keyframes.information)
        return float(self._keyframes.shares @ huber_loss(np.sqrt(squared)))

    def some_are_gated(self, solution: Solution) -> bool:
        """Return whether a filter would reject some of the points."""
        _, _, error = self._of_points(solution)
        squared = _squared_distances(error, self._keyframes.information)
        return bool(np.max(squared, initial=0.0) > self._settings.rejection_threshold**2)

    def _of_points(self, solution: Solution) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return rotations (M, 3, 3) of the poses, points as seen there (M, 3), errors (M, k)."""
        keyframes = self._keyframes
        poses = solution.poses[keyframes.keyframes + 1]
        R = poses[:, :3, :3]
        arms = solution.points[keyframes.landmarks] - poses[:, :3, 3]
        predicted = (transpose(R) @ arms[:, :, None])[:, :, 0]
        shown = keyframes.points
        if self._sensed is not None:
            shown = self._sensed.shown(self._calibrations(solution))
        return R, predicted, (predicted - shown)[:, : self._axes.point]

    def _calibrations(self, solution: Solution) -> FloatArray:
        """Return the calibration (M, c) with which each point was seen."""
        return solution.calibrations[self._keyframes.keyframes + 1]

    def _of_turns(
        self, solution: Solution, R: FloatArray, chained: int, counted: FloatArray, gated: bool
    ) -> tuple[FloatArray, FloatArray]:
        """Return what T orientations, if they are sure, say from poses turned by R (T, 3, 3)."""
        axes, q, turns = self._axes, self._axes.turn, self._keyframes.turns
        B = solution.orientations[self._keyframes.landmarks[turns.points]]
        predicted = transpose(R) @ B
        Z, flipped, D = turns.Z, turns.flipped, np.empty((len(B), q, 0))
        if self._sensed is not None:
            calibrations = self._calibrations(solution)
            turned = self._sensed.turns(calibrations)[turns.points]
            Z, flipped = turned @ Z, turned @ flipped
            D = self._sensed.turning(calibrations)[turns.points]
        error = so3.log(predicted @ transpose(Z))
        J_turn = axes.turn_covariances(so3.left_jacobian_inverse(error))
        if self._sensed is not None:
            D = (so3.left_jacobian_inverse(-error) @ D)[:, axes.turned]
        error = axes.turns(error)
        # Derivatives by pose, turn and calibration.
        by_pose = np.concatenate([-J_turn, np.zeros((len(error), q, axes.p - q))], axis=2)
        by_turn = np.zeros((len(error), q, axes.point + q))
        by_turn[:, :, axes.point :] = J_turn @ axes.turn_covariances(transpose(R))
        J = _joined(by_pose, chained, by_turn, -D)
        # Of the two that look alike it is the likelier one; then Huber's weights.
        twin = axes.turns(so3.log(predicted @ transpose(flipped)))
        apart = axes.turns(so3.log(Z @ transpose(flipped)))
        squared = _squared_distances(error, turns.information)
        evidence = _squared_distances(twin, turns.information) - squared
        distances = np.sqrt(_squared_distances(apart, turns.information))
        are_flipped, are_unclear = flip_verdicts(evidence, distances)
        used = B.any(axis=(1, 2)) & ~(are_flipped | are_unclear)
        counted = counted * used * self._weights(squared, gated)
        return normal(J, turns.information * counted[:, None, None], error)

    def _falloff(self, squared: FloatArray, gated: bool) -> FloatArray:
        """Return weights (M,) that are below 1 where a filter would reject, if ``gated``."""
        if not gated:
            return np.ones(len(squared))
        rejection = self._settings.rejection_threshold
        return np.minimum(1.0, rejection**2 / np.maximum(squared, rejection**2))

    def _weights(self, squared: FloatArray, gated: bool) -> FloatArray:
        """Return Huber's weights (M,), which fall off faster where a filter would reject."""
        huber, weights = self._settings.huber_threshold, self._falloff(squared, gated)
        if huber > 0.0:
            weights = weights * huber / np.sqrt(np.maximum(squared, huber**2))
        return weights


def _joined(
    by_pose: FloatArray, chained: int, by_landmark: FloatArray, by_sensors: FloatArray
) -> FloatArray:
    """Return J (M, k, q) by the unknowns of :meth:`Observations.normal_equations`."""
    M, k, sensors = by_sensors.shape
    if not chained:
        return np.concatenate([by_pose, by_landmark, by_sensors], axis=2)
    unseen = np.zeros((M, k, chained - sensors))
    return np.concatenate([by_pose, unseen, by_sensors, by_landmark], axis=2)


def _expected(
    shown: FloatArray, expected: FloatArray, information: FloatArray, kinds: IntArray
) -> FloatArray:
    """Return the information (h, k, k) of half points about expected lines of sight (h, 3).

    It is as much as it was about shown ones; angles stay as well known as they were.
    """
    k = information.shape[1]
    flat = np.arange(3) < k
    shown, expected = shown * flat, expected * flat
    old, new = (directions_of(each)[:, :, :k] for each in (shown, expected))
    lengths = [np.maximum(np.linalg.norm(each, axis=1), LEAST_M) for each in (shown, expected)]
    known = np.einsum('mij,mjk,mik->mi', old, information, old) * MEASURED[kinds]
    known *= (np.trace(information, axis1=1, axis2=2) / known.sum(axis=1))[:, None]
    known[:, 1:] *= ((lengths[0] / lengths[1]) ** 2)[:, None]
    along = np.where(MEASURED[kinds], known, known.max(axis=1, keepdims=True))
    known = np.where(measured_axes(shown, expected, kinds), along, UNMEASURED_M**-2)
    return transpose(new) @ (known[:, :, None] * new)


def normal(J: FloatArray, W: FloatArray, error: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return Jᵀ W J (M, q, q) and Jᵀ W e (M, q) for J (M, k, q), W (M, k, k) and e (M, k)."""
    JW = transpose(J) @ W
    return JW @ J, (JW @ error[:, :, None])[:, :, 0]


def _squared_distances(error: FloatArray, information: FloatArray) -> FloatArray:
    """Return the squared Mahalanobis distances (M,) of errors (M, k)."""
    return (error[:, None, :] @ information @ error[:, :, None])[:, 0, 0]
