"""Small linear systems: the same as numpy solves, and with the same complaint."""

import numpy as np
import pytest

from slam_observer_ros.geometry.matrices import solve


@pytest.mark.parametrize('shape', [(5,), (5, 3), (5, 0), (0,), (0, 3)])
def test_it_solves_what_numpy_solves(shape):
    rng = np.random.default_rng(0)
    S, right = rng.normal(size=(shape[0], shape[0])), rng.normal(size=shape)
    np.testing.assert_allclose(solve(S, right), np.linalg.solve(S, right), atol=1e-12)


def test_a_singular_system_is_refused():
    with pytest.raises(np.linalg.LinAlgError):
        solve(np.ones((2, 2)), np.ones(2))
