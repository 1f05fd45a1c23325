"""All that is estimated has one owner: copies change apart, and what was given out never does."""

from __future__ import annotations

from copy import deepcopy
import inspect
from typing import ClassVar

from gain_worlds import drive
import numpy as np
import pytest

from slam_observer_ros.common.types import LandmarkColumns
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.filter.riccati.active_landmarks import BlockSize
from slam_observer_ros.filter.riccati.riccati import RiccatiGains
from slam_observer_ros.settings.estimator_settings import Settings

EVERYTHING = Settings(
    reorder_window=0.0,
    angular_scale_stddev=(0.1, 0.1, 0.1),
    sensor_rotation_stddev=(0.05, 0.05, 0.05),
    relinearization_interval=5,
    relinearization_angle=0.01,
)
KINDS = {
    'constant': Settings(reorder_window=0.0, gains='constant'),
    'riccati': EVERYTHING,
    'in a plane': Settings(reorder_window=0.0, two_d_mode=True),
    'moving landmarks': Settings(reorder_window=0.0, landmark_velocity_stddev=0.1),
    'tags': Settings(reorder_window=0.0, use_tag_orientation=True),
    'large map': Settings(reorder_window=0.0),
}


@pytest.fixture(name='run', params=KINDS, ids=str)
def fixture_run(request, monkeypatch):
    """Settings, and events that suit them."""
    settings = KINDS[request.param]
    if request.param == 'large map':
        monkeypatch.setattr(RiccatiGains, 'block', BlockSize(dense=8, most=6, kept=3))
    world = drive(settings, 12.0, landmarks=24)
    if settings.use_tag_orientation:
        world = world.with_observations(with_orientations)
    return settings, world.events


def with_orientations(_, event):
    identities = np.tile(np.eye(3), (len(event.ids), 1, 1))
    return ObservationEvent(event.stamp_ns, event.ids, event.points, orientations=identities)


def known_of(estimator):
    """All numbers that the state has, one by one, copied."""
    state = estimator._state
    observer, rows = state.observer, np.arange(len(state.landmarks))
    known = [observer.A, observer.points, observer.u, state.calibration.values]
    known += [state.gains.joint_covariance(rows), state.landmark_covariances()]
    known += [getattr(state.landmarks, name) for name in state.landmarks.COLUMNS]
    if state.relinearisation.is_active:
        known += [np.array(state.relinearisation.history.poses)]
    return [None if array is None else np.array(array) for array in known]


def test_a_copy_of_a_state_and_the_state_change_apart_and_alike(run):
    settings, events = run
    one, other = Estimator(settings), Estimator(settings)
    half = len(events) // 2
    for event in events[:half]:
        one.add(event)
        other.add(event)
    before = known_of(one)
    other._hypotheses._go_on_with([one._hypotheses._all[0].copy()])
    for event in events[half:]:
        other.add(event)
    np.testing.assert_equal(known_of(one), before)
    for event in events[half:]:
        one.add(event)
    np.testing.assert_equal(known_of(one), known_of(other))


def test_a_copy_of_a_state_has_its_calibration_in_its_own_arrays_alone(run):
    settings, events = run
    estimator = Estimator(settings)
    for event in events[: len(events) // 2]:
        estimator.add(event)
    one = estimator._state
    other = one.copy()
    of_one, of_other = vars(one.calibration), vars(other.calibration)
    assert {name for name in of_one if of_one[name] is not of_other[name]} == {'_owner'}
    assert of_other['_owner'] is other.observer
    assert not np.shares_memory(one.observer.calibration, other.observer.calibration)


def test_a_deep_copy_of_an_estimator_has_one_owner_too(run):
    settings, events = run
    one, half = Estimator(settings), len(events) // 2
    for event in events[:half]:
        one.add(event)
    other = deepcopy(one)
    for event in events[half:]:
        one.add(event)
        other.add(event)
    other._hypotheses._go_on_with([each.copy() for each in other._hypotheses._all])
    np.testing.assert_equal(known_of(one), known_of(other))


def test_what_an_estimator_has_given_out_never_changes(run):
    settings, events = run
    estimator, given = Estimator(settings), []
    names = [name for name, _ in inspect.getmembers(Estimator, lambda m: isinstance(m, property))]
    for event in events[: len(events) // 2]:
        estimator.add(event)
        for name in names:
            value = getattr(estimator, name)
            if isinstance(value, np.ndarray):
                given.append((name, value, value.copy()))
    assert {name for name, _, _ in given} >= {'pose', 'world_points', 'landmark_ids'}
    for name, value, copied in given:
        np.testing.assert_array_equal(value, copied, err_msg=name)


def test_columns_grow_and_shrink_together_and_are_written_to_in_place():
    class Table(LandmarkColumns):
        COLUMNS: ClassVar = {'ids': (np.int64, ()), 'points': (np.float64, (3,))}

    table, expected = Table(), np.empty(0, dtype=np.int64)
    for m in (5, 30, 1):
        rows = table.append_zeros(m)
        assert not table.ids[rows].any() and not table.points[rows].any()
        table.ids[rows] = 1 + rows
        table.points[rows, 0] = 1 + rows
        expected = np.append(expected, 1 + rows)
        table.delete(rows[:1])
        expected = np.delete(expected, rows[:1])
        copied = table.copy()
        copied.ids[:] = 0
        np.testing.assert_array_equal(table.ids, expected)
        np.testing.assert_array_equal(table.points[:, 0], expected)
    assert len(table) == len(expected)
