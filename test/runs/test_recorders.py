"""What a report shows of a run is recorded while it goes on, and changes nothing of it."""

from __future__ import annotations

import numpy as np
import pytest
from recordings import events

from slam_observer_ros.runs import recorders as recorder_module
from slam_observer_ros.runs.recorders import RunRecorder
from slam_observer_ros.runs.replay import replay
from slam_observer_ros.settings.estimator_settings import Settings


class Updates(list):
    """All updates of a run."""

    def note_update(self, update):
        self.append(update)


def recorded(**settings):
    recorder = RunRecorder()
    return replay(events(), Settings(**settings), recorders=[recorder]), recorder


@pytest.mark.parametrize('gains', ['constant', 'riccati'])
def test_recording_changes_no_bit_of_the_estimate(gains):
    result, _ = recorded(gains=gains)
    plain = replay(events(), Settings(gains=gains))
    assert np.array_equal(result.estimator.pose, plain.estimator.pose)
    assert np.array_equal(result.estimator.world_points, plain.estimator.world_points)


def test_every_residual_is_judged_in_standard_deviations():
    recorder, updates = RunRecorder(), Updates()
    replay(events(), Settings(), recorders=[recorder, updates])
    innovations = recorder.innovations
    residuals = np.concatenate([update.residuals for update in updates])
    rejected = np.concatenate([update.rejected for update in updates])
    assert len(innovations.distances) == len(residuals)
    assert np.allclose(innovations.residuals_m, np.linalg.norm(residuals, axis=1))
    assert np.array_equal(innovations.weights == 0.0, rejected)
    assert np.isfinite(innovations.nis).all()
    assert np.array_equal(innovations.degrees_of_freedom, 9 * np.ones(len(innovations.nis)))


def test_the_normalised_innovation_of_one_landmark_is_its_distance_squared():
    _, recorder = recorded()
    innovations = recorder.innovations
    largest = innovations.distances.reshape(-1, 3).max(axis=1)
    assert (innovations.nis >= largest**2 * (1.0 - 1e-9)).all()


def test_without_a_joint_covariance_there_is_no_normalised_innovation():
    _, recorder = recorded(gains='constant')
    assert np.isnan(recorder.innovations.nis).all()
    assert len(recorder.innovations.distances)


def test_instants_are_thinned_and_the_end_is_among_them(monkeypatch):
    monkeypatch.setattr(recorder_module, 'FIRST_PERIOD_NS', 1)
    monkeypatch.setattr(recorder_module, 'MAX_INSTANTS', 10)
    result, recorder = recorded()
    instants = recorder.finish(result.estimator)
    stamps_ns = [instant.stamp_ns for instant in instants]
    assert 5 <= len(instants) <= 11
    assert stamps_ns == sorted(stamps_ns)
    assert stamps_ns[-1] == result.estimator.stamp_ns
    assert instants[-1].landmark_covariances.shape == (3, 3, 3)
