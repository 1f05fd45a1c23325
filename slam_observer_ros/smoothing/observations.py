"""What observed points, and how their tags are turned, say of poses and landmarks.

Errors are along the axes of the pose from which a landmark was seen: R_Âᵀ (p_i − x_Â) − y of its
position, and log(R_Âᵀ B̂_i Zᵀ) of its orientation B̂_i, which is moved by B̂_i ← exp(ω_i) B̂_i.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry import so3
from slam_observer_ros.geometry.axes import EstimatedAxes
from slam_observer_ros.geometry.matrices import transpose
from slam_observer_ros.observer.orientations import flip_verdicts
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.smoothing.keyframes import Keyframes, SeenTurns, Solution


class Observations:
    """M observations of landmarks; ``huber_threshold`` and ``rejection_threshold`` weigh them."""

    def __init__(self, axes: EstimatedAxes, keyframes: Keyframes, settings: Settings) -> None:
        self._axes, self._keyframes, self._settings = axes, keyframes, settings

    def normal_equations(
        self, solution: Solution, chained: int, gated: bool = True
    ) -> tuple[FloatArray, FloatArray]:
        """Return the equations (M, q, q) and their gradients (M, q), with Huber's weights.

        q unknowns are those of the chain's pose, the last ``chained`` of which no observation
        depends on, and of the landmark: its position, then its turn if that is estimated. If
        ``gated``, what a filter would reject at the solution has less weight.
        """
        keyframes, k = self._keyframes, self._axes.point
        R, predicted, error = self._of_points(solution)
        J_point = transpose(R)[:, :k, :k]
        C, unseen = self._axes.output_matrix(predicted), np.zeros((len(error), k, chained))
        squared = _squared_distances(error, keyframes.information)
        counted = keyframes.shares * self._weights(squared, gated)
        information = keyframes.information * counted[:, None, None]
        if keyframes.turns is None:
            return normal(np.concatenate([-C, unseen, J_point], axis=2), information, error)
        unturned = np.zeros((len(error), k, self._axes.turn))
        J = np.concatenate([-C, unseen, J_point, unturned], axis=2)
        H, gradient = normal(J, information, error)
        # An orientation counts for as little as the point it was seen with.
        counted = keyframes.shares * self._falloff(squared, gated)
        seen = self._of_turns(keyframes.turns, R, solution, chained, counted, gated)
        H_turn, gradient_turn = seen
        return H + H_turn, gradient + gradient_turn

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
        return R, predicted, (predicted - keyframes.points)[:, : self._axes.point]

    def _of_turns(
        self,
        turns: SeenTurns,
        R: FloatArray,
        solution: Solution,
        chained: int,
        counted: FloatArray,
        gated: bool,
    ) -> tuple[FloatArray, FloatArray]:
        """Return what orientations say, seen from poses turned by ``R`` (M, 3, 3).

        Nothing, where none is known or the flipped twin is as likely.
        """
        axes, q = self._axes, self._axes.turn
        if solution.orientations is None:
            raise TypeError('orientations were seen that are not estimated')
        B = solution.orientations[self._keyframes.landmarks]
        predicted = transpose(R) @ B
        error = so3.log(predicted @ transpose(turns.Z))
        J_turn = axes.turn_covariances(so3.left_jacobian_inverse(error))
        error = axes.turns(error)
        # Derivatives by pose and turn.
        J = np.zeros((len(error), q, axes.p + chained + axes.point + q))
        J[:, :, :q] = -J_turn
        J[:, :, -q:] = J_turn @ axes.turn_covariances(transpose(R))
        # Of the two that look alike it is the likelier one; then Huber's weights.
        twin = axes.turns(so3.log(predicted @ transpose(turns.flipped)))
        apart = axes.turns(so3.log(turns.Z @ transpose(turns.flipped)))
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


def normal(J: FloatArray, W: FloatArray, error: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return Jᵀ W J (M, q, q) and Jᵀ W e (M, q) for J (M, k, q), W (M, k, k) and e (M, k)."""
    JW = transpose(J) @ W
    return JW @ J, (JW @ error[:, :, None])[:, :, 0]


def _squared_distances(error: FloatArray, information: FloatArray) -> FloatArray:
    """Return the squared Mahalanobis distances (M,) of errors (M, k)."""
    squared: FloatArray = (error[:, None, :] @ information @ error[:, :, None])[:, 0, 0]
    return squared
