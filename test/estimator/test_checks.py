"""What is refused at the door, and what is made exact there: covariances, maps, rotations."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import given
from hypothesis import settings as hypothesis_settings
import numpy as np
import pytest
from strategies import generators

from slam_observer_ros.common.errors import MapError, ParameterError
from slam_observer_ros.common.types import FIRST_AUTOMATIC_ID
from slam_observer_ros.estimates import used_points
from slam_observer_ros.estimator.checks import SECTORS
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID, VelocityBlock, VelocityEvent
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.matrices import are_covariances
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.settings.estimator_settings import Settings

IDS, POINTS = np.arange(4), np.array([[1.0, 0, 0], [0, 2, 0], [3, 1, 1], [2, 2, 2]])
OFF = 1.0004
"""By what a rotation is scaled that is taken all the same."""


def variances(**entries):
    """A covariance (6, 6) of 0.01 in each direction but for entries as ``c01=1.0``."""
    matrix = 0.01 * np.eye(6)
    for name, value in entries.items():
        matrix[int(name[1]), int(name[2])] = value
    return matrix


WRONG = [
    *(variances(c33=largest, c44=-1.0) for largest in (1e9, 1e12, 1e16, 1e300)),
    variances(c22=1e300, c01=1e250, c10=1e250),
    variances(c55=1e308, c01=1e250),
    variances(c55=1e308, c01=0.005),
    variances(c33=1e9, c01=0.02, c10=0.02),
    variances(c33=0.0, c34=0.005, c43=0.005),
]

RIGHT = [
    np.zeros((6, 6)),
    np.diag([0.0, 0.0, 0.01, 0.02, 0.0, 0.0]),
    np.ones((6, 6)),
    variances(c33=1.7e308),
    variances(c33=1e12, c34=1e5 - 1.0, c43=1e5 - 1.0),
    1e-300 * np.eye(6),
]


@pytest.mark.parametrize('gains', ['constant', 'riccati'])
@pytest.mark.parametrize('covariance', WRONG)
def test_a_large_variance_hides_no_wrong_entry_beside_it(covariance, gains):
    estimator = Estimator(Settings(gains=gains, reorder_window=0.0))
    assert not estimator.add(VelocityEvent(0, np.zeros(6), covariance))
    points = np.tile(np.roll(covariance, (3, 3), (0, 1))[:3, :3], (4, 1, 1))
    if not are_covariances(points).all():
        assert not estimator.add(ObservationEvent(0, IDS, POINTS, points))
    block = VelocityBlock(np.arange(3), np.zeros((3, 6)), np.tile(covariance, (3, 1, 1)))
    assert estimator.add_velocities(block) == 0
    assert set(estimator.dropped) == {'bad_covariance'}
    with pytest.raises(ParameterError, match='pose covariance'):
        estimator.set_pose(np.eye(4), covariance)


@pytest.mark.parametrize('covariance', RIGHT)
def test_what_is_exact_or_unknown_is_taken_and_the_estimate_stays_finite(covariance):
    estimator = Estimator(Settings(reorder_window=0.0))
    estimator.set_pose(np.eye(4), covariance)
    for k in range(12):
        body_velocity = np.array([0.0, 0.0, 0.1, 0.5, 0.0, 0.0])
        assert estimator.add(VelocityEvent(k * 10**8, body_velocity, covariance))
        noise = np.tile(covariance[3:, 3:], (4, 1, 1))
        assert estimator.add(ObservationEvent(k * 10**8 + 1, IDS, POINTS, noise))
    assert np.isfinite(estimator.pose).all()
    known = estimator.pose_covariance
    assert known is None or (np.isfinite(known).all() and are_covariances(known))


def test_a_variance_of_zero_beside_other_entries_is_named(caplog):
    estimator = Estimator(Settings())
    estimator.add(VelocityEvent(0, np.zeros(6), variances(c33=0.0, c34=0.005, c43=0.005)))
    assert 'a variance of zero, which says exact, has other entries in its row' in caplog.text


@hypothesis_settings(max_examples=20)
@given(generators())
def test_covariances_that_are_turned_there_and_back_stay_covariances(rng):
    scales = 10.0 ** rng.uniform(-6.0, 3.0, size=(20, 6)) * (rng.random((20, 6)) < 0.8)
    roots = rng.normal(size=(20, 6, 6)) * scales[:, None, :]
    event = VelocityEvent(0, np.zeros(6), (roots @ roots.swapaxes(1, 2))[rng.integers(20)])
    pose = se3.pose(so3.exp(rng.normal(size=3)), rng.normal(size=3))
    there = event.moved(pose)
    back = there.moved(se3.inverse(pose))
    assert are_covariances(np.stack([there.covariance, back.covariance])).all()


def good_map(**changes):
    of_each = np.tile(0.01 * np.eye(3), (4, 1, 1))
    return replace(LandmarkMap(IDS, POINTS, of_each, np.ones(4, dtype=np.int64)), **changes)


TURNS = np.tile(np.eye(3), (4, 1, 1))


@pytest.mark.parametrize(
    ('changes', 'reason'),
    [
        ({'covariances': np.tile(1.1e12 * np.eye(3), (4, 1, 1))}, 'covariances is beyond 1e'),
        ({'covariances': np.tile(np.diag([1e9, -1, 1]), (4, 1, 1))}, 'negative eigenvalue'),
        ({'world_points': 1e200 * POINTS}, 'map points is beyond 1e'),
        ({'orientations': TURNS}, 'there is only one of them'),
        ({'orientation_sigmas': np.ones(4)}, 'there is only one of them'),
        ({'orientations': TURNS, 'orientation_sigmas': -np.ones(4)}, 'sigmas: one is negative'),
        ({'orientations': TURNS, 'orientation_sigmas': np.full(4, 1e13)}, 'sigmas is beyond 1e'),
        ({'joint_covariance': np.full((12, 12), 1e13)}, 'joint map covariance is beyond 1e'),
    ],
)
def test_a_map_from_python_has_the_limits_of_a_file(changes, reason):
    estimator = Estimator(Settings())
    with pytest.raises(MapError, match=reason):
        estimator.load_map(good_map(**changes))
    assert estimator.is_localised


@pytest.mark.parametrize('gains', ['constant', 'riccati'])
@pytest.mark.parametrize('variance_m2', [1e6, 1e12])
@pytest.mark.parametrize('pose', [None, np.eye(4)], ids=['unknown', 'given'])
def test_with_a_map_of_the_largest_numbers_a_file_may_have_all_stays_finite(
    variance_m2, pose, gains
):
    covariances = np.tile(1e-4 * np.eye(3), (4, 1, 1))
    covariances[3] = variance_m2 * np.eye(3)
    estimator = Estimator(Settings(gains=gains, reorder_window=0.0))
    estimator.load_map(good_map(covariances=covariances), pose)
    for k in range(4):
        assert estimator.add(ObservationEvent(k * 10**8, IDS, POINTS))
    np.testing.assert_allclose(estimator.pose, np.eye(4), atol=1e-6)
    known = estimator.landmark_covariances
    assert known is None or are_covariances(known).all()


def off_from_rotations(R):
    return np.abs(R.swapaxes(-1, -2) @ R - np.eye(3)).max()


@pytest.mark.parametrize('two_d_mode', [False, True])
def test_rotations_that_are_off_by_rounding_are_made_exact(two_d_mode):
    pose = se3.pose(OFF * np.eye(3), np.ones(3))
    settings = Settings(two_d_mode=two_d_mode, reorder_window=0.0, use_tag_orientation=True)
    estimator = Estimator(settings, pose)
    assert off_from_rotations(estimator.pose[:3, :3]) < 1e-14
    estimator.set_pose(pose)
    assert off_from_rotations(estimator.pose[:3, :3]) < 1e-14
    turns = OFF * np.tile(np.eye(3), (4, 1, 1))
    turns[3] = 0.0  # a point
    for k in range(3):
        estimator.add(ObservationEvent(k * 10**8, IDS, POINTS, orientations=turns))
    assert off_from_rotations(estimator.landmark_map.orientations[:3]) < 1e-14
    known = good_map(orientations=turns, orientation_sigmas=np.full(4, 0.1))
    estimator.load_map(known, pose)
    assert off_from_rotations(estimator.pose[:3, :3]) < 1e-14
    estimator.add(ObservationEvent(3 * 10**8, IDS, POINTS, orientations=turns))
    saved = estimator.landmark_map.orientations
    assert off_from_rotations(saved[:3]) < 1e-14
    assert not saved[3].any()


def test_rotations_that_are_exact_keep_their_bits():
    R = so3.exp(np.random.default_rng(0).normal(size=(50, 3)))
    np.testing.assert_array_equal(so3.exact(R), R)
    np.testing.assert_array_equal(so3.exact(R[0]), R[0])
    np.testing.assert_array_equal(so3.exact(np.zeros((2, 3, 3))), 0.0)


def cloud(m, ids, stamp_ns=0):
    points = np.random.default_rng(0).uniform(-30.0, 30.0, (m, 3))
    return ObservationEvent(stamp_ns, ids, points)


MOST = Settings().max_points


def test_of_a_large_cloud_the_nearest_in_each_direction_are_used_and_the_others_counted(caplog):
    estimator, m = Estimator(Settings(reorder_window=0.0)), 1000
    for k in range(2):
        assert estimator.add(cloud(m, np.full(m, UNKNOWN_ID), k * 10**8))
    used = estimator._state.observer.world_points
    assert len(used) == MOST
    sectors, counts = np.unique(sector(used), return_counts=True)
    assert len(sectors) == SECTORS
    assert counts.max() - counts.min() <= 1
    every = cloud(m, np.arange(m)).points
    for number in sectors:
        nearest = np.sort(np.linalg.norm(every[sector(every) == number], axis=1))
        ranges_m = np.sort(np.linalg.norm(used[sector(used) == number], axis=1))
        np.testing.assert_allclose(ranges_m, nearest[: len(ranges_m)], atol=1e-6)
    assert estimator.counts['surplus_point'] == 2 * (m - MOST)
    assert used_points(estimator.counts) == 2 * MOST
    assert '1000 points' in caplog.text
    assert 'lidar' in caplog.text


def sector(points):
    turns = np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi)
    return np.floor(SECTORS * (turns + 0.5))


def test_of_a_large_cloud_known_landmarks_are_used_first_then_points_without_id():
    estimator, m = Estimator(Settings(reorder_window=0.0)), 400
    known = np.arange(30) * 7
    estimator.add(cloud(m, np.arange(m)).select(np.isin(np.arange(m), known)))
    ids = np.arange(m)
    ids[300:320] = UNKNOWN_ID
    estimator.add(cloud(m, ids, 10**8))
    seen = estimator._state.landmarks
    assert len(seen) == 30 + (MOST - 30)
    assert (seen.counts[np.isin(seen.ids, known)] == 2).all()
    assert np.count_nonzero(seen.ids >= FIRST_AUTOMATIC_ID) == 20


def test_max_points_says_how_many_and_constant_gains_use_all():
    m = 250
    for settings, used in (
        (Settings(gains='constant'), m),
        (Settings(max_points=m), m),
        (Settings(max_points=7), 7),
    ):
        estimator = Estimator(replace(settings, reorder_window=0.0))
        estimator.add(cloud(m, np.arange(m)))
        assert len(estimator._state.landmarks) == used
        assert estimator.counts['surplus_point'] == m - used


def test_a_flood_of_points_leaves_no_more_landmarks_active_than_are_needed():
    settings = Settings(reorder_window=0.0, max_points=500, relinearization_interval=0)
    estimator, m = Estimator(settings), 300
    few = np.arange(m) < 10
    for k in range(200):
        event = cloud(m, np.arange(m), k * 10**8)
        estimator.add(event if k < 3 else event.select(few))
        if k == 3:
            assert len(estimator._state.known_errors.joint.active) == m
    assert len(estimator._state.known_errors.joint.active) <= 2 * (10 + 30)


def test_landmarks_of_a_flood_are_forgotten_five_seconds_after_it_unless_seen_again():
    estimator, m = Estimator(Settings(reorder_window=0.0, max_points=20)), 60
    kept, again = np.arange(m) < 4, np.arange(m) < 8
    for k in range(80):
        event = cloud(m, np.arange(m), k * 10**8)
        parts = {20: again, 21: again, 22: again}
        estimator.add(event if k < 3 else event.select(parts.get(k, kept)))
        if k == 2:
            flooded = estimator._state.landmarks.ids.copy()
        if k == 51:
            assert estimator.counts['forgotten_landmark'] == 0
    assert set(estimator._state.landmarks.ids) == set(np.flatnonzero(again))
    assert estimator.counts['forgotten_landmark'] == np.count_nonzero(flooded >= 8)


def test_landmarks_of_a_hall_that_is_full_of_them_stay():
    estimator, m = Estimator(Settings(reorder_window=0.0, max_points=20)), 60
    for k in range(120):
        event = cloud(m, np.arange(m), k * 10**8)
        estimator.add(event if k < 60 else event.select(np.arange(m) < 4))
    assert estimator.counts['forgotten_landmark'] == 0
    assert len(estimator._state.landmarks) >= 20


def test_an_estimate_that_settings_lead_out_of_all_bounds_starts_again_and_says_so(caplog):
    estimator = Estimator(Settings(reorder_window=0.0, max_linear_velocity=1e6))
    estimator.add(ObservationEvent(0, IDS, POINTS))
    for k in range(1200):
        estimator.add(VelocityEvent(k * 10**9, np.array([0.0, 0.0, 0.0, 1e6, 0.0, 0.0])))
    for k in range(2):
        assert estimator.add(ObservationEvent(1200 * 10**9 + k, IDS, POINTS))
    assert estimator.counts['diverged'] == 1
    assert 'The estimate has diverged: the pose is 1.2e+09 m from its origin' in caplog.text
    np.testing.assert_allclose(estimator._state.observer.world_points, POINTS)
