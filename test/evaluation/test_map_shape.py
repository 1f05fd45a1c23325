"""The covariance of a map's shape: what is left of that of the map once it is aligned."""

from __future__ import annotations

import numpy as np
import pytest

from slam_observer_ros.evaluation.consistency import shape_covariances
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.se3 import rigid_alignment

GENERATOR = np.random.default_rng(3)
POINTS = GENERATOR.normal(size=(6, 3)) * 5.0


@pytest.mark.parametrize('k', [2, 3])
def test_it_is_what_errors_have_after_an_alignment(k: int) -> None:
    points = POINTS.copy()
    points[:, k:] = 0.0
    root = GENERATOR.normal(size=(6 * k, 6 * k)) * 1e-3
    errors = np.zeros((20_000, 6, 3))
    errors[:, :, :k] = (GENERATOR.normal(size=(20_000, 6 * k)) @ root.T).reshape(-1, 6, k)
    left = np.array(
        [
            se3.transform(rigid_alignment(moved, points), moved) - points
            for moved in points + errors
        ]
    )
    measured = np.einsum('sni,snj->nij', left, left) / len(left)
    stated = shape_covariances(points, root @ root.T)
    assert stated == pytest.approx(measured, abs=0.05 * measured.max())


@pytest.mark.parametrize('k', [2, 3])
def test_a_map_that_is_only_misplaced_has_no_error_of_its_shape(k: int) -> None:
    twists = np.array([[0.0, 0.0, 1.0, 0.5, 0.2, 0.0], [0.0, 0.0, 0.0, 1.0, -2.0, 0.0]])
    moves = np.array([np.cross(twist[:3], POINTS) + twist[3:] for twist in twists])
    motions = moves[:, :, :k].reshape(2, -1)
    assert shape_covariances(POINTS, motions.T @ motions) == pytest.approx(0.0, abs=1e-12)


def test_one_landmark_has_no_shape() -> None:
    assert shape_covariances(POINTS[:1], np.eye(3)) == pytest.approx(0.0, abs=1e-12)
