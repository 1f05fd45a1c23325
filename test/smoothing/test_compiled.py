"""What is compiled of Gauss-Newton does to rounding what numpy does, and refuses the rest."""

from copy import deepcopy

import newton_arguments
import numpy as np
import pytest
from rounding import off_by
import sanitized

from slam_observer_ros.smoothing import bordered_chain, gauss_newton
from slam_observer_ros.smoothing.bordered_chain import SMALL_BORDER

ROUNDING = 1e-12


@pytest.fixture(name='compiled')
def fixture_compiled():
    if bordered_chain.COMPILED is None:
        pytest.skip('it was not compiled, or is not to be used')
    return bordered_chain.COMPILED


def assert_same(one, other, tolerance, what):
    for name, a, b in zip(type(one)._fields, one, other, strict=True):
        off = off_by(a, b, 1e-6)
        assert off <= tolerance, f'{what}: {name} is off by {off:.1e}'


@pytest.mark.parametrize('seed', range(60))
def test_equations_are_those_of_the_reference(compiled, seed, monkeypatch):
    rng = np.random.default_rng(seed)
    smoother, start = newton_arguments.random_smoother(rng)
    gated = bool(rng.integers(2))
    by_compiled = smoother._linearised_by(compiled, start, gated)
    monkeypatch.setattr(gauss_newton, 'COMPILED', None)
    assert_same(by_compiled, smoother._linearise(start, gated), ROUNDING, seed)


@pytest.mark.parametrize('S', [1, 8, 9, 10, 41])
@pytest.mark.parametrize('landmarks', [5, SMALL_BORDER])
def test_what_is_left_of_the_chain_is_that_of_the_reference(compiled, S, landmarks):
    equations, _, _ = newton_arguments.random_equations(S, landmarks)
    reference = bordered_chain._InNumpy(equations)
    chain = bordered_chain._Compiled(compiled, equations)
    border = np.random.default_rng(S).standard_normal(len(chain.corner))
    for one, other in (
        (chain.corner, reference.corner),
        (chain.border_gradient, reference.border_gradient),
        (chain.last_root, reference.last_root),
        (chain.last_rows, reference.last_rows),
        (chain.fill_in(border), reference.fill_in(border)),
    ):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=ROUNDING * np.abs(other).max())


def test_an_open_pose_is_an_error(compiled):
    equations, _, _ = newton_arguments.random_equations(41, SMALL_BORDER)
    for pose in (3, 16):  # of a stretch, and of the chain
        is_open = equations._replace(diagonal=equations.diagonal.copy())
        is_open.diagonal[pose] = 0.0
        with pytest.raises(np.linalg.LinAlgError):
            bordered_chain._Compiled(compiled, is_open)


def test_wrong_arguments_are_refused_and_do_not_crash(compiled):
    assert newton_arguments.fuzz(compiled, 0, 100) >= 100


@pytest.mark.parametrize('seed', range(40))
def test_equations_of_any_size_are_solved_as_the_reference_does(compiled, seed, monkeypatch):
    """Of any calibration that drifts or is shared, of one pose and of five hundred."""
    equations = newton_arguments.any_equations(np.random.default_rng(seed))
    solved = bordered_chain.ChainFactors(deepcopy(equations)).solve()
    monkeypatch.setattr(bordered_chain, 'COMPILED', None)
    reference = bordered_chain.ChainFactors(equations).solve()
    for one, other in zip(solved, reference, strict=True):
        scale = np.abs(other).max(initial=1e-3)
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-10 * scale)


def test_sanitizers_find_nothing_in_all_that_is_compiled(tmp_path):
    """Built to look for reads and writes out of bounds, and for undefined behaviour."""
    if sanitized.why_not():
        pytest.skip(sanitized.why_not())
    of_core, of_newton = sanitized.fuzz(tmp_path, 50)
    assert of_core >= 20
    assert of_newton >= 50
