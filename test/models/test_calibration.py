"""Scale, bias and delay of the velocity: found where looked for, left alone elsewhere."""

from __future__ import annotations

from dataclasses import replace
import math

from gain_worlds import configuration_error_m, drive, estimate, true_velocities
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from random_runs import held
from scipy.special import chdtri
from strategies import generators

from slam_observer_ros.estimates import CalibrationEstimate
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.estimator.placement import make_gains
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.filter.arrays import FilterArrays
from slam_observer_ros.filter.flat_arrays import Interval
from slam_observer_ros.lie import se3
from slam_observer_ros.lie.axes import PLANAR, SPATIAL
from slam_observer_ros.models import calibration as calibrations
from slam_observer_ros.models.calibration import (
    Calibration,
    Entry,
    MIN_DELAY_S,
    OF_VELOCITY,
)
from slam_observer_ros.models.velocity_delay import DelayEvidence
from slam_observer_ros.models.velocity_history import VelocityHistory
from slam_observer_ros.runs.health import of_calibration
from slam_observer_ros.settings.estimator_settings import MAX_DELAY_S, Settings

NO_BIAS = (0.0, 0.0, 0.0)

EVERYTHING = Settings(
    angular_scale_stddev=(0.1, 0.1, 0.1),
    linear_scale_stddev=(0.1, 0.1, 0.1),
    angular_bias_stddev=(0.01, 0.01, 0.01),
    linear_bias_stddev=(0.1, 0.1, 0.1),
    velocity_delay_stddev=0.1,
)

WHEELS = Settings(
    two_d_mode=True,
    angular_scale_stddev=(0.0, 0.0, 0.1),
    linear_scale_stddev=(0.1, 0.0, 0.0),
    angular_bias_stddev=NO_BIAS,
    velocity_delay_stddev=0.0,
    sensor_rotation_stddev=NO_BIAS,
)
WHEEL_SCALE = np.array([1.0, 1.0, 0.95, 1.05, 1.0, 1.0])

DELAY_NS = 150_000_000

GYROSCOPE = Settings(
    angular_bias_stddev=(0.05, 0.05, 0.05),
    angular_velocity_noise=(0.01,) * 3,
    velocity_delay_stddev=0.0,
)
GYROSCOPE_BIAS = np.array([0.04, -0.03, 0.05, 0.0, 0.0, 0.0])


def scale_and_bias(estimator):
    """Estimated factors (6,) and biases (6,), as they are applied to a velocity."""
    calibrated = estimator._state.calibration.apply
    once, twice = calibrated(np.array([np.ones(6), 2.0 * np.ones(6)]))
    return twice - once, 2.0 * once - twice


def deviations(estimator, count):
    """Standard deviations of the ``count`` estimated entries."""
    return np.sqrt(estimator._state.gains.calibration_variances[:count])


def with_gains(settings, gains):
    return Settings(**{**vars(settings), 'gains': gains})


@pytest.mark.parametrize('relinearization_interval', [0, 20])
def test_a_wheels_scale_is_found_as_well_as_its_covariance_says(relinearization_interval):
    settings = Settings(**{**vars(WHEELS), 'relinearization_interval': relinearization_interval})
    normalised_squared = []
    for seed in range(3):
        world = drive(settings, 60.0, seed, scale=WHEEL_SCALE)
        estimator = estimate(world, settings)
        found, bias = scale_and_bias(estimator)
        sigma = deviations(estimator, 2)
        normalised_squared.extend(((found - WHEEL_SCALE)[[2, 3]] / sigma) ** 2)
        assert np.all(sigma < 0.03)
        np.testing.assert_array_equal(np.delete(found, [2, 3]), 1.0)
        np.testing.assert_array_equal(bias, 0.0)
    assert np.sum(normalised_squared) < chdtri(len(normalised_squared), 0.003)


@pytest.mark.parametrize('seed', range(3))
def test_a_gyroscopes_bias_is_found_within_three_sigma(seed):
    world = drive(GYROSCOPE, 60.0, seed, bias=GYROSCOPE_BIAS)
    estimator = estimate(world, GYROSCOPE)
    scale, found = scale_and_bias(estimator)
    sigma = deviations(estimator, 3)
    assert np.all(np.abs(found - GYROSCOPE_BIAS)[:3] < 3.0 * sigma)
    assert np.all(sigma < 0.01)
    np.testing.assert_allclose(scale, 1.0)
    np.testing.assert_array_equal(found[3:], 0.0)


def test_a_robot_whose_wheels_stand_does_not_turn_by_a_bias():
    world = drive(GYROSCOPE, 60.0, bias=GYROSCOPE_BIAS)
    estimator = estimate(world, GYROSCOPE)
    start_ns = estimator.stamp_ns
    estimator.add(VelocityEvent(start_ns + 1, np.zeros(6)))
    estimator.flush()
    parked, variances = estimator.pose, estimator._state.gains.calibration_variances.copy()
    for n in range(1, 1000):
        estimator.add(VelocityEvent(start_ns + n * 10**8, np.zeros(6)))
    estimator.flush()
    np.testing.assert_allclose(estimator.pose, parked, atol=1e-9)
    np.testing.assert_array_equal(estimator.body_velocity, 0.0)
    np.testing.assert_array_equal(estimator._state.gains.calibration_variances, variances)


@pytest.mark.parametrize('two_d_mode', [False, True])
@pytest.mark.parametrize('relinearization_interval', [0, 20])
@pytest.mark.parametrize('delay_ns', [0, DELAY_NS])
def test_a_delay_is_found_as_well_as_its_covariance_says(
    two_d_mode, relinearization_interval, delay_ns
):
    """Where the velocity changes by far more than its noise."""
    settings = Settings(
        two_d_mode=two_d_mode,
        angular_velocity_noise=(0.005, 0.005, 0.005),
        velocity_delay_stddev=0.2,
        angular_bias_stddev=NO_BIAS,
        relinearization_interval=relinearization_interval,
    )
    normalised_squared = []
    for seed in range(3):
        estimator = estimate(drive(settings, 60.0, seed, delay_ns=delay_ns), settings)
        error_s = (estimator._state.calibration.delay_ns - delay_ns) * 1e-9
        sigma_s = deviations(estimator, 1)[0]
        normalised_squared.append((error_s / sigma_s) ** 2)
        assert sigma_s < 0.03
    assert np.sum(normalised_squared) < chdtri(len(normalised_squared), 0.003)


@pytest.mark.parametrize('two_d_mode', [False, True])
@pytest.mark.parametrize('noise', [1.0, 4.0])
@pytest.mark.parametrize('delay_ns', [0, 200_000_000])
def test_what_is_reported_of_a_delay_is_honest_where_velocities_are_noisy(
    two_d_mode, noise, delay_ns
):
    """Where the filter takes noise for change; velocities are between observations."""
    defaults, between_ns = Settings(), 17_000_000
    settings = Settings(
        two_d_mode=two_d_mode,
        angular_velocity_noise=tuple(noise * x for x in defaults.angular_velocity_noise),
        linear_velocity_noise=tuple(noise * x for x in defaults.linear_velocity_noise),
        angular_bias_stddev=NO_BIAS,
    )
    squared = []
    for seed in range(2):
        world = drive(settings, 40.0, seed, delay_ns=delay_ns + between_ns)
        (delay,) = estimate(world, settings).calibration
        squared.append(((delay.value - (delay_ns + between_ns) * 1e-9) / delay.deviation) ** 2)
    assert np.mean(squared) < 1.9**2


def test_a_late_odometry_is_named_and_no_scale_beside_it():
    """Commands, without noise, that are obeyed late."""
    late = CalibrationEstimate('velocity_delay', 0.43, 0.02, 's')
    scale = CalibrationEstimate('linear_scale_x', 0.5, 0.01, '', nominal=1.0, stated=0.03)
    (finding,) = of_calibration([scale, late])
    assert finding.text().startswith('The odometry takes effect 0.43 s late')
    assert of_calibration([scale, replace(late, value=0.09)]) == of_calibration([scale])
    assert not of_calibration([replace(late, deviation=0.15)])
    assert '0.15 s early' in of_calibration([replace(late, value=-0.15)])[0].what


def test_a_delay_that_is_made_up_for_does_no_harm():
    settings = Settings(
        two_d_mode=True,
        angular_velocity_noise=(0.0, 0.0, 0.01),
        velocity_delay_stddev=0.0,
    )
    estimating = Settings(**{**vars(settings), 'velocity_delay_stddev': 0.3})

    def mean_error_m(settings, delay_ns):
        worlds = [drive(settings, 30.0, seed, seen=2, delay_ns=delay_ns) for seed in range(4)]
        return np.mean([configuration_error_m(estimate(w, settings), w) for w in worlds])

    in_time = mean_error_m(settings, 0)
    assert mean_error_m(estimating, 2 * DELAY_NS) < 1.2 * in_time
    assert mean_error_m(settings, 2 * DELAY_NS) > 1.2 * in_time


def test_a_velocity_stamped_late_shows_as_a_negative_delay():
    """As an odometry's that is averaged over the time before its stamp."""
    settings = Settings(
        two_d_mode=True, angular_velocity_noise=(0.0, 0.0, 0.005), velocity_delay_stddev=0.2
    )
    left_alone = Settings(**{**vars(settings), 'velocity_delay_stddev': 0.0})
    errors_m, errors_left_m = [], []
    for seed in range(4):
        world = drive(settings, 60.0, seed, delay_ns=-DELAY_NS)
        estimator = estimate(world, settings)
        found_ns = estimator._state.calibration.delay_ns
        assert found_ns == pytest.approx(-DELAY_NS, rel=0.3)
        errors_m.append(configuration_error_m(estimator, world))
        errors_left_m.append(configuration_error_m(estimate(world, left_alone), world))
    assert np.mean(errors_m) < np.mean(errors_left_m)


def test_the_delay_of_velocities_stamped_too_late_does_not_stray():
    settings = Settings(
        two_d_mode=True,
        angular_velocity_noise=(0.0, 0.0, 0.005),
        velocity_delay_stddev=0.2,
        angular_bias_stddev=NO_BIAS,
        sensor_rotation_stddev=NO_BIAS,
    )
    for seed in range(4):
        estimator = estimate(drive(settings, 60.0, seed, delay_ns=-200_000_000), settings)
        found_ns = estimator._state.calibration.delay_ns
        assert found_ns == pytest.approx(-200_000_000, rel=0.15)


def test_a_delay_stays_within_what_is_made_up_for():
    calibration = Calibration(
        FilterArrays(np.eye(4)),
        Settings(velocity_delay_stddev=0.1, angular_bias_stddev=NO_BIAS),
        PLANAR,
    )
    for change_s, limit_s in ((-5.0, MIN_DELAY_S), (10.0, MAX_DELAY_S)):
        calibration.shift(np.array([change_s]))
        assert calibration.delay_ns == round(limit_s * 1e9)


def test_the_velocity_that_is_reported_is_the_one_that_moves_the_pose():
    step_ns = 10_000_000
    for settings in (WHEELS, replace(EVERYTHING, velocity_delay_stddev=0.0)):
        estimator = estimate(drive(settings, 10.0, scale=WHEEL_SCALE), settings)
        after = estimator.pose_at(estimator.stamp_ns + step_ns)
        moved = estimator.pose @ se3.exp(estimator.body_velocity * step_ns * 1e-9)
        np.testing.assert_allclose(after, moved, atol=1e-9)


@pytest.mark.parametrize('first_s', [0.0, 0.05, 0.1])
@pytest.mark.parametrize('change', [1e-3, 0.1])
def test_what_a_command_by_key_press_changes_is_no_noise_that_passes_for_a_delay(first_s, change):
    """A few motions have three of them within reach; these say little of all the others."""
    history, evidence = VelocityHistory(10**9), DelayEvidence()
    calibration = Calibration(FilterArrays(np.eye(4)), Settings(two_d_mode=True), PLANAR)
    calibration.shift(np.array([*np.zeros(calibration.of_velocity - 1), 0.3]))
    pressed_s = first_s + np.array([0.0, 0.3, 0.75, *np.arange(2.0, 20.0, 1.5)])
    speeds = 0.3 * np.where(np.arange(len(pressed_s)) % 2, 1.0 + change, 1.0)
    speeds[2:] += 0.3 * (np.arange(2, len(pressed_s)) % 2)
    commands = np.outer(speeds, [0, 0, 1, 1, 0, 0])
    pressed = [VelocityEvent(round(s * 1e9), V) for s, V in zip(pressed_s, commands, strict=True)]
    for start_ns in range(0, 20 * 10**9, 10**8):
        while pressed and pressed[0].stamp_ns <= start_ns:
            history.append(pressed.pop(0))
        evidence.add(history.flat(), calibration, np.full(6, 1e-4), start_ns, start_ns + 10**8)
    found = CalibrationEstimate('velocity_delay', 0.46, 0.02, 's', stated=0.2)
    assert evidence.corrected(found, 0.2).value == pytest.approx(0.46, abs=0.05)


def test_at_constant_velocity_nobody_can_know_the_delay():
    """Not even at the start, where no velocity is known yet."""
    settings = Settings(two_d_mode=True, velocity_delay_stddev=0.2, angular_bias_stddev=NO_BIAS)
    world = drive(settings, 5.0)
    velocity = world.events[0].body_velocity
    estimator = Estimator(settings)
    for event in world.events:
        is_velocity = isinstance(event, VelocityEvent)
        estimator.add(replace(event, body_velocity=velocity) if is_velocity else event)
    (delay,) = estimator.calibration
    assert delay.deviation == pytest.approx(0.2, rel=1e-3)


def test_a_robot_at_rest_again_is_where_its_velocities_say_whatever_their_delay():
    """As each motion begins with the velocity that the one before it ended with."""
    settings = Settings(
        angular_velocity_noise=(0.0, 0.0, 0.0),
        linear_velocity_noise=(0.0, 0.0, 0.0),
        velocity_delay_stddev=0.2,
        angular_bias_stddev=NO_BIAS,
        reorder_window=0.0,
    )
    rng = np.random.default_rng(0)
    estimator = Estimator(settings)
    for step in range(60):
        moves = 10 <= step < 50
        velocity = rng.normal(size=6) if moves else np.zeros(6)
        estimator.add(VelocityEvent(step * DELAY_NS, velocity))
        estimator.add(ObservationEvent(step * DELAY_NS, np.arange(0), np.empty((0, 3))))
        deviation = np.sqrt(np.max(np.diagonal(estimator.pose_covariance)))
        assert deviation > 0.01 or not 12 <= step < 48
    assert deviation < 1e-3  # it stands now, which is known to so much


def test_calibration_makes_the_map_better_where_the_wheels_are_off():
    def mean_error_m(settings):
        errors = []
        for seed in range(4):
            world = drive(settings, 30.0, seed, scale=WHEEL_SCALE, seen=2)
            errors.append(configuration_error_m(estimate(world, settings), world))
        return np.mean(errors)

    off = Settings(two_d_mode=True)
    assert mean_error_m(WHEELS) < mean_error_m(off)


@pytest.mark.parametrize('gains', ['constant', 'riccati'])
@pytest.mark.parametrize('two_d_mode', [False, True])
def test_without_stated_errors_nothing_is_estimated(gains, two_d_mode):
    settings = Settings(
        gains=gains,
        two_d_mode=two_d_mode,
        angular_bias_stddev=NO_BIAS,
        velocity_delay_stddev=0.0,
    )
    estimator = estimate(drive(settings, 10.0, scale=WHEEL_SCALE), settings)
    V = true_velocities(5, planar=False)
    np.testing.assert_array_equal(estimator._state.calibration.apply(V), V)
    assert estimator._state.calibration.delay_ns == 0


def rms_error_and_moved(settings, worlds):
    """Configuration error of some runs, and how many landmarks were taken to have moved."""
    runs = [(estimate(world, settings), world) for world in worlds]
    errors_m = [configuration_error_m(estimator, world) for estimator, world in runs]
    moved = sum(estimator.counts['moved_landmark'] for estimator, _ in runs)
    return np.sqrt(np.mean(np.square(errors_m))), moved


def test_a_small_yaw_bias_is_estimated_unasked():
    settings = Settings(two_d_mode=True)
    bias = np.array([0.0, 0.0, 0.001, 0.0, 0.0, 0.0])
    worlds = [drive(settings, 60.0, seed, noise=0.0, bias=bias) for seed in range(2)]
    error_m, moved = rms_error_and_moved(settings, worlds)
    left_alone = replace(settings, angular_bias_stddev=NO_BIAS)
    assert error_m < 0.5 * rms_error_and_moved(left_alone, worlds)[0]
    assert moved == 0


def test_a_precise_robot_does_not_take_its_yaw_bias_for_moved_landmarks():
    settings = Settings(
        two_d_mode=True,
        angular_velocity_noise=(0.001, 0.001, 0.001),
        linear_velocity_noise=(0.005, 0.005, 0.005),
        range_noise=0.02,
        bearing_noise=0.005,
    )
    bias = np.array([0.0, 0.0, 0.005, 0.0, 0.0, 0.0])
    worlds = [drive(settings, 60.0, seed, seen=2, bias=bias) for seed in range(2)]
    error_m, moved = rms_error_and_moved(settings, worlds)
    left_alone = replace(settings, angular_bias_stddev=NO_BIAS)
    error_left_m, moved_left = rms_error_and_moved(left_alone, worlds)
    assert error_m < 0.25 * error_left_m
    assert moved == 0 < moved_left


@pytest.mark.parametrize('two_d_mode', [False, True])
def test_where_there_is_no_bias_estimating_it_costs_next_to_nothing(two_d_mode):
    settings = Settings(two_d_mode=two_d_mode)
    worlds = [drive(settings, 60.0, seed) for seed in range(3)]
    error_m, moved = rms_error_and_moved(settings, worlds)
    left_alone = replace(settings, angular_bias_stddev=NO_BIAS)
    assert error_m < 1.01 * rms_error_and_moved(left_alone, worlds)[0]
    assert moved == 0


def test_constant_gains_estimate_none_of_them():
    for settings in (Settings(), EVERYTHING):
        estimator = estimate(drive(settings, 10.0), with_gains(settings, 'constant'))
        assert estimator.calibration == []


@pytest.mark.parametrize(('axes', 'count'), [(SPATIAL, 3), (PLANAR, 1)])
def test_a_bias_of_the_angular_velocity_and_a_delay_are_estimated_unasked(axes, count):
    calibration = Calibration(FilterArrays(np.eye(4)), Settings(), axes)
    names = [part.name for part in calibration.estimates(np.ones(count + 1))]
    assert names == [*(f'angular_bias_{axis}' for axis in 'xyz'[3 - count :]), 'velocity_delay']


@pytest.mark.parametrize(('axes', 'count'), [(SPATIAL, 13), (PLANAR, 7)])
def test_only_axes_of_the_motion_are_calibrated(axes, count):
    calibration = Calibration(FilterArrays(np.eye(4)), EVERYTHING, axes)
    assert calibration.count == count
    calibration.shift(np.full(count, 0.5))
    fixed = np.delete(np.arange(6), axes.pose)
    V = np.ones((1, 6))
    np.testing.assert_array_equal(calibration.apply(V)[0, fixed], 1.0)
    np.testing.assert_array_equal(calibration.apply(V)[0, axes.pose], 2.0)


@given(generators(), st.booleans())
def test_sensitivity_is_the_derivative_of_the_motion(rng, two_d_mode):
    gains = make_gains(replace(EVERYTHING, two_d_mode=two_d_mode), np.eye(4))
    pieces, dt_s = 5, 0.01
    calibration, axes = gains.calibration, gains.axes
    V = np.zeros((pieces, 6))
    V[:, axes.pose] = rng.normal(size=(pieces, axes.p))
    start = se3.exp(axes.full_pose(rng.normal(size=axes.p)))
    velocities, end_ns = held(V, np.full(pieces, dt_s)), round(1e9 * pieces * dt_s)

    def moved(change):
        calibration.shift(change)
        interval = Interval(0, end_ns, calibration.delay_ns, 1000, V[0])
        found = gains.effect(start, velocities, interval)
        calibration.shift(-change)
        return found

    nominal, h = moved(np.zeros(calibration.count)), 1e-6
    for column, unit in enumerate(np.eye(calibration.count)):
        error = se3.log(moved(h * unit).A @ se3.inverse(nominal.A))[axes.pose] / h
        found = nominal.sensitivity[:, column]
        np.testing.assert_allclose(found, error, atol=1e-3 * dt_s * pieces)


@pytest.mark.parametrize('two_d_mode', [False, True])
def test_one_more_state_of_velocities_takes_two_parameters_and_a_row(monkeypatch, two_d_mode):
    sideways, turning = 4, 2
    row = Entry('side_slip', 'side_slip', None, 7 * sideways + turning, 'm/rad')
    with_row = (*OF_VELOCITY[:-1], row, OF_VELOCITY[-1])
    monkeypatch.setattr(calibrations, 'OF_VELOCITY', with_row)
    monkeypatch.setattr(Settings, 'side_slip', 0.0, raising=False)
    monkeypatch.setattr(Settings, 'side_slip_stddev', 0.2, raising=False)
    settings = Settings(two_d_mode=two_d_mode, reorder_window=0.0)
    slips = np.zeros((600, 6))
    slips[:, sideways] = 0.1 * true_velocities(600, two_d_mode)[:, turning]
    estimator = estimate(drive(settings, 30.0, bias=slips), settings)
    (found,) = (part for part in estimator.calibration if part.name == 'side_slip')
    assert found.unit == 'm/rad' and found.stated == 0.2
    assert found.deviation < 0.05
    assert abs(found.value - 0.1) < 3.0 * found.deviation


def test_drift_lets_the_uncertainty_grow_with_time():
    settings = Settings(
        angular_bias_stddev=(0.0, 0.0, 0.02),
        linear_scale_stddev=(0.1, 0.0, 0.0),
        velocity_delay_stddev=0.0,
        calibration_drift=0.5,
    )
    gains = make_gains(settings, np.eye(4))
    still = held(np.zeros((4, 6)), np.ones(4))
    still = still._replace(timeout_ns=10**9 // 2)  # half of the time none is known
    gains.advance(still, Interval(0, 4 * 10**9, 0, 0, None))
    # Four seconds at half the initial standard deviation per √s: σ² (1 + 4 · 0.25).
    found = np.diag(gains.joint.P)[6:]
    np.testing.assert_allclose(found, np.array([0.1, 0.02]) ** 2 * 2.0)


def test_a_bias_that_drifts_is_followed():
    settings = Settings(**{**vars(GYROSCOPE), 'calibration_drift': 0.3})
    ramp = np.linspace(0.0, 1.0, round(60.0 / 0.05))[:, None] * GYROSCOPE_BIAS
    world = drive(settings, 60.0, bias=ramp)
    _, found = scale_and_bias(estimate(world, settings))
    np.testing.assert_allclose(found[:3], GYROSCOPE_BIAS[:3], atol=0.02)


def test_relinearising_does_not_undo_that_a_scale_has_changed():
    settings = Settings(
        two_d_mode=True,
        linear_scale_stddev=(0.1, 0.0, 0.0),
        calibration_drift=0.2,
        relinearization_interval=10,
        relinearization_angle=0.0,
    )
    scale = np.where(np.arange(1200) < 600, 1.0, 1.15)[:, None]
    world = drive(settings, 60.0, scale=scale)
    np.testing.assert_allclose(scale_and_bias(estimate(world, settings))[0][3], 1.15, atol=0.03)


def test_what_did_not_come_of_velocities_says_nothing_of_their_delay():
    """As a robot that is carried; though its velocity has a bias, which is no motion either."""
    gains = make_gains(EVERYTHING, np.eye(4))
    gains.calibration.shift(np.full(gains.calibration.count, 0.1))
    there = se3.exp(np.array([0.0, 0.0, 0.8, 2.0, 0.0, 0.0]))
    assert not gains.slip(there, np.zeros((6, 6))).sensitivity.any()
    np.testing.assert_array_equal(gains.observer.A, there)


@pytest.mark.parametrize(
    ('deviation', 'expected'),
    [
        (0.0123, '0.012 ± 0.012 m/s'),
        (0.000158, '0.01235 ± 0.00016 m/s'),
        (0.0, '0.012 ± 0.000 m/s'),
        (math.nan, '0.012 ± nan m/s'),
        (math.inf, '0.012 ± inf m/s'),
        (1e-30, '0.012345000 ± 0.000000000 m/s'),
    ],
)
def test_an_estimate_is_written_as_far_as_it_is_known(deviation, expected):
    assert str(CalibrationEstimate('linear_bias_x', 0.012345, deviation, 'm/s')) == expected


def test_angles_are_written_in_degrees():
    bias = CalibrationEstimate('angular_bias_x', np.radians(0.5), np.radians(0.25), 'rad/s')
    assert str(bias) == '0.500 ± 0.250 °/s'


def test_a_calibration_that_nobody_can_mean_is_reported():
    """Yaw rates with the wrong sign, for which the scale makes up; real wheels are not."""
    wrong = drive(WHEELS, 60.0, scale=np.array([1.0, 1.0, -1.0, 1.0, 1.0, 1.0]))
    (finding,) = of_calibration(estimate(wrong, WHEELS).calibration)
    assert finding.text().startswith('angular_scale_z is -')
    assert 'times its stated error (0.1) from 1: are signs' in finding.text()
    right = estimate(drive(WHEELS, 60.0, scale=WHEEL_SCALE), WHEELS)
    assert not of_calibration(right.calibration)


def test_a_bias_that_may_drift_is_plausible_wherever_it_is():
    drifts = replace(GYROSCOPE, angular_bias_stddev=(0.002,) * 3, calibration_drift=1.0)
    estimator = estimate(drive(drifts, 60.0, bias=5.0 * GYROSCOPE_BIAS), drifts)
    assert not of_calibration(estimator.calibration)


@pytest.mark.parametrize('gains', ['constant', 'riccati'])
def test_what_is_stated_of_the_velocity_is_used(gains):
    scale, bias = np.array([1.1, 0.9, 1.05, 0.95, 1.02, 0.97]), np.full(6, 0.01)
    stated = Settings(
        gains=gains,
        angular_scale=tuple(scale[:3]),
        linear_scale=tuple(scale[3:]),
        angular_bias=tuple(bias[:3]),
        linear_bias=tuple(bias[3:]),
        velocity_delay=0.15,
        angular_bias_stddev=NO_BIAS,
        velocity_delay_stddev=0.0,
    )
    world = drive(stated, 10.0, noise=0.0, scale=scale, bias=bias, delay_ns=DELAY_NS)
    estimator = estimate(world, stated)
    assert estimator.calibration == []
    assert configuration_error_m(estimator, world) < 1e-6


def test_estimates_begin_at_what_is_stated_of_the_velocity():
    stated = replace(
        WHEELS, linear_scale=(1.05, 1.0, 1.0), velocity_delay=0.15, velocity_delay_stddev=0.05
    )
    world = drive(stated, 40.0, scale=WHEEL_SCALE, delay_ns=DELAY_NS)
    estimator = estimate(world, stated)
    found = {part.name: part for part in estimator.calibration}
    assert found['linear_scale_x'].nominal == 1.05
    assert abs(found['linear_scale_x'].value - 1.05) < 3.5 * found['linear_scale_x'].deviation
    assert abs(found['velocity_delay'].value - 0.15) < 3.5 * found['velocity_delay'].deviation
    assert of_calibration(estimator.calibration) == []  # a late odometry is made up for


def test_smoothing_knows_what_a_calibration_leaves_open():
    """A filter alone takes a common scale for known: it has linearised at several ones."""
    open_ = {'range_scale_stddev': 0.1, 'linear_scale_stddev': (0.1, 0.0, 0.0)}
    settings = replace(WHEELS, angular_scale_stddev=NO_BIAS, smoothing_window=0, **open_)
    smoothed = estimate(drive(settings, 20.0), settings).smooth()
    parts = {part.name: part for part in smoothed.calibration}
    np.testing.assert_allclose(np.diagonal(smoothed.calibration_correlations), 1.0)
    # Each of them is known no better than both together, and a map is as large as either says.
    for name in ('linear_scale_x', 'range_scale'):
        assert parts[name].deviation > 0.9 * 0.1 / math.sqrt(2.0)
        assert abs(parts[name].value - 1.0) < 3.0 * parts[name].deviation
    row, column = (list(parts).index(name) for name in ('linear_scale_x', 'range_scale'))
    assert smoothed.calibration_correlations[row, column] > 0.95
