"""Riccati gains of landmarks that may have orientations, as tags do.

The orientations seen correct it by φ_i of R_Â Z_i B̂_iᵀ = exp(φ_i): in the coordinates of
:mod:`.chart` that is H x with a constant H, too. Points correct it afterwards, as ever. Both
noises are taken to be independent, so to first order that is the same as both at once. Covariances
(m, 3, 3) of rotation vectors are in rad².
"""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.filter.arrays import flip_verdicts, SeenOrientations
from slam_observer_ros.filter.gains import Errors, Gains, TagGains
from slam_observer_ros.filter.joint_covariance import JointCovariance
from slam_observer_ros.filter.known_landmarks import KnownLandmarks
from slam_observer_ros.filter.observer import Residuals
from slam_observer_ros.filter.robust import accepted, distances, gated_weights
from slam_observer_ros.lie import so3
from slam_observer_ros.lie.matrices import mahalanobis, transpose, with_blocks
from slam_observer_ros.models.observation_noise import RESOLUTION_RAD


class OrientationGains(Errors, Gains):
    """What gains with a joint covariance do with orientations, where these are estimated."""

    joint: JointCovariance  # in the form that suits the map

    @property
    def errors(self) -> Errors:
        """Itself."""
        return self

    @property
    def takes_all(self) -> bool:
        """Whether all landmarks are in P."""
        return self.joint.is_dense

    def landmark_covariance(self, rows: IntArray, tags: IntArray) -> FloatArray | None:
        """Return that (m k + t q) of ã_i of ``rows`` (m,) and ω_i of ``tags`` (t,); or None."""
        return self.joint.of_landmarks(rows, self.observer.points[rows], tags)

    @property
    def tags(self) -> TagGains | None:
        """Itself, where orientations are estimated."""
        return self if self.joint.chart.turn else None

    @abstractmethod
    def _move(self, x: FloatArray) -> None:
        """Move the state by exp(x)."""

    def learn_motion_noise(self, residuals: Residuals) -> None:
        """Let residuals show how noisy the motion was, before something else corrects it."""
        if len(residuals.rows):
            r, S = residuals.on(self.axes)[0], self.innovation_covariance(residuals)
            # C as the prediction has it: in the middle of where landmarks are expected and seen.
            C = self.joint.chart.moved(residuals.e - 0.5 * residuals.r + residuals.a)
            self.motion_noise.factors.learn(r, S, C)

    def correct_by_orientations(self, seen: SeenOrientations) -> tuple[FloatArray, BoolArray]:
        """Correct the state by known orientations that were seen.

        Return the weight (m,) of each, and which are left out: those whose flipped twins are
        likely, too.
        """
        phi, R, predicted, kept, are_unclear = self._judged_turns(seen)
        # A gate; then Huber's weights.
        entries = np.flatnonzero(np.repeat(kept, phi.shape[1]))
        weights = np.zeros(len(phi))
        weights[kept] = gated_weights(
            phi[kept], predicted[np.ix_(entries, entries)], R[kept], self._tuning
        )
        # K = P Hᵀ S⁻¹, X̂ ← exp(−K φ) · X̂
        used = weights > 0.0
        if used.any():
            HP, HPH = self.joint.project_turns(seen.rows[used], seen.D)
            S = with_blocks(HPH, R[used] * (seen.repeated[used] / weights[used])[:, None, None])
            self._move(-self.joint.update(HP, S, phi[used].ravel()))
        return weights, are_unclear

    def clear_turns(self, seen: SeenOrientations) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return φ_i (m, q), their noise (m, q, q), and which (m,) are not of flipped twins."""
        phi, R, _, kept, _ = self._judged_turns(seen)
        return phi, R, kept

    def _judged_turns(
        self, seen: SeenOrientations
    ) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray, BoolArray]:
        """Return φ_i (m, q), their noise, what P predicts, which are clear, and which unclear."""
        phi, R = self._turns(seen.rows, seen.Z), self._noise(seen.covariances)
        _, predicted = self.joint.project_turns(seen.rows, seen.D)
        # Which of the two that look alike it is.
        are_flipped, are_unclear = self._judge_flips(seen, phi, predicted, R)
        return phi, R, predicted, ~(are_flipped | are_unclear), are_unclear

    def add_orientations(self, seen: SeenOrientations) -> None:
        """Take over orientations as they are seen, where none is known."""
        self.observer.orientations.put(seen.rows, self.observer.A[:3, :3] @ seen.Z)
        self.joint.add_turns(seen.rows, self._noise(seen.covariances), seen.D)

    def know_orientations(self, rows: IntArray, B: FloatArray, sigmas: FloatArray) -> None:
        """Take in orientations of a map, whose errors are independent of all else."""
        own = self.observer.orientations.are_known[rows] & (not self.observer.is_exact)
        new, seen = ~own, self._tuning.max_rejections
        self.observer.orientations.put_known(rows[new], B[new], sigmas[new], seen)
        if self.observer.is_exact:
            return
        variances = np.maximum(sigmas, RESOLUTION_RAD)[:, None, None] ** 2
        R = variances * np.eye(self.axes.turn)
        self.joint.add_known_turns(rows[new], R[new])
        # Of tags that both have, B̂_i B_iᵀ = exp(ω_i), unless they contradict each other.
        known, R = rows[own], R[own]
        omega = self.axes.turns(so3.log(self.observer.orientations.B[known] @ transpose(B[own])))
        near = mahalanobis(omega, self.joint.own_turns(known) + R)
        agree = accepted(near, self._tuning.rejection_threshold)
        if agree.any():
            self.joint.activate(known[agree])
            HP, HPH = self.joint.project_own_turns(known[agree])
            S = with_blocks(HPH, R[agree])
            self._move(-self.joint.update(HP, S, omega[agree].ravel()))

    def _turns(self, rows: IntArray, Z: FloatArray) -> FloatArray:
        """Return φ_i (m, q), rad, of orientations ``Z`` (m, 3, 3) seen, body frame."""
        R_hat = self.observer.A[:3, :3]
        return self.axes.turns(so3.log(R_hat @ Z @ transpose(self.observer.orientations.B[rows])))

    def _noise(self, covariances: FloatArray) -> FloatArray:
        """Return covariances of the body frame (m, q, q) along the reference frame's axes."""
        return self.axes.turn_covariances(self.observer.turned(covariances))

    def _judge_flips(
        self, seen: SeenOrientations, phi: FloatArray, predicted: FloatArray, R: FloatArray
    ) -> tuple[BoolArray, BoolArray]:
        """Return which orientations (m,) are flipped, and which may be."""
        twins = self._turns(seen.rows, seen.flipped)
        evidence = distances(twins, predicted, R) ** 2 - distances(phi, predicted, R) ** 2
        R_hat = self.observer.A[:3, :3]
        apart = self.axes.turns(so3.log(R_hat @ seen.Z @ transpose(R_hat @ seen.flipped)))
        return flip_verdicts(evidence, distances(apart, np.zeros_like(predicted), R))

    def take_orientations(self, rows: IntArray, known: KnownLandmarks) -> None:
        """Take in orientations of landmarks ``rows`` (m,) that a map knows."""
        tags, R, sigmas = known.tags, known.orientations, known.sigmas
        if R is None or sigmas is None or self.tags is None:
            return
        if known.joint is None:
            self.know_orientations(rows[tags], R[tags], sigmas[tags])
        else:  # their errors have been taken in together with the positions' errors
            seen = self._tuning.max_rejections
            self.observer.orientations.put_known(rows[tags], R[tags], sigmas[tags], seen)

    def _merge_orientations(self, rows: IntArray, copies: IntArray) -> None:
        tags = self.observer.orientations
        in_map, own = tags.are_known[copies], tags.are_known[rows]
        if not in_map.any():
            return
        # Orientations that only the map knows, …
        new, of_new = rows[in_map & ~own], copies[in_map & ~own]
        self.joint.copy_turns(of_new, new)
        seen = self._tuning.max_rejections
        tags.put_known(new, tags.B[of_new], tags.map_sigmas[of_new], seen)
        # … and what both have, B̂_i B̂_jᵀ = exp(ω_i − ω_j), unless they contradict each other.
        rows, copies = rows[in_map & own], copies[in_map & own]
        omega = self.axes.turns(so3.log(tags.B[rows] @ transpose(tags.B[copies])))
        R = RESOLUTION_RAD**2 * np.tile(np.eye(self.axes.turn), (len(rows), 1, 1))
        near = distances(omega, self.joint.project_turn_differences(rows, copies)[1], R)
        agree = accepted(near, self._tuning.rejection_threshold)
        if agree.any():
            HP, HPH = self.joint.project_turn_differences(rows[agree], copies[agree])
            S = with_blocks(HPH, R[agree])
            self._move(-self.joint.update(HP, S, omega[agree].ravel()))
