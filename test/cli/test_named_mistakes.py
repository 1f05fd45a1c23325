"""doctor and replay name a mistake of the set-up, and propose nothing that treats its symptoms."""

from __future__ import annotations

import json

from mistaken_drives import drive, MADE, SETTINGS, surveyed
import pytest
from recordings import write_events

from slam_observer_ros.cli.main import main
from slam_observer_ros.mapping.map_file import write_map
from slam_observer_ros.runs.corrections import MISTAKES, SYMPTOMS

OPTIONS = ('--config', 'wheeled_robot', '--set', 'bearing_noise=0.01')


@pytest.fixture
def known(tmp_path):
    path = tmp_path / 'map.yaml'
    write_map(path, surveyed(), SETTINGS)
    return str(path)


def recording(path, kind=None, seconds=25.0):
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


def test_a_map_without_a_recording_is_refused_in_one_line(capsys, known):
    assert main(['doctor', '--load-map', known]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
