"""The covariance's storage: what numpy computes of whole matrices, symmetric to the bit."""

import numpy as np
import pytest

from slam_observer_ros.filter.arrays import subtract_square, SymmetricMatrix


@pytest.mark.parametrize('size', [3, 40, 300])
def test_growing_and_changing_it_is_what_numpy_computes_of_whole_matrices(size):
    rng = np.random.default_rng(size)
    root = rng.standard_normal((size, size))
    matrix, expected = SymmetricMatrix(root @ root.T), root @ root.T
    for count in (1, 2, 30):
        matrix.append_zeros(count)
        expected = np.pad(expected, (0, count))
        W, A, B = rng.standard_normal((3, 4, len(expected)))
        subtract_square(matrix._storage, len(expected), matrix._widened(W))
        matrix.add_symmetric_product(A, B)
        expected = expected - W.T @ W + A.T @ B + B.T @ A
        np.testing.assert_allclose(matrix.values, expected, atol=1e-11)
        np.testing.assert_array_equal(matrix.values, matrix.values.T)
        some = np.array([0, len(expected) - 1])
        np.testing.assert_array_equal(matrix.rows(some), matrix.values[some])


def test_what_is_written_to_its_values_stays_in_it():
    matrix = SymmetricMatrix(np.eye(2))
    matrix.append_zeros(1)
    matrix.values[2, 2] = 5.0
    matrix.append_zeros(3)
    np.testing.assert_array_equal(np.diagonal(matrix.values), [1.0, 1.0, 5.0, 0.0, 0.0, 0.0])
