"""The Riccati filter is the right-invariant extended Kalman filter on SE_{n+1}(3)."""

from __future__ import annotations

from hypothesis import given
import numpy as np
from random_runs import as_stated, covariance_of_all, observe, PLAIN, propagate, random_covariances
from scipy.linalg import block_diag, expm
from strategies import generators

from slam_observer_ros.estimator.placement import make_gains
from slam_observer_ros.lie.so3 import hat


class RightInvariantEkf:
    """χ = [R x p_1 … p_n; 0 I] with the error χ̂ χ⁻¹ = exp(ε_Ω, ε_v, ξ_1 … ξ_n).

    Nothing of the package is in it but the hat of a vector.
    """

    def __init__(self):
        self.chi, self.P = np.eye(4), np.zeros((6, 6))

    @property
    def points(self):
        return self.chi[:3, 4:].T

    def move(self, twists, covariances):
        """Move by exp(twist) one after another, each with noise of the body's twist."""
        for twist, Q in zip(twists, covariances, strict=True):
            before = self._noise_input()
            step = np.zeros((4, 4))
            step[:3, :3], step[:3, 3] = hat(twist[:3]), twist[3:]
            self.chi[:4, :4] = self.chi[:4, :4] @ expm(step)
            after = self._noise_input()
            self.P += 0.5 * (before @ Q @ before.T + after @ Q @ after.T)

    def _noise_input(self):
        R, x, zero = self.chi[:3, :3], self.chi[:3, 3], np.zeros((3, 3))
        of_points = [[hat(p) @ R, zero] for p in self.points]
        return np.block([[R, zero], [hat(x) @ R, R], *of_points])

    def correct(self, rows, y, covariances):
        R, x = self.chi[:3, :3], self.chi[:3, 3]
        H = np.zeros((len(rows), 3, len(self.P)))
        H[:, :, 3:6] = np.eye(3)
        for block, row in zip(H, rows, strict=True):
            block[:, 6 + 3 * row : 9 + 3 * row] = -np.eye(3)
        H, r = H.reshape(-1, len(self.P)), (y @ R.T + x - self.points[rows]).ravel()
        N = block_diag(*(R @ covariances @ R.T))
        K = self.P @ H.T @ np.linalg.inv(H @ self.P @ H.T + N)
        I_KH = np.eye(len(self.P)) - K @ H
        self.P = I_KH @ self.P @ I_KH.T + K @ N @ K.T
        x = -K @ r
        algebra = np.zeros_like(self.chi)
        algebra[:3, :3], algebra[:3, 3:] = hat(x[:3]), x[3:].reshape(-1, 3).T
        self.chi = expm(algebra) @ self.chi

    def add(self, y, covariances):
        n, m = len(self.points), len(y)
        self.chi, self.P = block_diag(self.chi, np.eye(m)), block_diag(self.P, np.eye(3 * m))
        self.relocate(np.arange(n, n + m), y, covariances)

    def relocate(self, rows, y, covariances):
        """Put landmarks where they are seen: ξ_i = ε_v and the noise of the point."""
        R = self.chi[:3, :3]
        self.chi[:3, 4 + rows] = (y @ R.T).T + self.chi[:3, 3:4]
        for row, covariance in zip(rows, covariances, strict=True):
            own, J = slice(6 + 3 * row, 9 + 3 * row), np.eye(len(self.P))
            J[own], J[own, 3:6] = 0.0, np.eye(3)
            self.P = J @ self.P @ J.T
            self.P[own, own] += R @ covariance @ R.T


def assert_same(riccati, ekf):
    np.testing.assert_allclose(riccati.observer.A, ekf.chi[:4, :4], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(riccati.observer.points, ekf.points, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(riccati.joint.P, ekf.P, rtol=0.0, atol=1e-9)
    to_positions = np.eye(len(ekf.P))  # ã_i = ξ_i − [p̂_i]× ε_Ω
    to_positions[6:, :3] = -hat(ekf.points).reshape(-1, 3)
    expected = to_positions @ ekf.P @ to_positions.T
    np.testing.assert_allclose(covariance_of_all(riccati), expected, rtol=0.0, atol=1e-9)


@given(generators())
def test_riccati_filter_is_the_right_invariant_ekf(rng):
    """Over random motions, observations, new landmarks and ones that are placed again."""
    riccati, ekf = make_gains(PLAIN, np.eye(4)), RightInvariantEkf()
    for number in range(30):
        V, dt_s = rng.normal(size=(2, 6)), rng.integers(50, 200, 2) / 1000.0
        Q = 1e-3 * random_covariances(rng, 2, 6)
        propagate(riccati, V, dt_s, Q)
        ekf.move(V * dt_s[:, None], Q)
        if number % 5 == 0:
            y, R = rng.normal(scale=4.0, size=(2, 3)), 1e-2 * random_covariances(rng, 2, 3)
            riccati.add(y, R)
            ekf.add(y, R)
        n = len(riccati.observer.points)
        rows = np.sort(rng.permutation(n)[: rng.integers(1, n + 1)])
        R = 1e-2 * random_covariances(rng, len(rows), 3)
        y = riccati.observer.body_points(rows) + 0.1 * rng.normal(size=(len(rows), 3))
        observe(riccati, rows, y, R)
        ekf.correct(rows, y, as_stated(y, R))
        if number % 7 == 6:
            moved, y = rng.integers(0, n, 1), rng.normal(scale=4.0, size=(1, 3))
            riccati.relocate(moved, y, R[:1])
            ekf.relocate(moved, y, R[:1])
        assert_same(riccati, ekf)
