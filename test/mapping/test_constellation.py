"""Places in a map by points without ids: found if they are there, else none is believed."""

from __future__ import annotations

from itertools import permutations

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.axes import PLANAR, SPATIAL
from slam_observer_ros.mapping import constellation
from slam_observer_ros.mapping.constellation import find_places
from slam_observer_ros.mapping.landmark_map import MappedLandmarks
from slam_observer_ros.mapping.places import Anywhere, Constellation, Near, Weighing

SIGMA_M = 0.02
ERROR_PROBABILITY = 1e-3
AXES = pytest.mark.parametrize('axes', [PLANAR, SPATIAL], ids=['plane', 'space'])


class Hall:
    """Reflectors in a hall of 60 m × 40 m, six metres high, and a robot that sees 15 m."""

    def __init__(self, axes, seed=0, count=80, points=None):
        self.axes, self.random = axes, np.random.default_rng(seed)
        self.flat = np.arange(3) < axes.point
        if points is None:
            points = self.random.uniform(0, [60, 40, 6], (count, 3))
        self.points = points * self.flat
        self.known = known_at(self.points, axes)

    def anywhere(self):
        turn = self.random.normal(size=3) * (1.0 if self.axes.turn == 3 else [0, 0, 2])
        position = self.random.uniform(self.points.min(axis=0), self.points.max(axis=0))
        return se3.pose(so3.exp(turn), position * self.flat)

    def see(self, pose, count, false=0, sigma_m=SIGMA_M):
        """The nearest reflectors, the first few of them displaced by metres."""
        points = se3.transform(se3.inverse(pose), self.points)
        rows = np.argsort(np.linalg.norm(points, axis=1))[:count]
        points = points[rows] + self.random.normal(scale=sigma_m, size=(count, 3)) * self.flat
        displaced = self.random.permutation(count)[:false]
        points[displaced] = self.random.uniform(-15, 15, (false, 3)) * self.flat
        rows[displaced] = -1
        return seen(points, self.axes), rows

    def find(self, points):
        return find_places(self.known, points, Anywhere(self.known), ERROR_PROBABILITY)


def known_at(points, axes, sigma_m=1e-3):
    return MappedLandmarks(points, np.tile(sigma_m**2 * np.eye(3), (len(points), 1, 1)), axes)


def seen(points, axes, covariance=None, only=None):
    if covariance is None:
        covariance = SIGMA_M**2 * np.eye(axes.point * len(points))
    return Constellation(points, covariance, np.full(len(points), -1) if only is None else only)


@AXES
def test_a_look_at_a_few_reflectors_says_where_it_was_taken(axes):
    for seed in range(10):
        hall = Hall(axes, seed)
        pose = hall.anywhere()
        points, rows = hall.see(pose, 7)
        place = hall.find(points).decided(ERROR_PROBABILITY)
        assert_array_equal(place.rows, rows)
        assert_allclose(place.transform, pose, atol=0.15)


@AXES
@pytest.mark.parametrize(('count', 'false'), [(6, 1), (8, 2), (10, 3)])
def test_points_of_no_reflector_do_not_hide_the_place(axes, count, false):
    found = 0
    for seed in range(20):
        hall = Hall(axes, seed, 300)
        pose = hall.anywhere()
        points, _ = hall.see(pose, count, false)
        place = hall.find(points).decided(ERROR_PROBABILITY)
        if place is not None:
            found += 1
            assert_allclose(place.transform, pose, atol=0.3)
    assert found >= 18


@AXES
def test_a_robot_that_is_not_in_the_map_is_not_found_there(axes):
    hall, elsewhere = Hall(axes, 1, 300), Hall(axes, 2, 300)
    for _ in range(100):
        points, _ = elsewhere.see(elsewhere.anywhere(), 6)
        assert hall.find(points).decided(ERROR_PROBABILITY) is None


def test_a_hall_that_looks_the_same_from_two_places_decides_nothing_but_a_rough_pose_does():
    half = np.random.default_rng(0).uniform(0, [60, 40, 0], (40, 3))
    hall = Hall(PLANAR, points=np.concatenate([half, [60, 40, 0] - half]))
    turned = se3.pose(so3.exp(np.array([0, 0, np.pi])), np.array([60.0, 40, 0]))
    for _ in range(10):
        pose = hall.anywhere()
        points, _ = hall.see(pose, 7)
        places = hall.find(points)
        assert places.decided(ERROR_PROBABILITY) is None
        assert places.all[0].share == pytest.approx(0.5, abs=0.01)
        for true in (pose, turned @ pose):
            assert any(np.allclose(place.transform, true, atol=0.15) for place in places.all)
        wide = np.diag([0.1, 0.1, 0.5, 5.0, 5.0, 5.0]) ** 2
        rough = pose.copy()
        rough[0, 3] += 4.0
        prior = Near(rough, wide, PLANAR)
        place = find_places(hall.known, points, prior, ERROR_PROBABILITY).decided(1e-3)
        assert_allclose(place.transform, pose, atol=0.15)


def test_a_regular_grid_of_columns_decides_nothing():
    x, y = np.meshgrid(np.arange(12) * 5.0, np.arange(8) * 5.0)
    grid = Hall(PLANAR, points=np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()]))
    for false in (0, 1):
        for _ in range(10):
            points, _ = grid.see(grid.anywhere(), 7, false)
            places = grid.find(points)
            assert places.decided(ERROR_PROBABILITY) is None
            assert len(places.all) >= 2


def test_the_most_likely_place_is_that_of_a_search_through_everything():
    hall = Hall(PLANAR, 3, 12)
    for _ in range(5):
        points, _ = hall.see(hall.anywhere(), 6, false=2)
        weighing = Weighing(hall.known, points, Anywhere(hall.known))
        best = -np.inf
        for base in permutations(range(6), 2):
            for rows in permutations(range(12), 2):
                T = constellation._aligned(
                    points.points[None, list(base)], hall.points[None, list(rows)], PLANAR
                )[0]
                near_m, near = hall.known.tree.query(se3.transform(T, points.points)[:, :2])
                matched = np.where(near_m < 0.2, near, -1)
                if len(set(matched)) - (-1 in matched) == np.sum(matched >= 0):
                    place = weighing.place(T, matched)
                    best = max(best, -np.inf if place is None else place.log_mass)
        assert hall.find(points).all[0].log_mass >= best - 0.01


def test_points_mapped_on_a_drive_are_found_despite_what_odometry_has_bent():
    """By their joint covariance: the turn of what was seen last is off by several degrees."""
    hall = Hall(PLANAR, 4, 300)
    for _ in range(10):
        pose = hall.anywhere()
        points, rows = hall.see(pose, 8)
        order = np.argsort(points.points[:, 0])
        late = order[4:]
        lever = points.points[late] - points.points[order[3]]
        J = np.zeros((16, 1))
        J[(2 * late[:, None] + [0, 1]).ravel(), 0] = np.column_stack(
            [-lever[:, 1], lever[:, 0]]
        ).ravel()
        bent = points.points.copy()
        bent[:, :2] += (J * hall.random.normal(scale=0.08)).reshape(-1, 2)
        drifted = seen(bent, PLANAR, points.covariance + 0.08**2 * J @ J.T)
        place = hall.find(drifted).decided(ERROR_PROBABILITY)
        assert_array_equal(place.rows, rows)


def test_noise_of_twice_the_stated_size_is_not_taken_for_another_place():
    right = 0
    for seed in range(20):
        hall = Hall(PLANAR, seed, 300)
        pose = hall.anywhere()
        points, _ = hall.see(pose, 8, sigma_m=2 * SIGMA_M)
        place = hall.find(points).decided(ERROR_PROBABILITY)
        if place is not None:
            right += 1
            assert_allclose(place.transform, pose, atol=0.4)
    assert right >= 16


def test_ids_narrow_the_search_but_a_wrong_one_is_not_believed():
    half = np.random.default_rng(0).uniform(0, [60, 40, 0], (40, 3))
    hall = Hall(PLANAR, points=np.concatenate([half, [60, 40, 0] - half]))
    pose = hall.anywhere()
    points, rows = hall.see(pose, 7)
    # One id is enough to tell two places from each other that look the same.
    only = np.full(7, -1)
    only[2] = rows[2]
    place = hall.find(seen(points.points, PLANAR, only=only)).decided(ERROR_PROBABILITY)
    assert_allclose(place.transform, pose, atol=0.15)
    # A wrong one among right ones is that of a point of no landmark.
    only = rows.copy()
    only[2] = (rows[2] + 7) % 80
    place = hall.find(seen(points.points, PLANAR, only=only)).decided(ERROR_PROBABILITY)
    assert_allclose(place.transform, pose, atol=0.15)
    assert place.rows[2] == -1


@AXES
def test_how_likely_a_place_is_beforehand_counts_what_the_look_itself_leaves_open(axes):
    """Far from the origin a turn that is hardly known moves the frame's origin by metres."""
    pose, exact = se3.pose(np.eye(3), np.zeros(3)), np.zeros((6, 6))
    near = Near(pose, exact, axes)
    open_ = np.diag([0.1, 0.1, 0.1, 1.0, 1.0, 1.0])[axes.pose, axes.pose] ** 2
    off = se3.pose(np.eye(3), np.array([1.0, 0.0, 0.0]))
    at_pose, at_off = near.log_density(pose, open_), near.log_density(off, open_)
    assert at_pose - at_off == pytest.approx(0.5, abs=1e-3)
    assert near.log_density(off, 0.0 * open_) < at_off - 1e3
    assert at_pose < near.largest


def test_a_pose_that_is_given_decides_a_hundred_metres_from_the_origin():
    half = np.random.default_rng(0).uniform(0, [60, 40, 0], (40, 3))
    hall = Hall(PLANAR, points=np.concatenate([half, [60, 40, 0] - half]) + [300.0, 0, 0])
    for _ in range(10):
        pose = hall.anywhere()
        points, rows = hall.see(pose, 7)
        # The frame that is looked for has its origin far away from all that is seen there.
        far = se3.pose(so3.exp(np.array([0.0, 0.0, 1.0])), np.array([-100.0, 50.0, 0.0]))
        moved = seen(se3.transform(far, points.points), PLANAR)
        prior = Near(pose @ se3.inverse(far), np.zeros((6, 6)), PLANAR)
        place = find_places(hall.known, moved, prior, ERROR_PROBABILITY).decided(1e-3)
        assert_array_equal(place.rows, rows)


def test_what_would_take_too_long_is_not_decided():
    hall = Hall(PLANAR, 5, 300)
    points, _ = hall.see(hall.anywhere(), 8, false=3)
    places = find_places(hall.known, points, Anywhere(hall.known), ERROR_PROBABILITY, looks=100)
    assert not places.is_complete
    assert places.decided(ERROR_PROBABILITY) is None


def test_a_few_points_and_small_maps_decide_nothing():
    hall = Hall(PLANAR, 6)
    for count in (1, 2):
        points, _ = hall.see(hall.anywhere(), count)
        assert hall.find(points).decided(ERROR_PROBABILITY) is None
    for n in (1, 2):
        known = known_at(hall.points[:n], PLANAR)
        places = find_places(known, hall.see(hall.anywhere(), 5)[0], Anywhere(known), 1e-3)
        assert places.decided(ERROR_PROBABILITY) is None
