"""SO(3): conversions are accurate from 1e-12 rad to half a turn, one by one and in batches."""

from __future__ import annotations

from collections.abc import Callable

from hypothesis import given
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from strategies import (
    DELICATE_ANGLES,
    directions,
    generators,
    rotation_vectors,
    rotations,
    unit_vectors,
)

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.lie import so3

ROUNDING = 1e-14


@given(phi=rotation_vectors(), w=directions())
def test_hat_is_the_cross_product_7(phi: FloatArray, w: FloatArray) -> None:
    np.testing.assert_allclose(so3.hat(phi) @ w, np.cross(phi, w), rtol=0, atol=ROUNDING)


@given(phi=directions())
def test_vee_undoes_hat_exactly(phi: FloatArray) -> None:
    np.testing.assert_array_equal(so3.vee(so3.hat(phi)), phi)


@given(phi=rotation_vectors())
def test_exp_is_the_matrix_exponential(phi: FloatArray) -> None:
    np.testing.assert_allclose(so3.exp(phi), expm(so3.hat(phi)), rtol=0, atol=ROUNDING)


@given(phi=directions(scale=20.0))
def test_exp_is_a_rotation_after_several_turns_too(phi: FloatArray) -> None:
    R = so3.exp(phi)
    np.testing.assert_allclose(R @ R.T, np.eye(3), rtol=0, atol=1e-13)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-13)
    np.testing.assert_allclose(R, Rotation.from_rotvec(phi).as_matrix(), rtol=0, atol=1e-13)


@given(phi=rotation_vectors())
def test_log_undoes_exp_to_relative_rounding(phi: FloatArray) -> None:
    error = np.linalg.norm(so3.log(so3.exp(phi)) - phi)
    assert error <= 4e-15 * np.linalg.norm(phi)


@given(R=rotations())
def test_exp_undoes_log(R: FloatArray) -> None:
    np.testing.assert_allclose(so3.exp(so3.log(R)), R, rtol=0, atol=ROUNDING)


@given(axis=unit_vectors())
def test_log_takes_the_short_way_beyond_half_a_turn(axis: FloatArray) -> None:
    for excess in (1e-12, 1e-9, 1e-6, 1e-3, 1.0):
        expected = (excess - np.pi) * axis
        found = so3.log(so3.exp((np.pi + excess) * axis))
        np.testing.assert_allclose(found, expected, rtol=0, atol=ROUNDING)


@given(axis=unit_vectors())
def test_log_of_exactly_half_a_turn_is_plus_or_minus_pi_times_the_axis(axis: FloatArray) -> None:
    phi = so3.log(2.0 * np.outer(axis, axis) - np.eye(3))
    assert np.linalg.norm(phi) == pytest.approx(np.pi, abs=ROUNDING)
    assert abs(phi @ axis) == pytest.approx(np.pi, abs=ROUNDING)


@pytest.mark.parametrize('angle', DELICATE_ANGLES)
@given(axis=unit_vectors())
def test_left_jacobian_is_the_mean_of_the_rotations_on_the_way(
    angle: float, axis: FloatArray
) -> None:
    nodes, weights = np.polynomial.legendre.leggauss(20)
    phi = angle * axis
    steps = so3.exp(0.5 * (nodes[:, None] + 1.0) * phi)
    mean = 0.5 * np.tensordot(weights, steps, axes=1)
    np.testing.assert_allclose(so3.left_jacobian(phi), mean, rtol=0, atol=ROUNDING)


@given(phi=rotation_vectors(), direction=unit_vectors())
def test_left_jacobian_is_the_derivative_of_exp(phi: FloatArray, direction: FloatArray) -> None:
    step = 1e-6 * direction
    change = so3.log(so3.exp(phi + step) @ so3.exp(phi - step).T)
    np.testing.assert_allclose(so3.left_jacobian(phi) @ (2.0 * step), change, rtol=0, atol=1e-14)


@given(phi=rotation_vectors())
def test_left_jacobian_inverse(phi: FloatArray) -> None:
    product = so3.left_jacobian_inverse(phi) @ so3.left_jacobian(phi)
    np.testing.assert_allclose(product, np.eye(3), rtol=0, atol=ROUNDING)


@given(R=rotations())
def test_quaternions_are_unit_xyzw_and_agree_with_scipy(R: FloatArray) -> None:
    quaternion = so3.to_quaternion(R)
    np.testing.assert_array_equal(so3.to_quaternion(R[None]), quaternion[None])
    assert quaternion[3] >= 0.0
    assert np.linalg.norm(quaternion) == pytest.approx(1.0, abs=1e-15)
    expected = Rotation.from_matrix(R).as_quat()
    assert abs(quaternion @ expected) == pytest.approx(1.0, abs=ROUNDING)
    np.testing.assert_allclose(so3.from_quaternion(quaternion), R, rtol=0, atol=ROUNDING)


@given(random=generators())
def test_from_quaternion_takes_any_length_and_either_sign(random: np.random.Generator) -> None:
    quaternion = random.normal(size=4)
    expected = Rotation.from_quat(quaternion).as_matrix()
    for scale in (1.0, -1.0, 1e-3, 1e3):
        found = so3.from_quaternion(scale * quaternion)
        np.testing.assert_allclose(found, expected, rtol=0, atol=ROUNDING)


@given(R=rotations(), random=generators())
def test_normalise_squares_the_drift(R: FloatArray, random: np.random.Generator) -> None:
    drift = random.uniform(-1e-6, 1e-6, size=(3, 3))
    restored = so3.normalise(R + drift)
    np.testing.assert_allclose(restored @ restored.T, np.eye(3), rtol=0, atol=1e-10)
    np.testing.assert_allclose(restored, R, rtol=0, atol=1e-5)


def test_normalise_keeps_thousands_of_small_products_a_rotation() -> None:
    R = np.eye(3)
    step = so3.exp(np.array([1e-3, -2e-3, 3e-3]))
    for _ in range(5_000):
        R = so3.normalise(R @ step)
    np.testing.assert_allclose(R @ R.T, np.eye(3), rtol=0, atol=1e-15)


@pytest.mark.parametrize('batch_shape', [(0,), (1,), (7,), (2, 3)])
@pytest.mark.parametrize(
    'function', [so3.hat, so3.exp, so3.left_jacobian, so3.left_jacobian_inverse]
)
def test_batches_of_vectors_give_what_single_calls_give(
    function: Callable[[FloatArray], FloatArray], batch_shape: tuple[int, ...]
) -> None:
    phi = np.random.default_rng(1).normal(size=(*batch_shape, 3))
    found = function(phi)
    assert found.shape == (*batch_shape, 3, 3)
    for index in np.ndindex(batch_shape):
        np.testing.assert_allclose(found[index], function(phi[index]), rtol=0, atol=ROUNDING)


@pytest.mark.parametrize('batch_shape', [(0,), (1,), (7,), (2, 3)])
@pytest.mark.parametrize('function', [so3.vee, so3.log, so3.to_quaternion, so3.normalise])
def test_batches_of_matrices_give_what_single_calls_give(
    function: Callable[[FloatArray], FloatArray], batch_shape: tuple[int, ...]
) -> None:
    R = so3.exp(np.random.default_rng(2).normal(size=(*batch_shape, 3)))
    found = function(R)
    assert found.shape[: len(batch_shape)] == batch_shape
    for index in np.ndindex(batch_shape):
        np.testing.assert_allclose(found[index], function(R[index]), rtol=0, atol=ROUNDING)
