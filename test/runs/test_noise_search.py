"""Noise alone: what a recording was made with is found, and no more is claimed than holds."""

from __future__ import annotations

import math

import numpy as np
import pytest
import yaml

from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.recordings.writer import RecordingWriter
from slam_observer_ros.runs.calibration import (
    judge,
    Judged,
    kinds_of,
    most_likely,
    remembered,
    scaled,
    without_effect,
)
from slam_observer_ros.runs.recorders import Likelihood
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.parameter_table import changed_names, table
from slam_observer_ros.simulation import Scenario, Simulation

START_NS = 1_000_000_000
TURN_NOISE, DRIVE_NOISE, POINT_NOISE_M = 0.03, 0.02, 0.05
ONLY = ('--only', 'noise')
MODEL = ('--set', 'observation_model=cartesian', '--set', 'angular_bias_stddev=[0,0,0]')
MODELS = next(row.choices for row in table(Settings) if row.name == 'observation_model')
TRUE_NOISE = {
    'angular_velocity_noise': TURN_NOISE,
    'linear_velocity_noise': DRIVE_NOISE,
    'point_noise': POINT_NOISE_M,
}


def simulated(path, seed, of_motion=1.0):
    """Write a minute of a robot on a circle, with noise that is known."""
    rate = 10.0
    scenario = Scenario(
        duration=60.0,
        velocity_rate=rate,
        observation_rate=2.5,
        seed=seed,
        initial_bias=0.0,
        landmark_count=5,
        angular_velocity_noise=of_motion * TURN_NOISE * math.sqrt(rate),
        linear_velocity_noise=of_motion * DRIVE_NOISE * math.sqrt(rate),
        point_noise=POINT_NOISE_M,
    )
    simulation = Simulation(scenario, START_NS)
    with RecordingWriter(path) as writer:
        writer.write_landmarks(START_NS, simulation.landmark_truth(START_NS))
        for delivery in simulation.deliveries():
            writer.write_event(delivery.event)
    return path


def first(value):
    return value[0] if isinstance(value, list) else value


@pytest.mark.timeout(500)  # it replays a minute some eighty times
def test_noise_that_was_stated_wrong_is_found(slam_observer, tmp_path):
    recording, other = (simulated(tmp_path / f'{seed}.mcap', seed) for seed in (1, 2))
    out = tmp_path / 'found.yaml'
    wrong = ('--set', 'point_noise=0.2', '--set', 'angular_velocity_noise=[0.01,0.01,0.01]')
    options = (*MODEL, *wrong, '--out', out, '--json')
    ended = slam_observer.succeed('calibrate', recording, *ONLY, '--hold-out', other, *options)
    found = ended.json
    assert set(found['parameters']) == set(TRUE_NOISE)
    for name, true in TRUE_NOISE.items():
        assert first(found['parameters'][name]) == pytest.approx(true, rel=0.35), name
    deviations = {name: deviation for name, (_, deviation) in found['noise_log_factors'].items()}
    assert deviations['points'] < deviations['driving']
    assert list(found['recordings']) == [str(recording)]
    assert (found['calibration'], found['trades']) == ({}, [])
    before, after = found['held_out']['log_likelihood']
    assert after > before
    assert 0.5 < found['held_out']['anees'][1] < 2.0
    # The file has what was given, what was found, and how sure that is.
    text = out.read_text()
    written = yaml.safe_load(text)['/**']['ros__parameters']
    assert written['observation_model'] == 'cartesian'
    assert written['point_noise'] == found['parameters']['point_noise']
    assert recording.name in text
    assert '# Noise of points: × ' in text
    replayed = slam_observer.succeed('replay', other, '--config', out, '--json').json
    assert replayed['settings']['point_noise'] == written['point_noise']
    assert replayed['configuration_anees'] == pytest.approx(found['held_out']['anees'][1])


def test_what_noise_can_not_be_found_by_is_refused(slam_observer, tmp_path):
    path = tmp_path / 'run.mcap'
    point = np.array([[1.0, 0.0, 0.0]])
    with RecordingWriter(path) as writer:
        for number in range(30):
            stamp_ns = START_NS + number * 100_000_000
            writer.write_event(VelocityEvent(stamp_ns, np.zeros(6)))
            writer.write_event(ObservationEvent(stamp_ns, np.array([-1]), point))
    assert 'needs landmarks with ids' in slam_observer.fail('calibrate', path, *ONLY)
    assert 'riccati' in slam_observer.fail('calibrate', path, *ONLY, '--gains', 'constant')
    together = slam_observer.fail('calibrate', path, *ONLY, '--keep-noise')
    assert 'not allowed with argument' in together


@pytest.mark.timeout(500)
def test_noise_is_found_of_several_recordings_and_a_calibration_of_one(slam_observer, tmp_path):
    recordings = [simulated(tmp_path / f'{seed}.mcap', seed, of_motion=0.0) for seed in (1, 2)]
    one_drive = slam_observer.fail('calibrate', *recordings)
    assert 'give several recordings to --only noise' in one_drive
    motion = [
        word
        for name in ('angular_velocity', 'linear_velocity', 'angular_scale', 'linear_scale')
        for word in ('--set', f'{name}_noise=[0,0,0]')
    ]
    options = (*MODEL, *motion, '--set', 'point_noise=0.2', '--json')
    found = slam_observer.succeed('calibrate', *recordings, *ONLY, *options).json
    assert list(found['recordings']) == list(map(str, recordings))
    assert list(found['parameters']) == ['point_noise']
    assert found['parameters']['point_noise'] == pytest.approx(POINT_NOISE_M, rel=0.35)


def test_figures_of_a_kind_keep_their_proportions():
    settings = Settings(
        linear_velocity_noise=(0.02, 0.01, 0.0), linear_scale_noise=(0.1, 0.0, 0.0)
    )
    kinds = kinds_of(settings)
    assert [kind.name for kind in kinds] == ['turning', 'driving', 'range', 'bearing']
    changed = scaled(settings, kinds, [0.0, math.log(2.0), 0.0, -math.inf])
    assert changed.linear_velocity_noise == pytest.approx((0.04, 0.02, 0.0))
    assert changed.linear_scale_noise == pytest.approx((0.2, 0.0, 0.0))
    assert changed.angular_velocity_noise == pytest.approx(settings.angular_velocity_noise)
    assert changed.bearing_noise > 0.0
    assert 'range_scale_noise' not in kinds[2].parameters


@pytest.mark.parametrize('model', MODELS)
def test_every_model_of_observations_has_figures_to_find(model):
    kinds = kinds_of(Settings(observation_model=model))
    figures = [name for kind in kinds for name in kind.parameters]
    assert len(figures) > 2
    changed = scaled(Settings(), kinds, [0.5] * len(kinds))
    assert set(changed_names(changed)) == set(figures)


def test_the_search_finds_the_maximum_and_how_sharp_it_is():
    H = np.array([[400.0, 100.0, 0.0], [100.0, 100.0, 0.0], [0.0, 0.0, 0.0]])
    best = np.array([0.5, -1.0, 0.0])
    objective = remembered(lambda x: -0.5 * float((np.array(x) - best) @ H @ (np.array(x) - best)))
    assert without_effect(objective, 3) == [2]
    logs, deviations = most_likely(remembered(lambda x: objective(np.array([*x, 0.0]))), 2)
    assert logs == pytest.approx(best[:2], abs=0.05)
    expected = np.sqrt(np.diagonal(np.linalg.inv(H[:2, :2])))
    assert deviations == pytest.approx(expected, rel=0.01)


def test_a_factor_that_hardly_changes_what_is_likely_is_left_as_stated():
    hardly = remembered(lambda x: -1e-3 * (x[0] + x[1]) ** 2 - (x[1] - 0.35) ** 2)
    assert without_effect(hardly, 2) == [0]  # by twice the noise the second changes little, too


def test_what_has_no_maximum_is_not_determined():
    _, deviations = most_likely(remembered(lambda x: -((x[0] - 0.1) ** 2) + 1e-3 * x[1]), 2)
    assert math.isfinite(deviations[0])
    assert math.isinf(deviations[1])


def judged(log_density, error_m=0.1, anees=1.0):
    rng = np.random.default_rng(1)
    noise = 0.1 * rng.standard_normal(200)
    stamps_ns = np.arange(200, dtype=np.int64) * 1_000_000_000
    return Judged(Likelihood(stamps_ns, log_density + noise, np.ones(200)), error_m, anees)


@pytest.mark.parametrize(
    ('after', 'objection'),
    [
        (judged(1.0), ''),
        (judged(1.0, None, None), ''),
        (judged(0.0), 'may be chance'),
        (judged(-1.0), 'may be chance'),
        (judged(1.0, 0.2), 'the error grows from 0.1 to 0.2 m'),
        (judged(1.0, 0.1, 4.0), 'the ANEES goes from 1 to 4'),
    ],
)
def test_an_improvement_is_one_in_all_that_is_known(after, objection):
    verdict = judge([judged(0.0)], [after])
    assert (objection in verdict.objection) if objection else verdict.objection == ''
