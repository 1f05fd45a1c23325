"""``doctor RECORDING``: which shipped parameter file fits, and a graph's own parameters."""

from __future__ import annotations

import json

import numpy as np
import pytest

from slam_observer_ros.cli.doctor import of_anchors, shipped_settings
from slam_observer_ros.cli.main import main
from slam_observer_ros.events import (
    BEARING,
    ObservationEvent,
    RANGE,
    UNKNOWN_ID,
    VelocityEvent,
)
from slam_observer_ros.lie import se3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.recordings.writer import RecordingWriter

STEP_NS = 50_000_000
SEEN = np.array([[2.0, 0.0, 0.0], [1.0, 1.0, 0.0]])


def recording(path, velocities, kind=None):
    with RecordingWriter(path) as writer:
        for number, velocity in enumerate(velocities, 1):
            writer.write_event(VelocityEvent(number * STEP_NS, velocity))
        stamp_ns = (len(velocities) + 1) * STEP_NS
        kinds = None if kind is None else np.array([kind, kind])
        writer.write_event(ObservationEvent(stamp_ns, np.array([1, 2]), SEEN, kinds=kinds))
    return path


@pytest.mark.parametrize(
    ('axes', 'repeated', 'expected'),
    [
        ([2, 3], 1, 'wheeled_robot'),
        ([2, 3], 5, 'wheeled_bearing_range'),
        (list(range(6)), 1, 'stereo_inertial'),
    ],
)
def test_how_a_robot_moves_says_which_file_fits(tmp_path, capsys, axes, repeated, expected):
    drawn = np.random.default_rng(0).uniform(0.1, 1.0, (20, len(axes)))
    velocities = np.zeros((20 * repeated, 6))
    velocities[:, axes] = np.repeat(drawn, repeated, axis=0)
    path = recording(tmp_path / 'run.mcap', velocities)
    assert main(['doctor', str(path), '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    assert found['config'] == expected
    assert found['why']
    assert main(['doctor', str(path)]) == 0
    assert expected in capsys.readouterr().out


@pytest.mark.parametrize('repeated', [1, 5])
@pytest.mark.parametrize(
    ('ids', 'count', 'range_m', 'expected'),
    [
        ([UNKNOWN_ID], 8, 12.0, 'reflectors'),
        ([UNKNOWN_ID], 8, 2.0, None),  # a camera's
        ([UNKNOWN_ID], 400, 12.0, None),  # a raw scan
        ([UNKNOWN_ID, 3], 8, 12.0, None),
    ],
)
def test_few_far_points_without_ids_are_reflectors(
    tmp_path, capsys, ids, count, range_m, expected, repeated
):
    random = np.random.default_rng(0)
    path = tmp_path / 'run.mcap'
    with RecordingWriter(path) as writer:
        for number in range(20):
            velocity = np.array([0.0, 0.0, 0.1, 0.5 + 0.01 * (number // repeated), 0.0, 0.0])
            writer.write_event(VelocityEvent((2 * number + 1) * STEP_NS, velocity))
            bearings = random.uniform(-np.pi, np.pi, count)
            points = np.column_stack([np.cos(bearings), np.sin(bearings), np.zeros(count)])
            points *= range_m * random.uniform(0.5, 1.0, (count, 1))
            seen = np.resize(ids, count)
            writer.write_event(ObservationEvent((2 * number + 2) * STEP_NS, seen, points))
    assert main(['doctor', str(path), '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    otherwise = 'wheeled_robot' if repeated == 1 else 'wheeled_bearing_range'
    assert found['config'] == (expected or otherwise)


def test_landmarks_below_the_sensor_are_codes_on_the_floor(tmp_path, capsys):
    path = tmp_path / 'run.mcap'
    with RecordingWriter(path) as writer:
        for number in range(20):
            velocity = np.array([0.0, 0.0, 0.1, 0.5 + 0.01 * number, 0.0, 0.0])
            writer.write_event(VelocityEvent((2 * number + 1) * STEP_NS, velocity))
            points = np.array([[0.05 - 0.005 * number, 0.02, -0.3]])
            writer.write_event(ObservationEvent((2 * number + 2) * STEP_NS, np.array([7]), points))
    assert main(['doctor', str(path), '--json']) == 0
    assert json.loads(capsys.readouterr().out)['config'] == 'floor_codes'


@pytest.mark.parametrize(('kind', 'expected'), [(RANGE, 'uwb'), (BEARING, 'bearings')])
def test_what_is_seen_as_distances_or_directions_alone_has_its_file(
    tmp_path, capsys, kind, expected
):
    velocities = np.zeros((20, 6))
    velocities[:, 3] = np.linspace(0.1, 1.0, 20)
    assert main(['doctor', str(recording(tmp_path / 'run.mcap', velocities, kind)), '--json']) == 0
    assert json.loads(capsys.readouterr().out)['config'] == expected


def test_a_recording_that_is_not_there_is_named_in_one_line(tmp_path, capsys):
    assert main(['doctor', str(tmp_path / 'none.mcap')]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_a_graph_comes_with_parameters_that_replay_takes(tmp_path, capsys):
    graph, out = tmp_path / 'graph.txt', tmp_path / 'out.mcap'
    graph.write_text(
        'ODOMETRY 0 1 1 0 0 10 0 0 10 0 10\n'
        'ODOMETRY 1 2 1 0 0 10 0 0 10 0 10\n'
        'LANDMARK 0 7 3 1 10 0 10\n'
        'LANDMARK 1 7 2 1 10 0 10\n',
        encoding='utf-8',
    )
    assert main(['convert', 'graph', str(graph), str(out)]) == 0
    parameters = tmp_path / 'out.yaml'
    assert 'velocity_delay_stddev: 0.0' in parameters.read_text(encoding='utf-8')
    assert main(['replay', str(out), '--config', str(parameters), '--json']) == 0
    replayed = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert set(replayed['calibration']) == {'angular_bias_z'}
    parameters.write_text('mine', encoding='utf-8')
    out.unlink()
    assert main(['convert', 'graph', str(graph), str(out)]) == 2
    assert parameters.read_text(encoding='utf-8') == 'mine'
    assert not out.exists()


def drive_among(anchors, bias_m):
    """Return a drive among anchors (n, 3), of which the ranges of the third are off."""
    rng, A, events = np.random.default_rng(0), np.eye(4), []
    V = np.array([0.0, 0.0, 0.3, 1.0, 0.0, 0.0])
    for step in range(1500):
        stamp_ns = 100_000_000 * step
        events.append(VelocityEvent(stamp_ns, V))
        if step % 4 == 0:
            lines = se3.transform(se3.inverse(A), anchors)
            ranges_m = np.linalg.norm(lines, axis=1, keepdims=True)
            ranges_m += 0.1 * rng.normal(size=ranges_m.shape)
            ranges_m[2] += bias_m
            ids, kinds = np.arange(len(anchors)), np.full(len(anchors), RANGE)
            shown = ranges_m * [1.0, 0.0, 0.0]
            events.append(ObservationEvent(stamp_ns, ids, shown, kinds=kinds))
        A = A @ se3.exp(0.1 * V)
    return events


@pytest.mark.parametrize('bias_m', [0.0, 1.5])
def test_an_anchor_that_is_off_is_named_by_the_map_alone(bias_m):
    anchors = np.random.default_rng(1).uniform(-12.0, 12.0, (6, 3)) * [1.0, 1.0, 0.0]
    covariances = np.tile(1e-4 * np.eye(3), (6, 1, 1))
    survey = LandmarkMap(np.arange(6), anchors, covariances, np.zeros(6, np.int64))
    events = drive_among(anchors, bias_m)
    findings = of_anchors(shipped_settings('uwb'), events, [survey])
    assert [each.kind for each in findings] == (['anchor_biased'] if bias_m else [])
    assert all('landmark 2 are' in each.what for each in findings)
