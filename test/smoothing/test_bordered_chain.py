"""The normal equations of a chain of poses and what they share, against dense algebra."""

from newton_arguments import D, random_equations
import numpy as np
import pytest

from slam_observer_ros.smoothing import bordered_chain
from slam_observer_ros.smoothing.bordered_chain import ChainFactors, SMALL_BORDER


@pytest.fixture(autouse=True, params=['C', 'numpy'])
def fixture_implementation(request, monkeypatch):
    if request.param == 'numpy':
        monkeypatch.setattr(bordered_chain, 'COMPILED', None)
    elif bordered_chain.COMPILED is None:
        pytest.skip('it was not compiled, or is not to be used')


chains = pytest.mark.parametrize('S', [1, 2, 8, 9, 10, 41])
borders = pytest.mark.parametrize('landmarks', [5, SMALL_BORDER])


@chains
@borders
def test_the_solution_is_that_of_dense_algebra(S, landmarks):
    equations, H, g = random_equations(S, landmarks)
    poses, border = ChainFactors(equations).solve()
    expected = -np.linalg.solve(H, g)
    np.testing.assert_allclose(poses.ravel(), expected[: S * D], atol=1e-8)
    np.testing.assert_allclose(border, expected[S * D :], atol=1e-8)


@chains
@borders
def test_the_marginal_is_that_of_the_dense_inverse(S, landmarks):
    equations, H, _ = random_equations(S, landmarks)
    expected = np.linalg.inv(H)[(S - 1) * D :, (S - 1) * D :]
    np.testing.assert_allclose(ChainFactors(equations).marginal(), expected, rtol=1e-6, atol=1e-9)


@chains
@borders
def test_the_determinant_is_that_of_the_dense_matrix(S, landmarks):
    equations, H, _ = random_equations(S, landmarks)
    np.testing.assert_allclose(ChainFactors(equations).log_det(), np.linalg.slogdet(H)[1])
