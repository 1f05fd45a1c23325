"""Alignment recovers rigid motions, and leaves alone what the points leave open."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from strategies import generators, poses, rotations

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.lie import se3
from slam_observer_ros.lie.se3 import rigid_alignment


@given(generators(), poses(), st.integers(3, 40), st.sampled_from([1e-3, 1.0, 1e4]))
def test_recovers_a_rigid_motion(
    rng: np.random.Generator, T: FloatArray, n: int, scale: float
) -> None:
    points = scale * rng.normal(size=(n, 3))
    found = rigid_alignment(points, se3.transform(T, points))
    np.testing.assert_allclose(
        se3.transform(found, points), se3.transform(T, points), atol=1e-11 * (scale + 100.0)
    )
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1.0)


@given(generators(), poses(), st.integers(4, 20))
def test_recovers_the_motion_of_coplanar_points(
    rng: np.random.Generator, T: FloatArray, n: int
) -> None:
    points = rng.normal(size=(n, 3)) * [5.0, 0.0, 3.0]
    np.testing.assert_allclose(rigid_alignment(points, se3.transform(T, points)), T, atol=1e-7)


@given(generators())
def test_a_reflection_is_never_returned(rng: np.random.Generator) -> None:
    points = rng.normal(size=(6, 3))
    found = rigid_alignment(points, points * [1.0, 1.0, -1.0])
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1.0)


@given(generators(), rotations(), st.integers(2, 10))
def test_collinear_points_cause_no_roll(rng: np.random.Generator, R: FloatArray, n: int) -> None:
    direction = rng.normal(size=3)
    along = rng.normal(size=(n, 1))
    new_direction = R @ direction
    found = rigid_alignment(along * direction, along * new_direction)
    np.testing.assert_allclose(
        se3.transform(found, along * direction), along * new_direction, atol=1e-9
    )
    # The rotation nearest to the identity turns by the angle between the two lines, no further.
    cosine = direction @ new_direction / (direction @ direction)
    assert np.trace(found[:3, :3]) == pytest.approx(1.0 + 2.0 * cosine, abs=1e-7)


@given(generators(), st.floats(-3.1, 3.1))
def test_flat_points_turn_about_the_vertical_only(rng: np.random.Generator, yaw: float) -> None:
    points = rng.normal(size=(8, 3)) * [5.0, 3.0, 0.0]
    T = se3.exp(np.array([0.0, 0.0, yaw, 3.0, -2.0, 0.0]))
    np.testing.assert_allclose(rigid_alignment(points, se3.transform(T, points)), T, atol=1e-9)
    mirrored = rigid_alignment(points, points * [1.0, -1.0, 1.0])
    np.testing.assert_allclose(mirrored[2, :3], [0.0, 0.0, 1.0], atol=1e-12)


def test_opposite_lines_are_aligned_by_half_a_turn() -> None:
    line = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    found = rigid_alignment(line, -line)
    np.testing.assert_allclose(se3.transform(found, line), -line, atol=1e-12)
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize('n', [1, 10])
def test_one_place_is_only_shifted(n: int) -> None:
    source, target = np.tile([0.1, 0.7, 0.3], (n, 1)), np.tile([1e3, 2.1, -0.7], (n, 1))
    found = rigid_alignment(source, target)
    np.testing.assert_array_equal(found[:3, :3], np.eye(3))
    np.testing.assert_allclose(se3.transform(found, source), target)


@given(generators())
def test_no_other_motion_fits_noisy_points_better(rng: np.random.Generator) -> None:
    source, target = rng.normal(size=(2, 8, 3))
    found = rigid_alignment(source, target)
    best = np.sum((se3.transform(found, source) - target) ** 2)
    for xi in rng.normal(0.0, [[1e-3], [0.1], [1.0]], (3, 6)):
        assert np.sum((se3.transform(found @ se3.exp(xi), source) - target) ** 2) >= best - 1e-12
