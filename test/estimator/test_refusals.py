"""Events, settings, poses and maps that can't be right: refused whole, counted, named."""

from __future__ import annotations

from dataclasses import replace

from estimator_runs import assert_same_state, BODY_VELOCITY, drive, GAINS, observation, START_NS
import numpy as np
from numpy.testing import assert_array_equal
import pytest

from slam_observer_ros.common.errors import MapError, ParameterError
from slam_observer_ros.common.types import FIRST_AUTOMATIC_ID, LAST_AUTOMATIC_ID
from slam_observer_ros.estimates import used_points
from slam_observer_ros.estimator.checks import MAX_MEASURED
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import (
    AngularVelocityEvent,
    IMPOSSIBLE_ID,
    ObservationEvent,
    VelocityEvent,
)
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.recordings.trajectory import PoseTruth
from slam_observer_ros.settings.estimator_settings import Settings


def bad_events():
    good = observation(5.0, [0, 1])
    stamp_ns = good.stamp_ns
    points, eyes = good.points, np.tile(np.eye(3), (2, 1, 1))
    one_is_negative, one_is_skew = eyes.copy(), eyes.copy()
    one_is_negative[1, 0, 0] = one_is_skew[1, 0, 1] = -0.5
    large_and_skew = np.diag([1.7e308] * 6)
    large_and_skew[0, 1] = 1e308
    return [
        ('negative_stamp', VelocityEvent(-1, BODY_VELOCITY)),
        ('wrong_type', VelocityEvent(stamp_ns * 1e-9, BODY_VELOCITY)),
        ('wrong_type', VelocityEvent(stamp_ns, BODY_VELOCITY.tolist())),
        ('wrong_type', ObservationEvent(stamp_ns, np.array([1.5, 2.0]), points)),
        ('wrong_type', ObservationEvent(stamp_ns, [1, 2], points)),
        ('wrong_type', ObservationEvent(stamp_ns, good.ids.astype(np.uint64), points)),
        ('wrong_type', VelocityEvent(np.uint64(stamp_ns), BODY_VELOCITY)),
        ('wrong_type', VelocityEvent(np.int32(5), BODY_VELOCITY)),
        ('wrong_type', VelocityEvent(stamp_ns, BODY_VELOCITY, receive_ns=1.5)),
        ('too_large', ObservationEvent(stamp_ns, np.array([7, 2**32 - 1]), points)),
        ('wrong_type', ObservationEvent(stamp_ns, np.ma.array(good.ids), points)),
        ('wrong_type', ObservationEvent(stamp_ns, good.ids, np.ma.array(points))),
        ('wrong_type', ObservationEvent(stamp_ns, good.ids, points.astype(np.longdouble))),
        ('wrong_type', ObservationEvent(stamp_ns, good.ids, points.astype(np.float16))),
        ('wrong_type', ObservationEvent(stamp_ns, good.ids, points.astype(np.int8))),
        ('wrong_type', None),
        ('wrong_type', PoseTruth(stamp_ns, np.eye(4))),
        ('too_large', VelocityEvent(2**70, BODY_VELOCITY)),
        ('wrong_shape', ObservationEvent(stamp_ns, np.array(1), points)),
        ('wrong_type', ObservationEvent(stamp_ns, good.ids, points.tolist())),
        ('wrong_type', ObservationEvent(stamp_ns, good.ids, None)),
        ('wrong_type', ObservationEvent(stamp_ns, good.ids, points.astype(str))),
        ('wrong_type', ObservationEvent(stamp_ns, good.ids, points.astype(object))),
        ('wrong_type', VelocityEvent(stamp_ns, BODY_VELOCITY.astype(complex))),
        ('wrong_shape', ObservationEvent(stamp_ns, good.ids, np.array(1.0))),
        ('too_large', ObservationEvent(stamp_ns, good.ids, np.full((2, 3), 2**32))),
        ('wrong_shape', VelocityEvent(stamp_ns, BODY_VELOCITY[:5])),
        ('not_finite', VelocityEvent(stamp_ns, BODY_VELOCITY * np.nan)),
        ('not_finite', VelocityEvent(stamp_ns, np.array([np.inf, 0, 0, -np.inf, 0, 0]))),
        ('bad_covariance', VelocityEvent(stamp_ns, BODY_VELOCITY, -np.eye(6))),
        ('bad_covariance', VelocityEvent(stamp_ns, BODY_VELOCITY, large_and_skew)),
        ('wrong_shape', ObservationEvent(stamp_ns, good.ids, points[:, :2])),
        ('wrong_shape', ObservationEvent(stamp_ns, good.ids[:1], points)),
        ('not_finite', ObservationEvent(stamp_ns, good.ids, points * np.inf)),
        ('negative_id', ObservationEvent(stamp_ns, np.array([7, -2]), points)),
        ('wrong_shape', ObservationEvent(stamp_ns, good.ids, points, np.ones((2, 3)))),
        ('not_finite', ObservationEvent(stamp_ns, good.ids, points, np.full((2, 3, 3), np.nan))),
        ('bad_covariance', ObservationEvent(stamp_ns, good.ids, points, covariances=-eyes)),
        ('bad_covariance', ObservationEvent(stamp_ns, good.ids, points, one_is_negative)),
        ('bad_covariance', ObservationEvent(stamp_ns, good.ids, points, one_is_skew)),
        ('wrong_shape', ObservationEvent(stamp_ns, good.ids, points, velocities=points[:1])),
        ('wrong_type', ObservationEvent(stamp_ns, good.ids, points, velocities=points.tolist())),
        ('not_finite', ObservationEvent(stamp_ns, good.ids, points, velocities=points * np.nan)),
        ('wrong_shape', ObservationEvent(stamp_ns, good.ids, points, sensor=points[0])),
        ('wrong_type', ObservationEvent(stamp_ns, good.ids, points, sensor=points.tolist())),
        ('not_finite', ObservationEvent(stamp_ns, good.ids, points, sensor=points * np.inf)),
        ('too_large', ObservationEvent(stamp_ns, good.ids, points, sensor=points * 1e7)),
        ('stamp_jump', VelocityEvent(stamp_ns + 10**12, BODY_VELOCITY)),
        ('duplicate', drive()[-2]),
        ('duplicate', drive()[-1]),
    ]


@pytest.mark.parametrize(('reason', 'event'), bad_events())
def test_a_bad_event_is_dropped_whole_counted_and_leaves_the_state_alone(reason, event):
    estimator, untouched = Estimator(Settings()), Estimator(Settings())
    for good in drive():
        assert estimator.add(good)
        untouched.add(good)
    assert not estimator.add(event)
    assert estimator.dropped == {reason: 1}
    estimator.flush()
    untouched.flush()
    assert_same_state(estimator, untouched)


@pytest.mark.parametrize('sign', [1.0, -1.0])
@pytest.mark.parametrize('dtype', [np.float64, np.float32])
def test_what_is_as_large_as_may_be_is_taken_and_what_is_larger_refused(sign, dtype):
    settings = Settings(max_linear_velocity=MAX_MEASURED, max_angular_velocity=MAX_MEASURED)
    for size, is_taken in ((MAX_MEASURED, True), (1.001 * MAX_MEASURED, False)):
        entries = np.array([0.0, sign * size, 0.0], dtype=dtype)
        estimator, ids = Estimator(settings), np.array([1])
        assert estimator.add(VelocityEvent(START_NS, np.tile(entries, 2))) == is_taken
        assert estimator.add(ObservationEvent(START_NS, ids, entries[None])) == is_taken
        velocities = entries[None] * np.ones((1, 3), dtype=dtype)
        moving = ObservationEvent(START_NS + 1, ids, np.ones((1, 3)), None, velocities)
        assert estimator.add(moving) == is_taken
        assert estimator.dropped == ({} if is_taken else {'too_large': 3})


def test_a_velocity_that_no_robot_has_is_refused_counted_and_named(caplog):
    fast, turning = np.zeros(6), np.zeros(6)
    fast[4], turning[2] = -500.0, 60.0
    estimator, untouched = Estimator(Settings()), Estimator(Settings())
    for good in drive():
        assert estimator.add(good)
        untouched.add(good)
    stamp_ns = estimator.newest_stamp_ns + 1
    assert not estimator.add(VelocityEvent(stamp_ns, fast))
    assert not estimator.add(VelocityEvent(stamp_ns, turning))
    assert not estimator.add(AngularVelocityEvent(stamp_ns, turning[:3]))
    assert estimator.dropped == {'too_fast': 3}
    assert 'a velocity of 500.0 m/s is beyond max_linear_velocity (100 m/s)' in caplog.text
    estimator.flush()
    untouched.flush()
    assert_same_state(estimator, untouched)
    settings = Settings(max_linear_velocity=600.0, max_angular_velocity=61.0)
    assert Estimator(settings).add(VelocityEvent(stamp_ns, fast + turning))


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('size', [1e155, -1e300, 1.7e308, np.inf, np.nan])
def test_numbers_that_are_too_large_are_refused_without_a_warning_of_numpy(size):
    huge, ids, points = np.full((6, 6), size), np.array([1]), np.ones((1, 3))
    skew = np.triu(huge) - np.tril(huge, -1)
    estimator = Estimator(Settings())
    for event in (
        VelocityEvent(START_NS, huge[0]),
        AngularVelocityEvent(START_NS, huge[0, :3]),
        ObservationEvent(START_NS, ids, huge[:1, :3]),
        ObservationEvent(START_NS, ids, points, None, huge[:1, :3]),
    ):
        assert not estimator.add(event)
    assert set(estimator.dropped) <= {'too_large', 'not_finite'}
    # Covariances that large say 'unknown'.
    estimator.add(VelocityEvent(START_NS, np.zeros(6), skew))
    estimator.add(ObservationEvent(START_NS, ids, points, skew[None, :3, :3]))


@pytest.mark.parametrize('gains', GAINS)
def test_points_with_ids_that_are_kept_for_others_are_left_out_counted_and_named(caplog, gains):
    estimator, without = Estimator(Settings(gains=gains)), Estimator(Settings(gains=gains))
    for step in range(5):
        event = observation(0.1 * step, [4, 0, 1, 2])
        ids = np.array([4, FIRST_AUTOMATIC_ID, LAST_AUTOMATIC_ID, LAST_AUTOMATIC_ID + 1])
        assert estimator.add(replace(event, ids=ids))
        without.add(replace(event, ids=ids[[0, 3]], points=event.points[[0, 3]]))
    estimator.flush()
    without.flush()
    assert_same_state(estimator, without)
    assert estimator.landmark_ids.tolist() == [4, LAST_AUTOMATIC_ID + 1]
    assert estimator.counts['reserved_id'] == 10
    assert used_points(estimator.counts) == 10
    assert 'points with the ids 10000000, 16777215;' in caplog.text
    assert len(caplog.records) == 1


def test_points_whose_message_has_no_possible_id_are_left_out_and_the_others_used():
    estimator = Estimator(Settings(reorder_window=0.0, confirmations=1))
    ids = np.array([7, IMPOSSIBLE_ID, 8, IMPOSSIBLE_ID])
    assert estimator.add(ObservationEvent(1, ids, np.ones((4, 3)) * np.arange(4)[:, None]))
    estimator.flush()
    assert estimator.landmark_ids.tolist() == [7, 8]
    assert estimator.counts['impossible_id'] == 2


@pytest.mark.parametrize('repeated', [[1, 1], [1, 1, 1], [1, 3, 3, 1]])
def test_points_with_one_id_are_left_out_counted_and_named(caplog, repeated):
    estimator, without = Estimator(Settings()), Estimator(Settings())
    for step in range(5):
        assert estimator.add(observation(0.1 * step, [4, *repeated, 2]))
        without.add(observation(0.1 * step, [4, 2]))
    estimator.flush()
    without.flush()
    assert_same_state(estimator, without)
    assert estimator.counts['repeated_id'] == 5 * len(repeated)
    assert used_points(estimator.counts) == 10
    named = ', '.join(str(landmark_id) for landmark_id in sorted(set(repeated)))
    assert f'several points of the ids {named} (1 so far)' in caplog.text
    assert len(caplog.records) == 1


@pytest.mark.parametrize(
    ('wrong', 'expected'),
    [
        ({'gains': 'x'}, "'gains' takes one of constant, riccati, not 'x'"),
        ({'range_noise': -1.0}, "'range_noise' takes a value"),
        ({'linear_velocity_noise': (1.0, 2.0)}, 'a list of 3 numbers'),
    ],
)
def test_settings_made_in_python_are_checked_like_those_of_a_file(wrong, expected):
    with pytest.raises(ParameterError, match=expected):
        Estimator(Settings(**wrong))
    with pytest.raises(ParameterError, match=expected):
        Estimator(Settings()).change_settings(Settings(**wrong))


def test_what_is_no_settings_is_refused():
    with pytest.raises(ParameterError, match='settings are wanted, not a dict'):
        Estimator({'gains': 'riccati'})


MIRRORED = np.diag([1.0, 1.0, -1.0, 1.0])


@pytest.mark.parametrize(
    ('pose', 'covariance'),
    [
        (np.full((4, 4), np.nan), None),
        (2.0 * np.eye(4), None),
        (MIRRORED, None),
        (np.eye(3), None),
        (np.eye(4).tolist(), None),
        (np.eye(4), -np.eye(6)),
        (np.eye(4), np.eye(3)),
    ],
    ids=['NaN', 'scaled', 'mirrored', '3 × 3', 'list', 'negative', 'small'],
)
def test_no_pose_that_can_not_be_right_is_taken(pose, covariance):
    estimator = Estimator(Settings())
    with pytest.raises(ParameterError, match='pose'):
        estimator.set_pose(pose, covariance)
    surveyed = LandmarkMap(np.arange(2), np.ones((2, 3)), None, np.zeros(2, dtype=np.int64))
    with pytest.raises(ParameterError, match='pose'):
        estimator.load_map(surveyed, pose, covariance)
    if covariance is None:
        with pytest.raises(ParameterError, match='pose'):
            Estimator(Settings(), pose)
    assert estimator.is_localised
    assert_array_equal(estimator.pose, np.eye(4))


@pytest.mark.parametrize(
    ('changes', 'reason'),
    [
        ({'world_points': np.full((2, 3), np.nan)}, 'map points is NaN'),
        ({'world_points': np.zeros((1, 3))}, r'map points: shape \(1, 3\)'),
        ({'ids': np.array([7, 7])}, 'more than once'),
        ({'ids': np.array([7.5, 8.0])}, 'map ids: integers'),
        ({'ids': np.array([7, -1])}, 'map ids: integers'),
        ({'ids': np.array([7, 2**33])}, 'map ids: integers'),
        ({'counts': np.array([1, -1])}, 'negative'),
        ({'counts': np.zeros(1, dtype=np.int64)}, 'map counts: shape'),
        ({'covariances': -np.tile(np.eye(3), (2, 1, 1))}, 'negative eigenvalue'),
    ],
)
def test_no_map_that_can_not_be_right_is_taken(changes, reason):
    good = LandmarkMap(np.arange(2), np.ones((2, 3)), None, np.zeros(2, dtype=np.int64))
    estimator = Estimator(Settings())
    with pytest.raises(MapError, match=reason):
        estimator.load_map(replace(good, **changes))
    assert estimator.is_localised
