"""The axioms of a Lie group, for every group of the package and every shape of batch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import slam_group
from slam_group import SlamElement

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.lie import se3, so3


@dataclass(frozen=True)
class Group:
    """What the axioms need of a group whose algebra is written as vectors (..., dimension)."""

    name: str
    dimension: int
    identity: Any
    compose: Callable[[Any, Any], Any]
    inverse: Callable[[Any], Any]
    exp: Callable[[FloatArray], Any]
    as_matrix: Callable[[Any], FloatArray] = lambda element: element


def slam_exp(vector: FloatArray) -> SlamElement:
    landmarks = vector[..., 6:].reshape(*vector.shape[:-1], (vector.shape[-1] - 6) // 3, 3)
    return slam_group.exp(vector[..., :6], landmarks)


def slam_matrix(X: SlamElement) -> FloatArray:
    """Write (A, a_1 … a_n) as [[R, x, a_1 … a_n], [0, I]]: a faithful representation of (22)."""
    n = X.a.shape[-2]
    matrix = np.zeros((*X.A.shape[:-2], 4 + n, 4 + n))
    matrix[..., range(4 + n), range(4 + n)] = 1.0
    matrix[..., :3, :4] = X.A[..., :3, :]
    matrix[..., :3, 4:] = X.a.swapaxes(-1, -2)
    return matrix


def slam_n_3(n: int) -> Group:
    return Group(
        f'SLAM_{n}(3)',
        6 + 3 * n,
        slam_group.identity(n),
        slam_group.compose,
        slam_group.inverse,
        slam_exp,
        slam_matrix,
    )


GROUPS = (
    Group('SO(3)', 3, np.eye(3), np.matmul, lambda R: R.swapaxes(-1, -2), so3.exp),
    Group('SE(3)', 6, np.eye(4), np.matmul, se3.inverse, se3.exp),
    slam_n_3(0),
    slam_n_3(1),
    slam_n_3(12),
)

every_group = pytest.mark.parametrize('group', GROUPS, ids=lambda group: group.name)
every_batch_shape = pytest.mark.parametrize(
    'batch_shape', [(), (1,), (20,), (2, 3), (0,)], ids=str
)


def random_vectors(group: Group, batch_shape: tuple[int, ...], count: int) -> FloatArray:
    return np.random.default_rng(5).normal(size=(count, *batch_shape, group.dimension))


def assert_same(group: Group, found: Any, expected: Any) -> None:
    expected_matrix = group.as_matrix(expected)
    found_matrix, expected_matrix = np.broadcast_arrays(group.as_matrix(found), expected_matrix)
    np.testing.assert_allclose(found_matrix, expected_matrix, rtol=0, atol=1e-12)


@every_group
@every_batch_shape
def test_product_is_associative(group: Group, batch_shape: tuple[int, ...]) -> None:
    X, Y, Z = map(group.exp, random_vectors(group, batch_shape, 3))
    left = group.compose(group.compose(X, Y), Z)
    assert_same(group, left, group.compose(X, group.compose(Y, Z)))


@every_group
@every_batch_shape
def test_identity_is_neutral(group: Group, batch_shape: tuple[int, ...]) -> None:
    (X,) = map(group.exp, random_vectors(group, batch_shape, 1))
    assert_same(group, group.compose(X, group.identity), X)
    assert_same(group, group.compose(group.identity, X), X)


@every_group
@every_batch_shape
def test_inverse_undoes(group: Group, batch_shape: tuple[int, ...]) -> None:
    (X,) = map(group.exp, random_vectors(group, batch_shape, 1))
    assert_same(group, group.compose(X, group.inverse(X)), group.identity)
    assert_same(group, group.compose(group.inverse(X), X), group.identity)
    assert_same(group, group.inverse(group.inverse(X)), X)


@every_group
@every_batch_shape
def test_product_is_the_product_of_matrices(group: Group, batch_shape: tuple[int, ...]) -> None:
    X, Y = map(group.exp, random_vectors(group, batch_shape, 2))
    found = group.as_matrix(group.compose(X, Y))
    expected = group.as_matrix(X) @ group.as_matrix(Y)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


@every_group
@every_batch_shape
def test_exp_starts_at_the_identity(group: Group, batch_shape: tuple[int, ...]) -> None:
    assert_same(group, group.exp(np.zeros((*batch_shape, group.dimension))), group.identity)


@every_group
@every_batch_shape
def test_exp_of_the_opposite_is_the_inverse(group: Group, batch_shape: tuple[int, ...]) -> None:
    (vector,) = random_vectors(group, batch_shape, 1)
    assert_same(group, group.exp(-vector), group.inverse(group.exp(vector)))


@every_group
@every_batch_shape
def test_exp_adds_along_one_direction(group: Group, batch_shape: tuple[int, ...]) -> None:
    (vector,) = random_vectors(group, batch_shape, 1)
    product = group.compose(group.exp(0.3 * vector), group.exp(0.9 * vector))
    assert_same(group, product, group.exp(1.2 * vector))
