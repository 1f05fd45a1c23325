"""Calibrating: what is off is found within its σ, and no more is claimed than was seen."""

from __future__ import annotations

from dataclasses import replace
import math

from gain_worlds import drive
import numpy as np
import pytest
import yaml

from slam_observer_ros.cli.calibrate import state_found, trades
from slam_observer_ros.estimates import CalibrationEstimate
from slam_observer_ros.events import VelocityEvent
from slam_observer_ros.lie import so3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.mapping.map_file import write_map
from slam_observer_ros.recordings.writer import RecordingWriter
from slam_observer_ros.runs.calibration import driven, Found, opened
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import InputSettings

MODEL = {
    'two_d_mode': True,
    'observation_model': 'cartesian',
    'point_noise': 0.02,
    'angular_velocity_noise': (0.005,) * 3,
    'linear_velocity_noise': (0.005,) * 3,
}
OPTIONS = [
    word
    for name, value in MODEL.items()
    for word in ('--set', f'{name}={list(value) if isinstance(value, tuple) else value!s}')
]
TURNED_RAD, SHIFTED_M, LONGER, LATE_S = math.radians(2.0), 0.03, 1.02, 0.2
SURVEYED_M = 1e-3


def recorded(path, world):
    """Write a run as a recording, and its landmarks as a surveyed map; return both paths."""
    with RecordingWriter(path) as writer:
        for event in world.events:
            writer.write_event(event)
    n, survey = len(world.world_points), path.with_suffix('.yaml')
    covariances = np.tile(SURVEYED_M**2 * np.eye(3), (n, 1, 1))
    surveyed = LandmarkMap(np.arange(n), world.world_points, covariances, np.full(n, 10))
    write_map(survey, surveyed, None)
    return path, survey


def askew(world):
    """Return a run whose sensor is mounted askew, and shows ranges that are too short."""
    R, shift = so3.exp(np.array([0.0, 0.0, TURNED_RAD])), SHIFTED_M * np.array([1.0, -1.0, 0.0])

    def shown(_, event):
        return replace(event, points=(event.points - shift) @ R / LONGER)

    return world.with_observations(shown)


@pytest.mark.timeout(300)
def test_all_that_is_off_is_found_in_a_surveyed_map(slam_observer, tmp_path):
    world = drive(Settings(**MODEL), 45.0, delay_ns=round(LATE_S * 1e9))
    recording, survey = recorded(tmp_path / 'run.mcap', askew(world))
    out = tmp_path / 'calibrated.yaml'
    words = ('--map', survey, *OPTIONS, '-o', out, '--json')
    found = slam_observer.succeed('calibrate', recording, *words).json
    parts = found['calibration']
    for name, true in {
        'sensor_rotation_z': TURNED_RAD,
        'sensor_translation_x': SHIFTED_M,
        'sensor_translation_y': -SHIFTED_M,
        'range_scale': LONGER,
        'velocity_delay': LATE_S,
    }.items():
        part = parts[name]
        assert abs(part['value'] - true) < 3.5 * part['deviation'], name
        assert part['deviation'] < 0.35 * abs(true - part['nominal']), name
        assert part['is_off'], name
    assert not parts['linear_scale_x']['is_off']
    assert found['held_out']['objection'] == ''
    assert found['log_likelihood_gain'][0] > 3.0 * found['log_likelihood_gain'][1]
    # The file says where each value is from, and a replay with it has nothing left to say.
    text = out.read_text()
    assert '# range_scale: 1.0' in text
    assert recording.name in text
    written = yaml.safe_load(text)['/**']['ros__parameters']
    assert written['point_noise'] == pytest.approx(MODEL['point_noise'], rel=0.4)
    assert written['sensor_pose'][5] == pytest.approx(TURNED_RAD, abs=0.01)
    assert written['range_scale'] == pytest.approx(LONGER, abs=0.005)
    replayed = slam_observer('replay', recording, '--config', out, '--json').json
    assert not [text for text in replayed['warnings'] if 'mounted' in text or 'late' in text]
    assert 'exists already' in slam_observer.fail('calibrate', recording, *words)


@pytest.mark.timeout(300)
def test_a_depth_is_recognised_and_scales_that_trade_are_named(slam_observer, tmp_path):
    world = drive(Settings(**MODEL), 30.0, landmarks=20, seen=20)

    def shown(_, event):
        along = event.points[:, :1] / np.linalg.norm(event.points, axis=1, keepdims=True)
        ahead = along[:, 0] > 0.4
        return replace(event, ids=event.ids[ahead], points=(event.points * along)[ahead])

    recording, _ = recorded(tmp_path / 'run.mcap', world.with_observations(shown))
    found = slam_observer('calibrate', recording, *OPTIONS, '--keep-noise', '--json').json
    assert found['range_is_depth']
    assert found['depth_gain'][0] > 5.0 * found['depth_gain'][1]
    assert found['parameters']['range_is_depth']
    assert 'range_scale' not in found['calibration'] | found['parameters']
    assert 'range scale and wheel scale trade' in found['trades'][0]['text']
    assert 'give a surveyed map' in found['trades'][0]['text']


@pytest.mark.timeout(300)
@pytest.mark.parametrize('which', [('--keep-noise',), ('--only', 'noise')])
def test_where_all_is_as_stated_nothing_is_written(slam_observer, tmp_path, which):
    recording, survey = recorded(tmp_path / 'run.mcap', drive(Settings(**MODEL), 20.0))
    out = tmp_path / 'calibrated.yaml'
    options = ('--map', survey, *OPTIONS, *which, '-o', out)
    ended = slam_observer('calibrate', recording, *options)
    assert ended.code == 4
    assert 'no improvement' in ended.errors
    assert 'held out' in ended.output
    assert not out.exists()


def test_what_can_not_be_calibrated_is_refused(slam_observer, tmp_path):
    world = drive(Settings(**MODEL), 5.0)
    recording, survey = recorded(tmp_path / 'run.mcap', world)
    refused = slam_observer.fail('calibrate', recording, '--gains', 'constant')
    assert 'needs riccati gains' in refused
    assert 'none.yaml' in slam_observer.fail('calibrate', recording, '--map', 'none.yaml')
    kept = slam_observer.fail('calibrate', recording, '--map', survey, '-o', survey, '--force')
    assert 'would replace the map' in kept
    nameless = world.with_observations(
        lambda _, event: replace(event, ids=np.full(len(event.ids), -1))
    )
    unknown, _ = recorded(tmp_path / 'unknown.mcap', nameless)
    assert 'needs landmarks with ids' in slam_observer.fail('calibrate', unknown)
    elsewhere = tmp_path / 'elsewhere.yaml'
    far = LandmarkMap(np.arange(900, 903), 9.0 * np.eye(3), None, np.zeros(3, dtype=np.int64))
    write_map(elsewhere, far, None)
    lost = slam_observer.fail('calibrate', recording, '--map', elsewhere)
    assert 'the pose in the map was not found' in lost


def test_velocities_are_as_noisy_as_they_are():
    rng, rate_hz = np.random.default_rng(0), 20
    V = np.zeros((4000, 6))
    V[:, 3] = 0.5 + 0.1 * rng.standard_normal(len(V))
    V[:, 5] = 0.2
    world = drive(Settings(**MODEL), 5.0)
    events = [VelocityEvent(k * 10**9 // rate_hz, v) for k, v in enumerate(V)]
    motion = driven([*events, *world.observations()])
    # Five velocities lie between two observations.
    assert motion.noise_share[3] == pytest.approx(0.1**2 / 5.0 / 0.5**2, rel=0.2)
    assert motion.rms[3] == pytest.approx(0.5, rel=0.05)
    assert motion.noise_share[5] == 0.0  # a command
    assert motion.noise_share[4] == 1.0  # nothing moves there
    settings = Settings(linear_scale_noise=(0.1, 0.0, 0.0), linear_velocity_noise=(0.0,) * 3)
    wide = opened(settings, {'range_scale_stddev'}, motion, is_surveyed=True)
    assert wide.linear_velocity_noise[0] == pytest.approx(0.05, rel=0.05)
    assert wide.linear_scale_noise == (0.0, 0.0, 0.0)
    assert wide.range_scale_stddev == settings.range_scale_stddev
    assert wide.linear_scale_stddev[0] > 0.0
    assert wide.linear_scale_stddev[1] == 0.0
    # Without a map the ranges' scale is found where the wheels are known, and only there.
    assert opened(settings, {}, motion, is_surveyed=False).range_scale_stddev == 0.0
    known = opened(settings, {'linear_scale_stddev'}, motion, is_surveyed=False)
    assert known.range_scale_stddev > 0.0
    assert known.linear_scale_stddev == settings.linear_scale_stddev


def test_only_what_is_little_known_trades():
    parts = [
        CalibrationEstimate('linear_scale_x', 1.0, deviation, '', 1.0, 0.1)
        for deviation in (0.09, 0.001)
    ]
    scale = CalibrationEstimate('range_scale/camera', 1.0, 0.09, '', 1.0, 0.1)
    together = np.array([[1.0, 0.97], [0.97, 1.0]])
    (trade,) = trades([parts[0], scale], together)
    assert trade.names == ('linear_scale_x', 'range_scale/camera')
    assert trades([parts[1], scale], together) == []
    assert trades([parts[0], scale], np.eye(2)) == []


def test_a_bias_of_one_anchors_ranges_is_found_but_stated_for_no_other():
    settings, motion = Settings(**MODEL), driven([])
    assert opened(settings, {}, motion, is_surveyed=True).range_bias_stddev == 0.2
    assert opened(settings, {}, motion, is_surveyed=False).range_bias_stddev == 0.0
    scale = CalibrationEstimate('range_scale/radio', 1.05, 0.001, '', 1.0, 0.1)
    bias = CalibrationEstimate('range_bias/7', 0.21, 0.15, 'm', 0.0, 0.2)
    together = np.array([[1.0, 0.97], [0.97, 1.0]])
    found = Found([scale, bias], together, False, False, None, [], [], [])
    assert found.frames == {'radio'}
    stated = state_found(settings, InputSettings(), found, None)
    assert stated.settings.range_scale == 1.05
    assert stated.settings.range_bias_stddev == settings.range_bias_stddev
    (trade,) = trades([replace(scale, deviation=0.09), bias], together)
    assert trade.text.startswith('bias of ranges and range scale trade')
