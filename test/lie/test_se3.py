"""SE(3): exp, log, adjoint, Jacobians and the projection (10), at every scale and in batches."""

from __future__ import annotations

from collections.abc import Callable

from hypothesis import given
import numpy as np
import pytest
from scipy.linalg import expm
from strategies import (
    DELICATE_ANGLES,
    directions,
    generators,
    points,
    poses,
    twists,
    unit_vectors,
)

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.lie import se3, so3

ROUNDING = 1e-13


def little_adjoint(xi: FloatArray) -> FloatArray:
    """Matrix of the Lie bracket [ξ, ·] on twists (Ω, v)."""
    phi, v = so3.hat(xi[:3]), so3.hat(xi[3:])
    return np.block([[phi, np.zeros((3, 3))], [v, phi]])


def left_jacobian_by_its_series(xi: FloatArray) -> FloatArray:
    """Sum of adᵏ / (k + 1)!."""
    term = total = np.eye(6)
    for k in range(1, 40):
        term = term @ little_adjoint(xi) / (k + 1)
        total = total + term
    return total


@given(xi=twists())
def test_hat_is_the_velocity_matrix_9_and_vee_undoes_it(xi: FloatArray) -> None:
    V = se3.hat(xi)
    np.testing.assert_array_equal(V[:3, :3], so3.hat(xi[:3]))
    np.testing.assert_array_equal(V[:3, 3], xi[3:])
    np.testing.assert_array_equal(V[3], np.zeros(4))
    np.testing.assert_array_equal(se3.vee(V), xi)


@given(T=poses(), p=points(4))
def test_transform_and_rotate_are_homogeneous_products(T: FloatArray, p: FloatArray) -> None:
    homogeneous_points = np.column_stack([p, np.ones(4)])
    homogeneous_directions = np.column_stack([p, np.zeros(4)])
    expected_points = (homogeneous_points @ T.T)[:, :3]
    expected_directions = (homogeneous_directions @ T.T)[:, :3]
    np.testing.assert_allclose(se3.transform(T, p), expected_points, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(se3.rotate(T, p), expected_directions, rtol=0, atol=ROUNDING)


@given(xi=twists())
def test_exp_is_the_matrix_exponential(xi: FloatArray) -> None:
    np.testing.assert_allclose(se3.exp(xi), expm(se3.hat(xi)), rtol=0, atol=ROUNDING)


@pytest.mark.parametrize('angle', [1e-160, 1e-12, 1e-10, 1e-8])
@given(axis=unit_vectors(), v=directions())
def test_exp_of_tiny_twists_keeps_the_rotation_vector_to_its_last_bits(
    angle: float, axis: FloatArray, v: FloatArray
) -> None:
    phi = angle * axis
    T = se3.exp(np.concatenate([phi, v]))
    skew_part = 0.5 * (T[:3, :3] - T[:3, :3].T)
    np.testing.assert_allclose(so3.vee(skew_part), phi, rtol=0, atol=1e-12 * angle)
    second_order = v + 0.5 * np.cross(phi, v)
    np.testing.assert_allclose(T[:3, 3], second_order, rtol=0, atol=1e-14)


@given(xi=twists())
def test_log_undoes_exp(xi: FloatArray) -> None:
    found = se3.log(se3.exp(xi))
    np.testing.assert_allclose(found, xi, rtol=0, atol=ROUNDING)
    assert np.linalg.norm(found[:3] - xi[:3]) <= 1e-14 * np.linalg.norm(xi[:3])


@given(T=poses())
def test_exp_undoes_log(T: FloatArray) -> None:
    np.testing.assert_allclose(se3.exp(se3.log(T)), T, rtol=0, atol=ROUNDING)


@given(T=poses(), xi=twists())
def test_adjoint_is_conjugation(T: FloatArray, xi: FloatArray) -> None:
    conjugated = T @ se3.hat(xi) @ se3.inverse(T)
    np.testing.assert_allclose(se3.hat(se3.adjoint(T) @ xi), conjugated, rtol=0, atol=1e-12)


@given(S=poses(), T=poses())
def test_adjoint_is_a_homomorphism(S: FloatArray, T: FloatArray) -> None:
    product = se3.adjoint(S) @ se3.adjoint(T)
    np.testing.assert_allclose(se3.adjoint(S @ T), product, rtol=0, atol=1e-12)


@given(xi=twists())
def test_adjoint_of_exp_is_the_exponential_of_the_bracket(xi: FloatArray) -> None:
    expected = expm(little_adjoint(xi))
    np.testing.assert_allclose(se3.adjoint(se3.exp(xi)), expected, rtol=0, atol=1e-12)


@given(xi=twists(), random=generators())
def test_project_is_the_orthogonal_projection_onto_se3_10(
    xi: FloatArray, random: np.random.Generator
) -> None:
    V, M = se3.hat(xi), random.normal(size=(4, 4))
    projected = se3.project(M)
    assert np.sum(V * M) == pytest.approx(np.sum(V * projected), abs=1e-12)
    np.testing.assert_array_equal(se3.hat(se3.vee(projected)), projected)
    np.testing.assert_array_equal(se3.project(V), V)


@pytest.mark.parametrize('angle', DELICATE_ANGLES)
@given(axis=unit_vectors(), v=directions())
def test_left_jacobian_is_its_series_on_both_sides_of_every_switch(
    angle: float, axis: FloatArray, v: FloatArray
) -> None:
    xi = np.concatenate([angle * axis, v])
    expected = left_jacobian_by_its_series(xi)
    np.testing.assert_allclose(se3.left_jacobian(xi), expected, rtol=0, atol=ROUNDING)


@given(xi=twists())
def test_left_jacobian_inverse(xi: FloatArray) -> None:
    product = se3.left_jacobian_inverse(xi) @ se3.left_jacobian(xi)
    np.testing.assert_allclose(product, np.eye(6), rtol=0, atol=1e-12)


@given(xi=twists(), delta=twists())
def test_left_jacobian_is_the_derivative_of_exp(xi: FloatArray, delta: FloatArray) -> None:
    step = 1e-6 * delta
    change = se3.log(se3.exp(xi + step) @ se3.inverse(se3.exp(xi - step)))
    np.testing.assert_allclose(se3.left_jacobian(xi) @ (2.0 * step), change, rtol=0, atol=1e-12)


@pytest.mark.parametrize('batch_shape', [(0,), (1,), (7,), (2, 3)])
@pytest.mark.parametrize(
    'function', [se3.hat, se3.exp, se3.left_jacobian, se3.left_jacobian_inverse]
)
def test_batches_of_twists_give_what_single_calls_give(
    function: Callable[[FloatArray], FloatArray], batch_shape: tuple[int, ...]
) -> None:
    xi = np.random.default_rng(1).normal(size=(*batch_shape, 6))
    found = function(xi)
    assert found.shape[: len(batch_shape)] == batch_shape
    for index in np.ndindex(batch_shape):
        np.testing.assert_allclose(found[index], function(xi[index]), rtol=0, atol=ROUNDING)


@pytest.mark.parametrize('batch_shape', [(0,), (1,), (7,), (2, 3)])
@pytest.mark.parametrize('function', [se3.inverse, se3.log, se3.adjoint, se3.vee, se3.project])
def test_batches_of_poses_give_what_single_calls_give(
    function: Callable[[FloatArray], FloatArray], batch_shape: tuple[int, ...]
) -> None:
    T = se3.exp(np.random.default_rng(2).normal(size=(*batch_shape, 6)))
    found = function(T)
    assert found.shape[: len(batch_shape)] == batch_shape
    for index in np.ndindex(batch_shape):
        np.testing.assert_allclose(found[index], function(T[index]), rtol=0, atol=ROUNDING)
