"""A sensor's mounting and range scale: found where looked for, and what comes of it."""

from __future__ import annotations

from dataclasses import replace
import math

from gain_worlds import configuration_error_m, drive, estimate
from hypothesis import given
import numpy as np
import pytest
from strategies import generators

from slam_observer_ros.estimates import CalibrationEstimate
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID
from slam_observer_ros.filter.arrays import FilterArrays
from slam_observer_ros.filter.riccati.active_landmarks import BlockSize
from slam_observer_ros.filter.riccati.riccati import RiccatiGains
from slam_observer_ros.lie import so3
from slam_observer_ros.lie.axes import axes_of
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.models import calibration as calibrations
from slam_observer_ros.models import sensing
from slam_observer_ros.models.calibration import Calibration
from slam_observer_ros.runs.health import of_mounting
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.tracking.matching import match

NONE = (0.0, 0.0, 0.0)
TURNED = np.array([0.02, -0.03, 0.035])
SHIFTED = np.array([0.03, -0.02, 0.01])
LONGER = 1.02

EVERYTHING = Settings(
    sensor_rotation_stddev=(0.03, 0.03, 0.03),
    sensor_translation_stddev=(0.03, 0.03, 0.03),
    range_scale=1.01,
    range_scale_stddev=0.02,
    angular_bias_stddev=NONE,
    velocity_delay_stddev=0.0,
    angular_velocity_noise=(0.003,) * 3,
    linear_velocity_noise=(0.003,) * 3,
    range_noise=0.02,
    bearing_noise=0.005,
)
PLANE = replace(EVERYTHING, two_d_mode=True)
both = pytest.mark.parametrize('settings', [EVERYTHING, PLANE], ids=['space', 'plane'])


def erring(world, settings, turned=TURNED, shifted=SHIFTED, longer=LONGER, **where):
    """Return a run whose sensor errs: y = d + exp(ψ) ρ y_m, planar with ``two_d_mode``."""
    planar = np.array([0.0, 0.0, 1.0]) if settings.two_d_mode else np.ones(3)
    flat = np.array([1.0, 1.0, 0.0]) if settings.two_d_mode else np.ones(3)
    R = so3.exp(planar * turned)

    def shown(_, event):
        return replace(event, points=(event.points - flat * shifted) @ R / longer, **where)

    return world.with_observations(shown)


def calibrated(settings):
    calibration = Calibration(
        FilterArrays(np.eye(4)),
        replace(settings, angular_bias_stddev=NONE, velocity_delay_stddev=0.0),
        axes_of(settings.two_d_mode),
    )
    calibration.add('')
    return calibration


def observation(rng, m=5, **changes):
    points = rng.uniform([1.0, -1.0, -1.0], [5.0, 1.0, 1.0], (m, 3))
    return ObservationEvent(1, np.arange(m), points, **changes)


@both
@pytest.mark.parametrize('is_depth', [False, True])
@given(rng=generators())
def test_derivatives_of_a_corrected_point_are_those_of_differences(settings, is_depth, rng):
    settings = replace(settings, range_is_depth=is_depth, range_bias_stddev=0.2)
    calibration, anchors = calibrated(settings), np.array([-1, 7, -1, 4, 7])
    for anchor in calibration.new_anchors(anchors):
        calibration.add(anchor)
    calibration.shift(0.1 * rng.normal(size=calibration.count))
    event = observation(rng, sensor=np.tile([0.3, 0.1, 0.5], (5, 1)))
    seen, h = sensing.calibrated(calibration, settings, event, anchors), 1e-6
    D = sensing.point_sensitivity(calibration, seen, seen.points)
    for column, unit in enumerate(np.eye(calibration.count)):
        calibration.shift(h * unit)
        after = sensing.calibrated_again(calibration, seen).points
        calibration.shift(-2.0 * h * unit)
        differences = (after - sensing.calibrated_again(calibration, seen).points) / (2.0 * h)
        calibration.shift(h * unit)
        k = 2 if settings.two_d_mode else 3
        np.testing.assert_allclose(D[:, :k, column], differences[:, :k], atol=1e-8)


@both
def test_derivatives_of_residuals_are_those_of_differences(settings):
    estimator = estimate(drive(settings, 5.0), replace(settings, relinearization_interval=0))
    state, event = estimator._state, drive(settings, 6.0, noise=0.0).observations()[-1]
    state.set_pose(drive(settings, 6.0).poses[-1], None)
    calibration, h = state.calibration, 1e-6

    def residuals(change):
        state_off = state.copy()
        state_off.calibration.shift(change)
        return match(state_off, event).residuals

    # At the points that are predicted, which those seen are near.
    D = residuals(np.zeros(calibration.count)).D
    for column, unit in enumerate(np.eye(calibration.count)):
        differences = (residuals(h * unit).r - residuals(-h * unit).r) / (2.0 * h)
        k = state.axes.point
        np.testing.assert_allclose(D[:, :k, column], differences[:, :k], atol=0.15)


@given(rng=generators())
def test_a_depth_becomes_the_range_that_it_is_of(rng):
    settings = Settings(range_is_depth=True, range_scale=1.1, sensor_rotation_stddev=NONE)
    truth = rng.uniform([1.0, -2.0, -1.0], [5.0, 2.0, 1.0], (6, 3))
    for axis in (None, np.array([0.0, -1.0, 0.0])):
        points = truth if axis is None else truth @ so3.exp(np.array([0.0, 0.0, math.pi / 2]))
        along = points[:, 0] if axis is None else -points[:, 1]
        ranges = np.linalg.norm(points, axis=1)
        shown = points * (along / ranges / 1.1)[:, None]
        event = ObservationEvent(1, np.arange(6), shown, sensor_axis=axis)
        seen = sensing.calibrated(calibrated(settings), settings, event)
        np.testing.assert_allclose(seen.points, points, atol=1e-12)


@given(rng=generators())
def test_what_a_message_states_turns_and_grows_with_the_point(rng):
    settings = Settings(range_scale=1.5, sensor_rotation_stddev=(0.1, 0.1, 0.1))
    calibration = calibrated(settings)
    calibration.shift(np.array([0.0, 0.0, 0.0, 0.0, 0.0, math.pi / 2])[-calibration.count :])
    own = np.diag([0.04, 0.01, 0.01])
    event = observation(rng, covariances=np.tile(own, (5, 1, 1)), velocities=np.eye(3)[[0] * 5])
    seen = sensing.calibrated(calibration, settings, event)
    expected = 1.5**2 * np.diag([0.01, 0.04, 0.01])
    np.testing.assert_allclose(seen.covariances[0], expected, atol=1e-12)
    np.testing.assert_allclose(seen.velocities[0], [0.0, 1.0, 0.0], atol=1e-12)


@both
@pytest.mark.parametrize('relinearization_interval', [0, 20])
def test_what_is_off_is_found_within_its_uncertainty(settings, relinearization_interval):
    settings = replace(settings, relinearization_interval=relinearization_interval)
    world = erring(drive(settings, 40.0, landmarks=20), settings)
    estimator, plain = (
        estimate(world, changed) for changed in (settings, replace(settings, **WITHOUT_ESTIMATES))
    )
    truth = dict(
        zip(
            (entry.name for entry in calibrations.OF_SENSOR),
            [*TURNED, *SHIFTED, LONGER],
            strict=True,
        )
    )
    for part in estimator.calibration:
        assert abs(part.value - truth[part.name]) < 3.5 * part.deviation
        assert part.deviation < part.stated
    assert configuration_error_m(estimator, world) < 0.5 * configuration_error_m(plain, world)


WITHOUT_ESTIMATES = {
    'sensor_rotation_stddev': NONE,
    'sensor_translation_stddev': NONE,
    'range_scale_stddev': 0.0,
}


def range_scales(seeds):
    """Return by how many standard deviations the range scale found is off, in noisy runs."""
    settings = Settings(
        two_d_mode=True,
        sensor_rotation_stddev=NONE,
        range_scale_stddev=0.05,
        range_noise=0.1,
        angular_bias_stddev=NONE,
        velocity_delay_stddev=0.0,
        relinearization_interval=0,
    )
    off = []
    for seed in range(seeds):
        (scale,) = estimate(drive(settings, 20.0, seed), settings).calibration
        off.append((scale.value - 1.0) / scale.deviation)
    return np.array(off)


def test_the_range_scale_is_not_biased_by_noise():
    """Were D taken at the point measured, noise would meet noise, and the scale run away."""
    off = range_scales(20)
    assert abs(np.mean(off)) < 3.0 / math.sqrt(20)


@both
def test_each_sensor_frame_has_a_calibration_of_its_own(settings):
    world = drive(settings, 40.0, landmarks=20)
    left = erring(world, settings, sensor_frame='left').observations()
    right = erring(world, settings, -TURNED, sensor_frame='right').observations()
    mixed = world.with_observations(lambda k, _: left[k] if k % 2 or k < 40 else right[k])
    estimator = estimate(mixed, settings)
    found = {part.name: part for part in estimator.calibration}
    for frame, turned in (('left', TURNED), ('right', -TURNED)):
        yaw = found[f'sensor_rotation_z/{frame}']
        assert abs(yaw.value - turned[2]) < 3.5 * yaw.deviation
        assert yaw.deviation < 0.5 * yaw.stated
    assert estimator.smooth().ids.size == len(estimator.landmark_ids)


@both
def test_where_all_is_linear_relinearising_changes_nothing(settings):
    exact = replace(
        settings,
        sensor_rotation_stddev=(3e-4,) * 3,
        sensor_translation_stddev=(3e-4,) * 3,
        range_scale=1.0,
        range_scale_stddev=3e-4,
        angular_velocity_noise=(1e-4,) * 3,
        linear_velocity_noise=(7e-5,) * 3,
        range_noise=3e-4,
        bearing_noise=1e-4,
        huber_threshold=0.0,
        relinearization_interval=0,
    )
    world = erring(drive(exact, 20.0), exact, 0.01 * TURNED, 0.01 * SHIFTED, 1.0002)
    plain = estimate(world, exact)
    often = estimate(world, replace(exact, relinearization_interval=4, relinearization_angle=0.0))
    sigma_m = np.sqrt(plain.pose_covariance.diagonal()[3:].max())
    np.testing.assert_allclose(often.pose, plain.pose, atol=0.05 * sigma_m)
    np.testing.assert_allclose(often.world_points, plain.world_points, atol=0.1 * sigma_m)
    for before, after in zip(plain.calibration, often.calibration, strict=True):
        assert abs(after.value - before.value) < 0.1 * before.deviation
        assert after.deviation == pytest.approx(before.deviation, rel=0.03)


@both
@pytest.mark.parametrize('drift', [0.0, 0.02])
def test_relinearising_and_smoothing_come_to_the_same(settings, drift):
    settings = replace(
        settings,
        calibration_drift=drift,
        relinearization_interval=5,
        relinearization_angle=0.0,
        huber_threshold=0.0,
    )
    world = erring(drive(settings, 20.0), settings)
    estimator = estimate(world, settings)
    deviations_m = np.sqrt(np.trace(estimator.landmark_covariances, axis1=1, axis2=2))
    shifts = estimator.world_points - estimator.smooth().world_points
    assert np.all(np.linalg.norm(shifts, axis=1) < 0.3 * deviations_m)


def test_other_gains_use_what_is_stated_and_estimate_none_of_it():
    settings = replace(PLANE, gains='constant', range_scale=LONGER)
    world = drive(settings, 10.0, noise=0.0)
    shown = world.with_observations(lambda _, event: replace(event, points=event.points / LONGER))
    estimator = estimate(shown, settings)
    assert estimator.calibration == []
    assert configuration_error_m(estimator, world) < 1e-6


@both
def test_in_a_large_map_it_is_found_as_in_a_small_one(settings, monkeypatch):
    settings = replace(settings, relinearization_interval=0)
    world = erring(drive(settings, 30.0, landmarks=30), settings)
    dense = estimate(world, settings)
    monkeypatch.setattr(RiccatiGains, 'block', BlockSize(dense=10, most=10, kept=4))
    compressed = estimate(world, settings)
    assert not compressed._state.errors.joint.is_dense
    for before, after in zip(dense.calibration, compressed.calibration, strict=True):
        assert abs(after.value - before.value) < 0.05 * before.deviation
        assert after.deviation == pytest.approx(before.deviation, rel=0.01)


@both
@pytest.mark.parametrize('mode', ['uncertain', 'fixed'])
def test_in_a_surveyed_map_it_is_found_fast(settings, mode):
    settings = replace(settings, localization_mode=mode)
    world = erring(drive(settings, 20.0, landmarks=20), settings)
    estimator = Estimator(settings)
    ids = np.arange(len(world.world_points))
    covariances = np.tile(1e-6 * np.eye(3), (len(ids), 1, 1))
    counts = np.full(len(ids), 10)
    surveyed = LandmarkMap(ids, world.world_points, covariances, counts)
    estimator.load_map(surveyed, world.poses[0])
    for event in world.events:
        estimator.add(event)
    estimator.flush()
    truth = dict(
        zip(
            (entry.name for entry in calibrations.OF_SENSOR),
            [*TURNED, *SHIFTED, LONGER],
            strict=True,
        )
    )
    for part in estimator.calibration:
        assert abs(part.value - truth[part.name]) < 3.5 * part.deviation
        assert part.deviation < 0.25 * part.stated


def test_points_without_ids_are_matched_where_a_calibrated_sensor_has_them():
    settings = replace(PLANE, range_is_depth=True, range_scale=LONGER, confirmations=2)
    world = drive(settings, 30.0, landmarks=8)

    def shown(_, event):
        along = event.points[:, :1] / np.linalg.norm(event.points, axis=1, keepdims=True)
        is_ahead = along[:, 0] > 0.3
        points = (event.points * along / LONGER)[is_ahead]
        return replace(event, points=points, ids=np.full(len(points), UNKNOWN_ID))

    estimator = estimate(world.with_observations(shown), settings)
    assert len(estimator.landmark_ids) <= 8


@pytest.mark.parametrize(
    ('name', 'value', 'text'),
    [
        ('sensor_rotation_z/camera', 0.0349, 'camera is mounted 2 ± 0.57 ° further to the left'),
        ('sensor_rotation_y', -0.0349, 'the sensor is mounted 2 ± 0.57 ° further up than'),
        (
            'sensor_translation_x',
            -0.05,
            'is mounted 0.05 ± 0.01 m further back than /tf',
        ),
        ('range_scale', 0.95, 'multiplied by 0.950 ± 0.010: set range_scale: 0.9500'),
        ('sensor_rotation_z', 0.02, ''),
        ('linear_scale_x', 1.5, ''),
    ],
)
def test_what_was_found_is_said_as_what_to_set(name, value, text):
    part = CalibrationEstimate(
        name, value, 0.01, UNITS[name.split('/')[0]], float('scale' in name), 0.035
    )
    said = ''.join(finding.text() for finding in of_mounting([part]))
    assert said == text or text in said != ''


UNITS = {entry.name: entry.unit for entry in calibrations.OF_SENSOR} | {'linear_scale_x': ''}
