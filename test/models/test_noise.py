"""The noise model: physical units, gaps, covariances from messages, directions of each sensor."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
import random_runs
from strategies import generators

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.estimator.placement import make_gains
from slam_observer_ros.events import (
    AngularVelocityEvent,
    flatten,
    ObservationEvent,
    VelocityEvent,
)
from slam_observer_ros.filter.flat_arrays import Interval
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.models.held_velocities import HeldVelocities
from slam_observer_ros.models.motion_noise import MotionNoise
from slam_observer_ros.models.observation_noise import ObservationNoise
from slam_observer_ros.models.velocity_history import VelocityHistory
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.tracking.matching import match

SECOND = 1_000_000_000


def held(velocities, dt_s, gap_s=None, covariances=None):
    velocities = np.array(velocities, dtype=float)
    k = len(velocities)
    known = covariances or [None] * k
    return HeldVelocities(
        velocities,
        np.array([np.zeros((6, 6)) if c is None else c for c in known]).reshape(-1, 6, 6),
        np.array([[c is not None] * 2 for c in known], dtype=bool).reshape(-1, 2),
        np.array(dt_s, dtype=float),
        np.zeros(k) if gap_s is None else np.array(gap_s, dtype=float),
        np.zeros((k, 2)),
        np.empty(0),
        np.empty((0, 6)),
        np.full(2, np.inf),
    )


def observed(points, **settings):
    points = np.array(points, dtype=float)
    event = ObservationEvent(0, np.arange(len(points)), points)
    return ObservationNoise(Settings(**settings)).covariances(event)


def deviation(covariance, direction):
    direction = np.array(direction) / np.linalg.norm(direction)
    return np.sqrt(direction @ covariance @ direction)


@pytest.mark.parametrize('pieces', [1, 10, 1000])
def test_densities_are_the_standard_deviation_after_one_second(pieces):
    settings = Settings(
        angular_velocity_noise=(0.1, 0.2, 0.3), linear_velocity_noise=(0.4, 0.5, 0.6)
    )
    covariances = MotionNoise(settings).covariances(
        held(np.ones((pieces, 6)), np.full(pieces, 1.0 / pieces))
    )
    expected = np.diag(np.arange(1, 7) * 0.1) ** 2
    np.testing.assert_allclose(covariances.sum(axis=0), expected, atol=1e-12)


def test_scale_noise_grows_with_speed_and_is_none_at_rest():
    settings = Settings(
        angular_velocity_noise=(0.0,) * 3,
        linear_velocity_noise=(0.0,) * 3,
        angular_scale_noise=(0.0, 0.0, 0.1),
        linear_scale_noise=(0.2, 0.0, 0.0),
    )
    moving, still = MotionNoise(settings).covariances(
        held([[1.0, 1.0, -2.0, 3.0, 1.0, 1.0], np.zeros(6)], [1.0, 1.0])
    )
    np.testing.assert_allclose(np.sqrt(np.diag(moving)), [0.0, 0.0, 0.2, 0.6, 0.0, 0.0])
    np.testing.assert_array_equal(still, 0.0)


@given(generators(), st.sampled_from([10, 50, 200, 1000]))
def test_noise_of_the_messages_does_not_pass_for_speed_however_many_there_are(rng, rate_hz):
    settings = Settings(linear_velocity_noise=(0.0,) * 3, linear_scale_noise=(0.1, 0.0, 0.0))
    duration_s, k = 30.0, 30 * rate_hz
    velocities = np.zeros((k, 6))
    velocities[:, 3] = 0.5 + 0.05 * np.sqrt(rate_hz) * rng.standard_normal(k)
    total = (
        MotionNoise(settings).covariances(held(velocities, np.full(k, 1.0 / rate_hz))).sum(axis=0)
    )
    np.testing.assert_allclose(np.sqrt(total[3, 3]), 0.1 * 0.5 * np.sqrt(duration_s), rtol=0.15)


@pytest.mark.parametrize(('rate_hz', 'messages'), [(10, 1), (20, 1), (20, 2)])
def test_motions_that_noise_makes_slower_count_for_no_more_than_others(rate_hz, messages):
    """By the square of the speed they would, and a scale be found too large by a fifth."""
    noise = {'linear_velocity_noise': (0.0,) * 3, 'linear_scale_noise': (0.1, 0.0, 0.0)}
    model, history = MotionNoise(Settings(**noise)), VelocityHistory(SECOND)
    speeds = np.random.default_rng(1).normal(0.5, 0.05 * np.sqrt(rate_hz), 1500 * messages)
    period_ns = SECOND // rate_hz
    for step, speed in enumerate(speeds.tolist()):
        history.append(VelocityEvent(step * period_ns, np.array([0.0, 0.0, 0.0, speed, 0.0, 0.0])))
    stamps_ns = range(10 * period_ns, len(speeds) * period_ns, messages * period_ns)
    motions = [history.held(start_ns, end_ns) for start_ns, end_ns in pairwise(stamps_ns)]
    moved_m = np.array([held.dt_s @ held.body_velocities[:, 3] for held in motions])
    variances = np.array([model.covariances(held)[:, 3, 3].sum() for held in motions])
    weighted = moved_m / variances
    scale = np.sum(weighted * 0.5 * messages / rate_hz) / np.sum(weighted * moved_m)
    assert scale == pytest.approx(1.0, abs=0.05)


def test_speed_that_changes_within_a_long_motion_counts_as_it_changes():
    settings = Settings(angular_velocity_noise=(0.0,) * 3, angular_scale_noise=(0.0, 0.0, 0.1))
    velocities = np.zeros((40, 6))
    velocities[:20, 2], velocities[20:, 2] = 1.0, -1.0  # turns, and turns back
    total = MotionNoise(settings).covariances(held(velocities, np.full(40, 0.5))).sum(axis=0)
    np.testing.assert_allclose(np.sqrt(total[2, 2]), 0.1 * np.sqrt(20.0), rtol=0.03)


def test_a_velocity_held_for_longer_than_a_second_counts_alone():
    settings = Settings(linear_velocity_noise=(0.0,) * 3, linear_scale_noise=(0.1, 0.0, 0.0))
    velocities = np.zeros((3, 6))
    velocities[:, 3] = [1.0, -2.0, 3.0]
    covariances = MotionNoise(settings).covariances(held(velocities, [2.0, 3.0, 4.0]))
    expected = 0.01 * np.array([1.0, 4.0, 9.0]) * [2.0, 3.0, 4.0]
    np.testing.assert_allclose(covariances[:, 3, 3], expected)


def test_in_a_gap_the_robot_may_do_what_the_settings_allow():
    settings = Settings(unknown_angular_motion=0.3, unknown_linear_motion=0.7)
    covariance = MotionNoise(settings).covariances(held(np.zeros((1, 6)), [0.0], [4.0]))[0]
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), [0.6] * 3 + [1.4] * 3)


@given(generators(), st.floats(0.01, 1.0), st.floats(0.0, 1.0))
def test_a_messages_covariance_stands_for_the_settings_while_the_velocity_is_held(
    rng, dt_s, gap_s
):
    root = rng.normal(size=(6, 6))
    given_covariance = root @ root.T
    model = MotionNoise(Settings())
    stated, silent = model.covariances(
        held(rng.normal(size=(2, 6)), [dt_s, dt_s], [gap_s, 0.0], [given_covariance, None])
    )
    gap = np.diag([0.25] * 6) * gap_s
    np.testing.assert_allclose(stated, given_covariance * dt_s**2 + gap, atol=1e-12)
    np.testing.assert_allclose(np.sqrt(np.diag(silent) / dt_s), [0.03] * 3 + [0.02] * 3)


@pytest.mark.parametrize('cuts', [1, 2, 10, 1000])
def test_an_error_that_lasts_adds_up_however_often_its_motion_is_cut(cuts):
    given = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    dt_s = np.full(cuts, 2.0 / cuts)
    whole = held(np.zeros((cuts, 6)), dt_s, covariances=[given] * cuts)
    whole = replace(whole, before_s=np.repeat((np.cumsum(dt_s) - dt_s)[:, None], 2, axis=1))
    total = MotionNoise(Settings()).covariances(whole).sum(axis=0)
    np.testing.assert_allclose(total, 4.0 * given, rtol=1e-9)


def test_a_velocity_of_which_nothing_is_known_is_one_that_a_robot_may_have():
    """Odometry often states 1e6 or 1e12 for z, roll and pitch."""
    given = np.diag([1e6, 1e12, 1e-4, 1e-4, 1e-4, 1e12])
    still = held(np.zeros((1, 6)), [0.05], covariances=[given])
    (covariance,) = MotionNoise(Settings()).covariances(still)
    expected = [2.5, 2.5, 5e-4, 5e-4, 5e-4, 50.0]
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), expected)


def test_a_variance_that_rounding_left_below_zero_is_taken_for_zero():
    given = np.diag([0.01, 0.01, 0.01, 0.01, 0.01, -1e-12])
    still = held(np.zeros((1, 6)), [1.0], covariances=[given])
    (covariance,) = MotionNoise(Settings()).covariances(still)
    np.testing.assert_allclose(covariance, given, atol=1e-11)


@pytest.mark.parametrize('variance', [1e15, 1e100, np.finfo(np.float64).max])
def test_a_velocity_of_which_nothing_is_known_ends_no_estimator(variance):
    estimator = Estimator(Settings(reorder_window=0.0))
    points = np.array([[3.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 3.0], [2.0, 2.0, 1.0]])
    for step in range(20):
        known = np.full(6, 1e-4)
        known[2:5] = variance
        assert estimator.add(VelocityEvent(step * 10**8, np.zeros(6), np.diag(known)))
        assert estimator.add(ObservationEvent(step * 10**8, np.arange(4), points))
    np.testing.assert_allclose(estimator.pose, np.eye(4), atol=0.2)


def test_before_the_first_velocity_there_is_a_gap_at_the_latest_stamp_as_well():
    history, start_ns = VelocityHistory(SECOND), 2**63 - 2 * SECOND
    history.append(VelocityEvent(start_ns, np.ones(6)))
    found = history.held(start_ns - SECOND, start_ns + SECOND // 2)
    np.testing.assert_allclose([found.dt_s, found.gap_s], [[0.0, 0.5], [1.0, 0.0]])


@given(generators())
def test_the_covariance_of_a_way_is_that_of_its_pieces_composed(rng):
    settings = Settings(angular_velocity_noise=(0.01,) * 3, linear_velocity_noise=(0.02,) * 3)
    pieces, dt_s, gains = 5, 0.01, make_gains(settings, np.eye(4))
    V = rng.normal(size=(pieces, 6))
    whole = Interval(0, round(1e9 * pieces * dt_s), 0, 0, None)

    def way(V):
        return gains.effect(np.eye(4), random_runs.held(V, np.full(pieces, dt_s)), whole)

    def error(piece, w):
        moved = V.copy()
        moved[piece] += w / dt_s
        return se3.log(way(moved).A @ se3.inverse(way(V).A))

    expected = np.zeros((6, 6))
    Q = np.diag([1e-4] * 3 + [4e-4] * 3) * dt_s
    for piece in range(pieces):
        F = np.array([error(piece, 1e-6 * w) / 1e-6 for w in np.eye(6)]).T
        expected += F @ Q @ F.T
    assert np.linalg.norm(way(V).noise - expected) < 1e-3 * np.linalg.norm(expected)


def test_the_error_of_a_message_goes_on_while_none_follows():
    """As where it has a covariance; however many observations the time is cut into."""
    settings = Settings(angular_velocity_noise=(0.01,) * 3, linear_velocity_noise=(0.02,) * 3)
    density, period_s, lost_s = np.repeat([0.01, 0.02], 3), 0.05, 0.6
    stated = np.diag(density**2 / period_s)

    def grown(covariance, cuts_s):
        history = VelocityHistory(SECOND)
        for step in range(20):
            stamp_ns = round(step * period_s * SECOND)
            history.append(VelocityEvent(stamp_ns, np.zeros(6), covariance))

        def between(start_s, end_s):
            held = history.held(round(start_s * SECOND), round(end_s * SECOND))
            return MotionNoise(settings).covariances(held).sum(axis=0)

        last_s = 19 * period_s
        ends_s = last_s + np.array([0.0, *cuts_s, lost_s])
        return between(0.5 * last_s, last_s), sum(map(between, ends_s[:-1], ends_s[1:]))

    for cuts_s in ([], [period_s], [0.02, 0.3]):
        usual, lost = grown(None, cuts_s)
        np.testing.assert_allclose(np.diag(usual), density**2 * 9.5 * period_s, rtol=1e-6)
        np.testing.assert_allclose(np.diag(lost), density**2 * lost_s**2 / period_s, rtol=1e-6)
        np.testing.assert_allclose(lost, grown(stated, cuts_s)[1], rtol=1e-6, atol=1e-15)


@pytest.mark.parametrize('imu_rate_hz', [50, 200, 1000])
def test_the_error_of_lost_wheels_goes_on_beside_an_imu(imu_rate_hz):
    settings = Settings(linear_velocity_noise=(0.02,) * 3)
    history, end_ns = VelocityHistory(SECOND), 2 * SECOND
    imu = [AngularVelocityEvent(t, np.zeros(3)) for t in range(0, end_ns, SECOND // imu_rate_hz)]
    creeps = np.array([0.0, 0.0, 0.0, 1e-9, 0.0, 0.0])  # exactly zero, it would stand
    wheels = [VelocityEvent(t, creeps) for t in range(0, end_ns, SECOND // 20)]
    lost_since_ns = 12 * SECOND // 10
    kept = [event for event in wheels if event.stamp_ns <= lost_since_ns]
    for event in sorted([*kept, *imu], key=lambda event: event.stamp_ns):
        history.append(event)
    Q = MotionNoise(settings).covariances(history.held(lost_since_ns, end_ns)).sum(axis=0)
    np.testing.assert_allclose(np.diag(Q)[3:], 0.02**2 * 0.8**2 / 0.05, rtol=1e-6)
    angular = np.square(settings.angular_velocity_noise) * 0.8
    np.testing.assert_allclose(np.diag(Q)[:3], angular, rtol=1e-6)


def test_a_mean_between_two_poses_leads_to_the_second_however_far_that_is():
    settings, history = Settings(linear_velocity_noise=(0.02,) * 3), VelocityHistory(SECOND)
    for step in (0, 1, 2, 3, 4, 16, 17):
        history.append(VelocityEvent(step * SECOND // 20, np.ones(6), is_mean=True))
    Q = MotionNoise(replace(settings, linear_scale_noise=(0.0,) * 3)).covariances(
        history.held(4 * SECOND // 20, 16 * SECOND // 20)
    )
    np.testing.assert_allclose(np.diag(Q[0])[3:], 0.02**2 * 0.6)


def test_slip_goes_on_as_before_while_no_message_comes():
    none, slip = (0.0,) * 3, (0.1, 0.0, 0.0)
    settings = Settings(
        angular_velocity_noise=none,
        linear_velocity_noise=none,
        angular_scale_noise=none,
        linear_scale_noise=slip,
    )
    history = VelocityHistory(SECOND)
    for step in range(20):
        history.append(VelocityEvent(step * SECOND // 20, np.array([0, 0, 0, 2.0, 0, 0])))
    (Q,) = MotionNoise(settings).covariances(history.held(SECOND, SECOND + 6 * SECOND // 10))
    np.testing.assert_allclose(Q, np.diag([0, 0, 0, (0.1 * 2.0) ** 2 * 0.6, 0, 0]), atol=1e-15)


def test_commands_that_come_when_they_change_have_no_period():
    history = VelocityHistory(2 * SECOND)
    for time_s in (0.0, 0.05, 0.1, 1.3, 1.35, 2.4, 2.45):
        history.append(VelocityEvent(round(time_s * SECOND), np.ones(6)))
    settings = Settings(angular_scale_noise=(0.0,) * 3, linear_scale_noise=(0.0,) * 3)
    (Q,) = MotionNoise(settings).covariances(history.held(round(2.45e9), round(3.45e9)))
    expected = np.square([*settings.angular_velocity_noise, *settings.linear_velocity_noise])
    np.testing.assert_allclose(np.diag(Q), expected)


@pytest.mark.parametrize('unknown', [slice(0, 3), slice(3, 6)], ids=['angular', 'linear'])
def test_the_part_of_a_velocity_whose_covariance_is_zero_has_the_settings_noise(unknown):
    """Also where the sensor is off the base, and its turns move the base."""
    stated = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    stated[unknown] = 0.0
    sensor = se3.pose(np.eye(3), np.array([0.3, 0.1, 0.0]))
    history = VelocityHistory(10**9)
    history.append(VelocityEvent(0, np.ones(6), stated).moved(sensor))
    (Q,) = MotionNoise(Settings()).covariances(history.held(0, 10**8))
    (expected,) = MotionNoise(Settings()).covariances(held(np.ones((1, 6)), [0.1]))
    np.testing.assert_allclose(Q[unknown, unknown], expected[unknown, unknown])
    known = slice(3, 6) if unknown.start == 0 else slice(0, 3)
    np.testing.assert_allclose(Q[known, known], stated[known, known] * 0.1**2)


def test_a_point_whose_covariance_is_zero_has_the_settings_noise():
    points = np.array([[3.0, 0.0, 0.0], [0.0, 2.0, 1.0]])
    covariances = np.array([np.zeros((3, 3)), np.diag([0.1, 0.2, 0.3])])
    event = ObservationEvent(0, np.arange(2), points, covariances)
    found = ObservationNoise(Settings()).covariances(event)
    np.testing.assert_array_equal(found[0], observed(points)[0])
    np.testing.assert_allclose(found[1], covariances[1], rtol=1e-4, atol=1e-9)


def test_no_motion_has_no_covariances():
    assert MotionNoise(Settings()).covariances(held(np.empty((0, 6)), [])).shape == (0, 6, 6)


@given(generators(), st.floats(-1.0, 2.0))
def test_range_and_bearing_err_along_and_across_the_line_of_sight(rng, log_range):
    turn, range_m = so3.exp(rng.normal(size=3)), 10.0**log_range
    sight, left, up = turn.T
    covariance = observed(
        [range_m * sight], range_noise=0.3, range_scale_noise=0.1, bearing_noise=0.02
    )[0]
    along = deviation(covariance, sight)
    assert along == pytest.approx(np.hypot(0.3, 0.1 * range_m), rel=1e-3)
    for across in (left, up, left + up):
        expected = pytest.approx(0.02 * range_m, rel=1e-3, abs=1e-3)
        assert deviation(covariance, across) == expected


@given(generators(), st.floats(-1.0, 2.0))
def test_stereo_errs_with_the_square_of_the_range_in_depth(rng, log_range):
    turn, range_m = so3.exp(rng.normal(size=3)), 10.0**log_range
    sight, left, _ = turn.T
    covariance = observed(
        [range_m * sight],
        observation_model='stereo',
        focal_length=400.0,
        stereo_baseline=0.1,
        pixel_noise=2.0,
        disparity_noise=0.5,
    )[0]
    # Depth z = f b / disparity, so σ_z = z² σ_disparity / (f b).
    depth = pytest.approx(range_m**2 * 0.5 / 40.0, rel=1e-3, abs=1e-3 * range_m)
    assert deviation(covariance, sight) == depth
    across = pytest.approx(range_m * 2.0 / 400.0, rel=1e-3, abs=1e-3 * range_m**2)
    assert deviation(covariance, left) == across


def test_cartesian_noise_is_the_same_everywhere():
    covariances = observed(
        [[0, 0, 0], [1, 2, 3], [1e4, 0, 0]], observation_model='cartesian', point_noise=0.2
    )
    np.testing.assert_allclose(covariances, np.tile(0.04 * np.eye(3), (3, 1, 1)), rtol=1e-5)


def test_a_point_at_the_sensor_is_known_as_well_as_its_range():
    covariance = observed([[0.0, 0.0, 0.0]], range_noise=0.3)[0]
    np.testing.assert_allclose(covariance, 0.09 * np.eye(3), rtol=1e-5)


@pytest.mark.parametrize('model', ['range_bearing', 'stereo', 'cartesian'])
@given(rng=generators())
def test_what_counts_is_the_way_from_the_sensor_wherever_that_sits(model, rng):
    noise, sensor = (
        ObservationNoise(Settings(observation_model=model)),
        se3.exp(rng.normal(size=6)),
    )
    event = ObservationEvent(0, np.arange(4), rng.normal(scale=3.0, size=(4, 3)))
    moved, R = event.moved(sensor), sensor[:3, :3]
    np.testing.assert_allclose(
        noise.covariances(moved), R @ noise.covariances(event) @ R.T, atol=1e-9
    )
    back = moved.moved(se3.inverse(sensor))
    np.testing.assert_allclose(back.lines_of_sight, event.points, atol=1e-9)


def test_in_a_plane_a_landmark_overhead_is_as_far_away_as_it_is():
    event = ObservationEvent(0, np.arange(2), np.array([[0.1, 0.0, 3.0], [4.0, 0.0, 0.0]]))
    flat = flatten(event)
    np.testing.assert_array_equal(flat.points[:, 2], 0.0)
    noise = ObservationNoise(Settings(bearing_noise=0.02))
    np.testing.assert_allclose(noise.covariances(flat), noise.covariances(event))
    assert deviation(noise.covariances(flat)[0], [0, 1, 0]) == pytest.approx(0.06, rel=0.01)
    one = flat.select(np.array([False, True]))
    np.testing.assert_allclose(noise.covariances(one)[0], noise.covariances(flat)[1])


def test_covariances_of_messages_are_used_as_they_are():
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(5, 3, 3))
    stated = roots @ roots.swapaxes(1, 2) + 0.1 * np.eye(3)
    event = ObservationEvent(0, np.arange(5), rng.normal(size=(5, 3)), stated)
    np.testing.assert_allclose(ObservationNoise(Settings()).covariances(event), stated, rtol=1e-3)


def spread_after(range_m, **settings):
    """Standard deviations of a robot that has seen landmarks 4 m ahead, then at ``range_m``."""
    estimator = Estimator(Settings(gains='riccati', reorder_window=0.0, **settings))
    sights = np.array([[1.0, 0.0, 0.0], [0.8, 0.6, 0.0], [0.8, 0.0, 0.6]])
    for step, seen_at_m in enumerate([4.0, 4.0, 4.0, range_m]):
        stamp_ns = 10**9 + step * 10**8
        estimator.add(VelocityEvent(stamp_ns, np.zeros(6)))
        estimator.add(ObservationEvent(stamp_ns, np.arange(3), seen_at_m * sights))
    return np.sqrt(np.diag(estimator.pose_covariance))


@pytest.mark.parametrize(
    'settings',
    [
        {'range_noise': 0.1, 'range_scale_noise': 0.2, 'bearing_noise': 0.02},
        {'observation_model': 'stereo', 'focal_length': 400.0, 'stereo_baseline': 0.1},
    ],
)
def test_known_landmarks_weigh_the_same_whether_seen_too_near_or_too_far(settings):
    settings = {**settings, 'linear_velocity_noise': (0.5,) * 3, 'huber_threshold': 0.0}
    near, far = spread_after(3.7, **settings), spread_after(4.3, **settings)
    np.testing.assert_allclose(near, far, rtol=5e-3)


def test_known_landmarks_too_are_as_uncertain_as_they_are_far_from_the_sensor():
    """A sensor on a mast 8 m ahead of the base, 2 m from what it sees."""
    sensor = se3.pose(np.eye(3), np.array([8.0, 0.0, 0.0]))
    sights = np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]])
    noise = {'bearing_noise': 0.1, 'range_noise': 0.05}
    settings = Settings(reorder_window=0.0, confirmations=1, **noise)
    estimator = Estimator(settings)
    for step in range(5):
        estimator.add(VelocityEvent(step * 10**8, np.zeros(6)))
        event = ObservationEvent(step * 10**8, np.arange(3), sights).moved(sensor)
        estimator.add(event)
    expected = observed(sights, **noise)
    np.testing.assert_allclose(match(estimator._state, event).covariances, expected, rtol=0.01)


def test_the_range_that_counts_is_expected_and_the_direction_measured():
    """As a state whose heading is off by 0.2 rad sees a stereo camera's point, and 1 m too far."""
    noise = {'observation_model': 'stereo', 'stereo_baseline': 0.1}
    estimator = Estimator(Settings(reorder_window=0.0, confirmations=1, **noise))
    points = np.array([[4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 4.0]])
    estimator.add(VelocityEvent(0, np.zeros(6)))
    estimator.add(ObservationEvent(0, np.arange(3), points))
    turned = points @ so3.exp(np.array([0.0, 0.0, 0.2]))
    event = ObservationEvent(10**8, np.arange(3), 1.25 * turned)
    found = match(estimator._state, event).covariances
    np.testing.assert_allclose(found, observed(turned, **noise), rtol=1e-6, atol=1e-9)


def test_of_a_landmark_in_doubt_what_counts_is_where_it_was_measured():
    """One that is not is as uncertain as where it should be is far."""
    noise = {'bearing_noise': 0.1, 'range_noise': 0.05}
    estimator = Estimator(Settings(reorder_window=0.0, **noise))
    points = np.array([[4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 4.0]])
    for step in range(5):
        estimator.add(VelocityEvent(step * 10**8, np.zeros(6)))
        estimator.add(ObservationEvent(step * 10**8, np.arange(3), points))
    state, further = estimator._state, ObservationEvent(5 * 10**8, np.arange(3), 2.0 * points)
    expected, measured = observed(points, **noise), observed(2.0 * points, **noise)
    np.testing.assert_allclose(match(state, further).covariances, expected, rtol=0.01)
    state.landmarks.rejections[1] = state.settings.max_rejections
    found = match(state, further).covariances
    np.testing.assert_allclose(found[[0, 2]], expected[[0, 2]], rtol=0.01)
    np.testing.assert_allclose(found[1], measured[1], rtol=0.01)


def awkward_observations():
    """Points and covariances that are within the rules but leave some direction exact."""
    turned = so3.exp(np.array([0.3, 0.2, 0.5]))
    on_a_line = (turned @ np.diag([1.0, 0.0, 0.0]) @ turned.T).astype(np.float32)
    return {
        'at the sensor': ([[0.0, 0.0, 0.0], [1.0, 2.0, 0.0]], None),
        'next to the sensor': ([[1e-9, 0.0, 0.0], [1.0, 2.0, 0.0]], None),
        'straight above': ([[0.0, 0.0, 2.0], [1.0, 2.0, 0.0]], None),
        'very far': ([[1e6, 1e6, 0.0], [1.0, 2.0, 0.0]], None),
        'all unknown': ([[1.0, 0.0, 0.0], [1.0, 2.0, 0.0]], np.zeros((3, 3))),
        'all exact': ([[1.0, 0.0, 0.0], [1.0, 2.0, 0.0]], np.diag([1e-300] * 3)),
        'exact height': ([[1.0, 0.0, 0.0], [1.0, 2.0, 0.0]], np.diag([0.1, 0.1, 0.0])),
        'known but for a line': ([[1.0, 0.0, 0.0], [1.0, 2.0, 0.0]], on_a_line.astype(float)),
    }


@pytest.mark.parametrize('case', awkward_observations())
@pytest.mark.parametrize('model', ['range_bearing', 'stereo', 'cartesian'])
@pytest.mark.parametrize('two_d_mode', [False, True])
def test_no_observation_is_so_exact_that_it_ends_the_estimator(case, model, two_d_mode):
    points, covariance = awkward_observations()[case]
    settings = Settings(two_d_mode=two_d_mode, observation_model=model)
    covariances = None if covariance is None else np.tile(covariance, (2, 1, 1))
    estimator = Estimator(settings)
    for step in range(4):
        stamp_ns = 10**9 + step * 10**8
        assert estimator.add(VelocityEvent(stamp_ns, np.array([0, 0, 0.1, 0.1, 0, 0])))
        assert estimator.add(
            ObservationEvent(stamp_ns, np.arange(2), np.array(points), covariances)
        )
    estimator.flush()
    assert np.all(np.isfinite(estimator.pose))
    assert np.all(np.isfinite(estimator.world_points))


def test_distances_and_speeds_that_only_stand_for_none_are_refused():
    estimator = Estimator(Settings())
    none = float(np.finfo(np.float32).max)
    assert not estimator.add(ObservationEvent(0, np.array([1]), np.array([[none, 0.0, 0.0]])))
    assert not estimator.add(VelocityEvent(0, np.full(6, none)))
    assert estimator.dropped == {'too_large': 2}


@pytest.mark.parametrize(
    'covariance',
    [
        np.array([[1.0, 5.0, 0.0], [5.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        np.diag([1.0, 1.0, -0.1]),
    ],
)
def test_what_is_no_covariance_matrix_is_refused(covariance):
    estimator = Estimator(Settings())
    points = np.ones((1, 3))
    assert not estimator.add(ObservationEvent(0, np.array([1]), points, covariance[None]))
    six = np.kron(np.eye(2), covariance)
    assert not estimator.add(VelocityEvent(0, np.zeros(6), six))
    assert estimator.dropped == {'bad_covariance': 2}


def test_a_first_sighting_that_was_an_outlier_does_not_make_a_sensor_look_blunt():
    """Stereo errors grow with the square of the range: at 60 m anything would agree."""
    settings = Settings(observation_model='stereo', reorder_window=0.0)
    estimator = Estimator(settings)
    points = np.array([[3.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 3.0]])
    for step in range(3):
        seen = points.copy()
        if step == 0:
            seen[0] = [60.0, 0.0, 0.0]
        stamp_ns = step * 100_000_000
        estimator.add(VelocityEvent(stamp_ns, np.zeros(6)))
        estimator.add(ObservationEvent(stamp_ns, np.arange(3), seen))
    np.testing.assert_allclose(estimator.pose, np.eye(4), atol=0.01)
    np.testing.assert_allclose(estimator.world_points, points, atol=0.1)
