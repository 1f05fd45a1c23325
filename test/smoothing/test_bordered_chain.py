"""The normal equations of a chain of poses and what they share, against dense algebra."""

import numpy as np
import pytest

from slam_observer_ros.smoothing.bordered_chain import Equations, Factors, SMALL_BORDER

D, C, K = 3, 2, 2
SEEN = 4


def random_equations(S, landmarks):
    """Return equations and their dense matrix and gradient, poses first."""
    rng, b = np.random.default_rng(S), C + K * landmarks
    poses = np.repeat(np.arange(S), SEEN)
    seen_landmarks = (poses + rng.integers(0, landmarks, len(poses))) % landmarks
    A = np.zeros((0, S * D + b))

    def measure(rows, *columns):
        nonlocal A
        J = np.zeros((rows, A.shape[1]))
        places = np.concatenate(columns)
        J[:, places] = rng.normal(size=(rows, len(places)))
        A = np.concatenate([A, J])

    border = S * D + np.arange(b)
    measure(D + b, np.arange(D), border)
    for s in range(S - 1):
        measure(D, np.arange(s * D, (s + 2) * D), border[:C])
    for s, i in zip(poses, seen_landmarks, strict=True):
        measure(K, np.arange(s * D, (s + 1) * D), border[C + K * i :][:K])
    H, g = A.T @ A, A.T @ rng.normal(size=len(A))
    blocks = H[: S * D, : S * D].reshape(S, D, S, D)
    B = H[: S * D, S * D :].reshape(S, D, b)
    first = B[0].copy()
    first[:, :C] = 0.0
    seen = np.array(
        [B[s][:, C + K * i :][:, :K] for s, i in zip(poses, seen_landmarks, strict=True)]
    )
    # One block holds all that a pose has to do with a landmark, however often it was seen.
    _, once = np.unique(poses * landmarks + seen_landmarks, return_index=True)
    once = once[poses[once] > 0]
    every = np.arange(S)
    return (
        Equations(
            diagonal=blocks[every, :, every],
            above=blocks[every[:-1], :, every[1:]],
            shared=B[:, :, :C].copy(),
            poses=poses[once],
            landmarks=seen_landmarks[once],
            seen=seen[once],
            first=first,
            corner=H[S * D :, S * D :],
            gradient=g[: S * D].reshape(S, D),
            border_gradient=g[S * D :],
        ),
        H,
        g,
    )


chains = pytest.mark.parametrize('S', [1, 2, 8, 9, 10, 41])
borders = pytest.mark.parametrize('landmarks', [5, SMALL_BORDER])


@chains
@borders
def test_the_solution_is_that_of_dense_algebra(S, landmarks):
    equations, H, g = random_equations(S, landmarks)
    poses, border = Factors(equations).solve()
    expected = -np.linalg.solve(H, g)
    np.testing.assert_allclose(poses.ravel(), expected[: S * D], atol=1e-8)
    np.testing.assert_allclose(border, expected[S * D :], atol=1e-8)


@chains
@borders
def test_the_marginal_is_that_of_the_dense_inverse(S, landmarks):
    equations, H, _ = random_equations(S, landmarks)
    expected = np.linalg.inv(H)[(S - 1) * D :, (S - 1) * D :]
    np.testing.assert_allclose(Factors(equations).marginal(), expected, rtol=1e-6, atol=1e-9)
