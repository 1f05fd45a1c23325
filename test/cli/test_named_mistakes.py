"""doctor and replay name a mistake of the set-up, and propose nothing that treats its symptoms."""

from __future__ import annotations

from dataclasses import replace
import json
from pathlib import Path
from unittest.mock import Mock

from mistaken_drives import drive, MADE, SETTINGS, surveyed
import numpy as np
import pytest
from recordings import write_events

from slam_observer_ros.cli.main import main
from slam_observer_ros.common.findings import MISTAKES, SYMPTOMS
from slam_observer_ros.events import ObservationEvent, POINT, RANGE, UNKNOWN_ID, VelocityEvent
from slam_observer_ros.mapping.map_file import write_map
from slam_observer_ros.recordings.writer import RecordingWriter
from slam_observer_ros.runs import replay

OPTIONS = ('--config', 'wheeled_robot', '--set', 'bearing_noise=0.01')


@pytest.fixture
def known(tmp_path):
    path = tmp_path / 'map.yaml'
    write_map(path, surveyed(), SETTINGS)
    return str(path)


def recording(path, kind=None, seconds=20.0):
    events = drive(seconds=seconds)
    return str(write_events(path, list(MADE[kind].apply(events)) if kind else events))


def kinds(out):
    return {finding['kind'] for finding in json.loads(out)['findings']}


def test_replay_names_it_and_none_of_its_symptoms(tmp_path, capsys):
    path = recording(tmp_path / 'run.mcap', 'turning_in_degrees')
    assert main(['replay', path, *OPTIONS, '--json']) == 0
    printed = capsys.readouterr()
    named = kinds(printed.out)
    assert 'turning_in_degrees' in named
    assert not named & SYMPTOMS
    assert 'degrees: let the driver publish rad/s' in printed.err


def test_where_all_is_right_none_is_named(tmp_path, capsys, known):
    path = recording(tmp_path / 'run.mcap')
    for arguments in (['replay', path, *OPTIONS], ['doctor', path, '--load-map', known]):
        assert main([*arguments, '--json']) == 0
        assert not kinds(capsys.readouterr().out) & MISTAKES


@pytest.mark.parametrize(
    ('seconds', 'field', 'value', 'stddev', 'is_read_again'),
    [
        (22.0, 'kinds', POINT, 0.0, True),
        (15.0, 'kinds', POINT, 0.0, False),  # too short a drive
        (22.0, 'kinds', POINT, 0.1, False),  # it is estimated
        (22.0, 'kinds', RANGE, 0.0, False),
        (22.0, 'ids', UNKNOWN_ID, 0.0, False),
    ],
)
def test_a_recording_is_read_again_only_where_a_mount_may_be_named(
    tmp_path, monkeypatch, seconds, field, value, stddev, is_read_again
):
    looked = Mock(return_value=[])
    monkeypatch.setattr(replay, 'mistakes', looked)
    events = [
        replace(event, **{field: np.full_like(event.ids, value)})
        if isinstance(event, ObservationEvent)
        else event
        for event in drive(seconds=seconds)
    ]
    path = write_events(tmp_path / 'run.mcap', events)
    mount = f'sensor_rotation_stddev=[0.0,0.0,{stddev}]'
    assert main(['replay', str(path), *OPTIONS, '--set', mount]) == 0
    assert looked.called == is_read_again


def test_where_a_parameter_file_does_not_fit_no_size_is_named(capsys):
    """As of a robot that tilts, whose ways are longer than what is seen of them in the plane."""
    sample = str(Path(__file__).resolve().parents[2] / 'samples' / 'sample.mcap')
    assert main(['replay', sample, '--config', 'wheeled_bearing_range', '--json']) == 0
    assert not kinds(capsys.readouterr().out) & MISTAKES


def test_that_no_pose_was_found_in_a_map_does_not_hide_it(tmp_path, capsys, known):
    path = recording(tmp_path / 'run.mcap', 'points_in_millimetres', seconds=10.0)
    assert main(['replay', path, *OPTIONS, '--load-map', known]) == 2
    assert 'was not found: The points are in millimetres' in capsys.readouterr().err


def test_a_map_tells_a_mirror_image_from_a_wrong_sign(tmp_path, capsys, known):
    path = recording(tmp_path / 'run.mcap', 'turning_negated', seconds=12.0)
    assert main(['doctor', path, '--json']) == 0
    assert kinds(capsys.readouterr().out) == {'points_mirrored', 'turning_negated'}
    assert main(['doctor', path, '--load-map', known, '--json']) == 0
    assert kinds(capsys.readouterr().out) == {'turning_negated'}


def beside(events, later_ns, frame):
    """Return events, beside each velocity another publisher's, which is 1.5 times as large."""
    for event in events:
        yield event
        if isinstance(event, VelocityEvent):
            yield replace(
                event,
                stamp_ns=event.stamp_ns + later_ns,
                body_velocity=1.5 * event.body_velocity,
                receive_ns=event.stamp_ns,
                sensor_frame=frame,
            )


@pytest.mark.parametrize(
    ('later_ns', 'frame', 'sign'),
    [
        (0, 'base_link', 'every second message is of another velocity'),
        (7_000_000, 'base_link', 'every second message is of another velocity'),
        (0, 'chassis', 'of the frames base_link, chassis'),
        (-70_000_000, 'base_link', 'their stamps go back and forth'),
    ],
)
def test_two_publishers_of_velocities_are_the_one_cause(tmp_path, capsys, later_ns, frame, sign):
    path = tmp_path / 'run.mcap'
    with RecordingWriter(path) as writer:
        for event in beside(drive(), later_ns, frame):
            received_ns = (event.receive_ns or event.stamp_ns) + 10**9
            stamped = replace(event, stamp_ns=event.stamp_ns + 10**9)
            if isinstance(event, VelocityEvent):
                named = event.sensor_frame or 'base_link'
                writer.write_velocity(stamped, frame_id=named, receive_stamp_ns=received_ns)
            else:
                writer.write_observation(stamped)
    for command in ('replay', 'doctor'):
        options = OPTIONS if command == 'replay' else ()
        assert main([command, str(path), *options, '--json']) == 0
        findings = json.loads(capsys.readouterr().out)['findings']
        (rivals,) = [each for each in findings if each['kind'] == 'several_publishers']
        assert sign in rivals['what']
        assert not {each['kind'] for each in findings} & (SYMPTOMS | MISTAKES)


@pytest.mark.parametrize('topic', ['landmarks', 'twist'])
def test_stamps_of_1970_are_named_and_no_clock_is_to_be_synchronised(tmp_path, capsys, topic):
    path, now_ns = tmp_path / 'run.mcap', 1_760_000_000 * 10**9
    with RecordingWriter(path) as writer:
        for event in drive():
            is_velocity = isinstance(event, VelocityEvent)
            received_ns = event.stamp_ns + now_ns
            stamped = replace(event, stamp_ns=received_ns)
            write = writer.write_velocity if is_velocity else writer.write_observation
            is_wrong = is_velocity == (topic == 'twist')
            write(event if is_wrong else stamped, receive_stamp_ns=received_ns)
    assert main(['replay', str(path), *OPTIONS, '--json']) == 0
    printed = capsys.readouterr()
    assert {'stamps_of_1970', 'no_observation'} == kinds(printed.out)
    assert f'/{topic} are of 1970' in printed.err
    assert 'synchronise' not in printed.out + printed.err
    assert main(['replay', str(path), *OPTIONS, '--map', str(tmp_path / 'map.yaml')]) == 2
    assert f'/{topic} are of 1970' in capsys.readouterr().err.splitlines()[-1]


def test_a_map_without_a_recording_is_refused_in_one_line(capsys, known):
    assert main(['doctor', '--load-map', known]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
