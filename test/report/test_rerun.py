"""``replay --rerun``: a file that Rerun reads, with all that a viewer shows."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from recordings import MESSAGE_COUNT, write_mcap


@pytest.fixture(name='recording')
def fixture_recording(tmp_path):
    return write_mcap(tmp_path / 'run.mcap')


def columns_of(stream):
    """Read a stream's columns: by entity and component, the values of all rows."""
    found = {}
    for chunk in stream:
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            key = (str(chunk.entity_path), name)
            found[key] = found.get(key, []) + batch.column(name).to_pylist()
    return found


@pytest.fixture(name='reader')
def fixture_reader(slam_observer, recording, tmp_path):
    reading = pytest.importorskip('rerun.chunk', reason='rerun-sdk is not installed')
    slam_observer.succeed('replay', recording, '--rerun', tmp_path / 'run.rrd')
    return reading.RrdReader(tmp_path / 'run.rrd')


def test_a_file_has_the_robot_the_map_and_how_sure_they_are(reader):
    found = columns_of(reader.store().stream())
    positions = found['/world/robot', 'Transform3D:translation']
    assert len(positions) == len(found['/world/robot', 'time']) > MESSAGE_COUNT / 4
    assert found['/world/landmarks', 'Points3D:labels'][-1] == ['3', '5', '9']
    halves = np.array(found['/world/landmark_uncertainty', 'Ellipsoids3D:half_sizes'][-1])
    assert halves.shape == (3, 3)
    assert (halves > 0.0).all()
    assert len(found['/world/true_landmarks', 'Points3D:positions'][0]) == 3
    # A line for each of the landmarks that were known, and two ends of each.
    assert np.shape(found['/world/residuals', 'LineStrips3D:strips'][-1]) == (3, 2, 3)


def test_a_file_has_the_curves(reader):
    found = columns_of(reader.store().stream())
    for landmark_id in (3, 5, 9):
        sigmas = found[f'/plots/residual_sigma/landmark_{landmark_id}', 'Scalars:scalars']
        assert len([sigma for sigma in sigmas if sigma is not None]) == MESSAGE_COUNT / 2 - 1
    for name in ('position/aligned', 'position/from_first_pose', 'fit/NIS', 'fit/NEES'):
        assert found[f'/plots/{name}', 'Scalars:scalars']


def test_a_file_has_a_layout_of_its_views(reader):
    (blueprint,) = reader.blueprints()
    views = {
        name
        for (_, component), rows in columns_of(reader.store(store=blueprint).stream()).items()
        if component == 'ViewBlueprint:display_name'
        for row in rows
        for name in row or []
    }
    assert {'map', 'position error [m]', 'residuals [σ]'} <= views


def test_a_file_is_replaced_by_force_alone(slam_observer, recording, reader, tmp_path):
    assert reader
    path = tmp_path / 'run.rrd'
    assert '--force' in slam_observer.fail('replay', recording, '--rerun', path)
    slam_observer.succeed('replay', recording, '--rerun', path, '--force')
    assert not list(tmp_path.glob('.*'))


def test_what_gains_do_not_know_is_left_out(slam_observer, recording, tmp_path):
    pytest.importorskip('rerun', reason='rerun-sdk is not installed')
    path = tmp_path / 'constant.rrd'
    slam_observer.succeed('replay', recording, '--gains', 'constant', '--rerun', path)
    assert path.stat().st_size > 1000


def test_the_viewer_is_opened_if_no_file_is_named(slam_observer, recording, monkeypatch):
    rerun = pytest.importorskip('rerun', reason='rerun-sdk is not installed')
    opened = []
    monkeypatch.setattr(
        rerun.RecordingStream, 'spawn', lambda _stream, **given: opened.append(given)
    )
    slam_observer.succeed('replay', recording, '--rerun')
    (given,) = opened
    assert given['default_blueprint'] is not None


def test_without_rerun_one_line_says_how_to_install_it(
    slam_observer, recording, tmp_path, monkeypatch
):
    monkeypatch.setitem(sys.modules, 'rerun', None)
    error = slam_observer.fail('replay', recording, '--rerun', tmp_path / 'run.rrd')
    assert 'pip install' in error


def test_a_recording_is_not_taken_for_the_file_to_be_written(slam_observer, recording):
    assert '.rrd' in slam_observer.fail('replay', '--rerun', recording)
