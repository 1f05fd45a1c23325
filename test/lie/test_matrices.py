"""Small linear systems: the same as numpy solves, and with the same complaint."""

import numpy as np
import pytest

from slam_observer_ros.lie.matrices import (
    cholesky,
    definite,
    kalman_update,
    mahalanobis,
    solve,
    solve_definite,
    solve_symmetric,
)


@pytest.mark.parametrize('shape', [(5,), (5, 3), (5, 0), (0,), (0, 3)])
def test_it_solves_what_numpy_solves(shape):
    rng = np.random.default_rng(0)
    S, right = rng.normal(size=(shape[0], shape[0])), rng.normal(size=shape)
    np.testing.assert_allclose(solve(S, right), np.linalg.solve(S, right), atol=1e-12)


def test_a_singular_system_is_refused():
    with pytest.raises(np.linalg.LinAlgError):
        solve(np.ones((2, 2)), np.ones(2))


@pytest.mark.parametrize('scale', [1e-20, 1e-8, 1.0, 1e12, 1e100])
@pytest.mark.parametrize('rank', [0, 1, 3])
def test_what_rounding_has_made_indefinite_is_solved_all_the_same(scale, rank):
    """By a matrix that differs by no more than rounding of its largest entries does."""
    rng = np.random.default_rng(rank)
    roots = rng.normal(size=(5, 4, rank)) * np.sqrt(scale)
    S = roots @ roots.swapaxes(1, 2)
    S[:, 3, 3] -= 1e-15 * scale
    made = definite(S)
    np.testing.assert_allclose(made, S, rtol=0, atol=1e-12 * scale + 1e-290)
    for one in S:
        L = cholesky(one)
        np.testing.assert_allclose(L @ L.T, one, rtol=0, atol=1e-12 * scale + 1e-290)
        assert np.isfinite(solve_definite(one, np.ones(4))).all()
        assert np.isfinite(solve_symmetric(one, np.ones(4))).all()
    assert np.isfinite(mahalanobis(np.ones((5, 4)), S)).all()
    assert np.isfinite(kalman_update(np.eye(4), np.eye(4), np.ones((4, 4)))).all()
