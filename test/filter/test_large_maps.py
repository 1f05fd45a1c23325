"""Large maps: a compressed covariance is the dense one with the same references."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

from hypothesis import given
from hypothesis import settings as suite
import numpy as np
import pytest
from random_runs import (
    covariance_of_all,
    observe,
    PLAIN,
    propagate,
    random_covariances,
    residuals_of,
)
from strategies import generators

from slam_observer_ros.estimator.placement import make_gains
from slam_observer_ros.filter.arrays import SeenOrientations
from slam_observer_ros.filter.known_landmarks import KnownLandmarks
from slam_observer_ros.filter.riccati import outside_landmarks, postponed
from slam_observer_ros.filter.riccati.active_landmarks import BlockSize, CHECK_INTERVAL
from slam_observer_ros.filter.riccati.following_landmarks import REFERENCE_SHIFT_M
from slam_observer_ros.filter.riccati.postponed import PanelMatrix
from slam_observer_ros.filter.riccati.riccati import RiccatiGains
from slam_observer_ros.lie import se3, so3

VIEW_M = 6.0

CALIBRATED = replace(
    PLAIN, angular_bias_stddev=(0.02, 0.02, 0.02), linear_scale_stddev=(0.1, 0.1, 0.1)
)
PLANAR = replace(CALIBRATED, two_d_mode=True)
TAGS = replace(CALIBRATED, use_tag_orientation=True)
PLANAR_TAGS = replace(TAGS, two_d_mode=True)


@pytest.fixture(autouse=True)
def _many_panels(monkeypatch):
    """So that a change has come to some of them only, most of the time."""
    for module in (postponed, outside_landmarks):
        monkeypatch.setattr(module, 'PANEL_ROWS', 12)


class Compressed(RiccatiGains):
    """Gains whose map is soon taken for a large one."""

    block = BlockSize(dense=5, most=6, kept=3, kept_per_seen=1)


class SameReferences(RiccatiGains):
    """Dense gains that judge motions by the references of compressed ones."""

    block = BlockSize(dense=10**9)

    def advance(self, velocities, interval):
        joint = self.compressed.joint
        points = self.compressed.observer.points if joint.is_dense else joint.references
        x = self.flat()._replace(y_ref=np.array(points), a=np.zeros_like(points))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(self, 'flat', lambda: x)
            return super().advance(velocities, interval)


def pair(settings):
    """The compressed filter and the dense one."""
    compressed = make_gains(settings, np.eye(4), Compressed)
    dense = make_gains(settings, np.eye(4), SameReferences)
    dense.compressed = compressed
    return compressed, dense


class World:
    """Landmarks along a ring, and a robot that goes around it."""

    def __init__(self, rng, settings, landmarks=24, radius_m=12.0):
        self.rng, self.planar = rng, settings.two_d_mode
        angles = 2.0 * np.pi * np.arange(landmarks) / landmarks
        self.points = radius_m * np.stack([np.sin(angles), 1 - np.cos(angles), 0 * angles], axis=1)
        self.points += self.flat(rng.uniform(-2.0, 2.0, self.points.shape))
        self.pose, self.ids, self.are_tags = np.eye(4), [], settings.use_tag_orientation
        turns = rng.normal(size=(landmarks, 3)) * [not self.planar, not self.planar, 1]
        self.orientations = so3.exp(turns)
        self.radius_m = radius_m

    def flat(self, vectors):
        return vectors * np.array([1.0, 1.0, not self.planar])

    def move(self, filters):
        V = np.array([0.0, 0.0, 1.0 / self.radius_m, 1.0, 0.0, 0.0])
        self.pose = self.pose @ se3.exp(V)
        noise = np.diag([1e-4, 1e-4, 1e-4, 1e-3, 1e-3, 1e-3])
        error = np.sqrt(np.diag(noise)) * self.rng.standard_normal(6)
        error *= [not self.planar, not self.planar, 1, 1, 1, not self.planar]
        for filter_ in filters:
            propagate(filter_, (V + error)[None], np.ones(1), noise[None])

    def seen(self, ids):
        y = se3.transform(se3.inverse(self.pose), self.points[ids])
        return y + self.flat(0.05 * self.rng.standard_normal(y.shape))

    def look(self, filters):
        """Observe the landmarks in view that are known; add those that are not."""
        distances = np.linalg.norm(self.points - self.pose[:3, 3], axis=1)
        near = np.flatnonzero(distances < VIEW_M)[:4]
        known = np.array([i for i in near if i in self.ids], dtype=np.int64)
        new = np.setdiff1d(near, known)
        y, y_new = self.seen(known), self.seen(new)
        R = 0.05**2 * np.tile(np.eye(3), (len(near), 1, 1))
        rows = np.array([self.ids.index(i) for i in known], dtype=np.int64)
        rows_new = len(self.ids) + np.arange(len(new))
        turns, turns_new = self.seen_turns(rows, known), self.seen_turns(rows_new, new)
        for filter_ in filters:
            if len(known):
                if self.are_tags:
                    residuals_of(filter_, rows, y, R[: len(known)])  # makes them active
                    filter_.correct_by_orientations(turns)
                observe(filter_, rows, y, R[: len(known)])
            if len(new):
                filter_.add(y_new, R[: len(new)])
                if self.are_tags:
                    filter_.add_orientations(turns_new)
        self.ids += new.tolist()

    def seen_turns(self, rows, ids):
        """How tags are seen to be turned."""
        noise = 0.1 * self.rng.standard_normal((len(ids), 3))
        if self.planar:
            noise[:, :2] = 0.0
        Z = self.pose[:3, :3].T @ self.orientations[ids] @ so3.exp(noise)
        R = np.tile(0.01 * np.eye(3), (len(ids), 1, 1))
        return SeenOrientations(rows, Z, Z, R, np.ones(len(ids)))

    def remove(self, filters, rows):
        for filter_ in filters:
            filter_.remove(rows)
        self.ids = [i for row, i in enumerate(self.ids) if row not in rows]

    def relocate(self, filters, rows):
        y = self.seen(np.array(self.ids)[rows])
        for filter_ in filters:
            filter_.relocate(rows, y, 0.01 * np.eye(3)[None])

    def drive(self, filters, steps):
        for _ in range(steps):
            self.move(filters)
            self.look(filters)


def assert_same(compressed, dense, tolerance=1e-9):
    rows = np.arange(len(dense.observer.points))
    if dense.tags is not None:
        B, sigmas = dense.observer.orientations.B, dense.errors.orientation_sigmas(rows)
        np.testing.assert_allclose(compressed.errors.orientation_matrices(rows), B, atol=tolerance)
        np.testing.assert_allclose(
            compressed.errors.orientation_sigmas(rows), sigmas, atol=tolerance
        )
        of_all = [
            each.joint.of_landmarks(rows, dense.observer.points, rows)
            for each in (compressed, dense)
        ]
        np.testing.assert_allclose(*of_all, rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(compressed.observer.A, dense.observer.A, rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(
        compressed.observer.points, dense.observer.points, rtol=0.0, atol=tolerance
    )
    np.testing.assert_allclose(
        compressed.calibration.values,
        dense.calibration.values,
        rtol=0.0,
        atol=tolerance,
    )
    np.testing.assert_allclose(
        compressed.errors.landmark_covariances(),
        dense.errors.landmark_covariances(),
        rtol=0.0,
        atol=tolerance,
    )
    np.testing.assert_allclose(
        covariance_of_all(compressed), covariance_of_all(dense), rtol=0.0, atol=tolerance
    )


@pytest.mark.parametrize(
    'settings',
    [PLAIN, CALIBRATED, PLANAR, TAGS, PLANAR_TAGS],
    ids=['3D', '3D, c̃', 'planar', 'tags', 'planar tags'],
)
@suite(max_examples=2)
@given(generators())
def test_compressed_covariance_is_the_dense_one(settings, rng):
    """Over a loop and its closing, landmarks removed and relocated."""
    filters, world = pair(settings), World(rng, settings)
    for _ in range(5):
        world.drive(filters, 17)
        assert_same(*filters)
        removed = np.unique(rng.integers(0, len(world.ids), 2))
        world.remove(filters, removed)
        world.relocate(filters, rng.integers(0, len(world.ids), 1))
        assert_same(*filters)
    assert not filters[0].joint.is_dense


@suite(max_examples=2)
@given(generators())
def test_copies_share_what_is_large_and_change_apart(rng):
    filters, world = pair(PLAIN), World(rng, PLAIN)
    world.drive(filters, 40)
    others = compressed, dense = tuple(filter_.copy() for filter_ in filters)
    dense.compressed, other_world = compressed, deepcopy(world)
    before = covariance_of_all(filters[0])
    other_world.drive(others, 50)
    np.testing.assert_array_equal(covariance_of_all(filters[0]), before)
    assert_same(*others)
    world.rng = np.random.default_rng(1)
    world.drive(filters, 50)
    assert_same(*filters)


@pytest.mark.parametrize(
    'settings',
    [CALIBRATED, PLANAR, TAGS, PLANAR_TAGS],
    ids=['3D', 'planar', 'tags', 'planar tags'],
)
@suite(max_examples=2)
@given(generators())
def test_known_maps_poses_that_are_set_and_known_landmarks_that_anchor(settings, rng):
    filters, world = pair(settings), World(rng, settings)
    ids = rng.permutation(len(world.points))[:15]
    covariances = 0.01 * random_covariances(rng, len(ids), 3)
    known = world.points[ids] + world.flat(0.1 * rng.standard_normal((len(ids), 3)))
    tags = {'orientations': world.orientations[ids], 'sigmas': np.full(len(ids), 0.05)}
    for filter_ in filters:
        filter_.add_known(KnownLandmarks(known, covariances, **tags if world.are_tags else {}))
    world.ids += ids.tolist()
    world.drive(filters, 30)
    assert_same(*filters)
    pose = world.pose @ se3.exp(0.01 * np.array([0.0, 0.0, 1.0, 1.0, 1.0, 0.0]))
    covariance = 1e-3 * random_covariances(rng, 1, 6)[0]
    for filter_ in filters:
        filter_.set_pose(pose, covariance)
    assert_same(*filters)
    world.drive(filters, 20)
    rows = np.arange(0, 15, 3)
    r = filters[0].observer.points[rows] - known[rows]
    for filter_ in filters:
        filter_.anchor(rows, r, covariances[rows])
    assert_same(*filters)
    world.drive(filters, 20)
    assert_same(*filters)


def test_references_follow_estimates_that_are_corrected_by_more_than_a_tolerance():
    filters, world, since = pair(PLAIN), World(np.random.default_rng(0), PLAIN), 0
    for _ in range(120):
        world.drive(filters, 1)
        compressed = filters[0]
        if compressed.joint.is_dense:
            continue
        off_m = np.linalg.norm(compressed.joint.references - compressed.observer.points, axis=1)
        moved = np.max(off_m, initial=0.0) > REFERENCE_SHIFT_M
        since = since + 1 if moved else 0
        assert since <= CHECK_INTERVAL


def test_what_is_pending_comes_to_the_panels_a_little_at_a_time():
    """Products of low rank begin, and each panel is given its rows at some later time."""
    rng, matrix, M = np.random.default_rng(0), PanelMatrix(), np.zeros((0, 0))
    rows = postponed.PANEL_ROWS
    for number in range(40):
        if number < 5:
            matrix.append()
            M = np.pad(M, (0, rows))
        for panel in range(len(matrix)):
            columns = np.sort(rng.permutation(len(M))[:5])
            values = rng.standard_normal((rows, 5))
            own = slice(rows * panel, rows * (panel + 1))
            inside = (columns >= own.start) & (columns < own.stop)
            square = values[columns[inside] - own.start][:, inside]
            values[np.ix_(columns[inside] - own.start, np.flatnonzero(inside))] = square + square.T
            matrix.set_columns(panel, columns, values)
            M[own, columns], M[columns, own] = values, values.T
        U, w = rng.standard_normal((len(M), 9)), rng.choice([-1.0, 1.0], 9)
        matrix.begin(w)
        for panel in rng.permutation(len(matrix)):
            matrix.add(panel, U[rows * panel : rows * (panel + 1)])
            matrix.fold(1.0)
        matrix.end()
        M = M + (U * w) @ U.T
        everything = np.arange(len(M))
        found = [matrix.columns(panel, everything) for panel in range(len(matrix))]
        np.testing.assert_allclose(np.concatenate(found), M, atol=1e-9)
