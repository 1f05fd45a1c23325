"""Settings that may change while running: from the next observation on they are in force."""

from __future__ import annotations

from dataclasses import fields, replace

from gain_worlds import drive
import numpy as np
import pytest

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID, VelocityEvent
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.settings.estimator_settings import LiveSettings, Settings
from slam_observer_ros.settings.parameter_table import table

LIVE = [row for row in table(Settings) if not row.read_only]

NOISE = [row for row in LIVE if row.name.endswith('_noise')]
"""Counts for what comes after a change, so no other estimator is the same right behind it."""

LIMITS = [row for row in LIVE if row.name.startswith('max_') and row.name.endswith('_velocity')]
"""Which velocities are refused, so that no state is affected by those that are not."""

OTHERS = [row for row in LIVE if row not in NOISE + LIMITS]

AFFECTED_BY = {
    'constant': {'gain_k', 'gain_l', 'step_mode', 'max_innovation_time'},
    'riccati': {'gain_k', 'huber_threshold', 'rejection_threshold'},
}
"""What a setting changes; ``gain_k`` is in the Lyapunov value of all."""


def other_value(row):
    """A value of a parameter that is not its default."""
    if row.choices:
        return next(choice for choice in row.choices if choice != row.default)
    quarter = np.array(row.default) / 4.0
    return tuple(quarter.tolist()) if quarter.ndim else float(quarter)


def relinearised_often(gains, **more):
    return Settings(
        gains=gains,
        reorder_window=0.0,
        relinearization_interval=3,
        relinearization_angle=0.0,
        **more,
    )


def changed_in(settings, rows):
    return replace(settings, **{row.name: other_value(row) for row in rows})


def events_of(settings, with_ids=True):
    """Events of a noisy run, in which every seventh point or so is far off, but at first none."""
    world = drive(settings, 4.5, noise=1.5, landmarks=8, seen=5)
    rng = np.random.default_rng(1)

    def disturb(index, event):
        is_off = (rng.random(len(event.ids)) < 0.15) & (index > 0)
        points = event.points + is_off[:, None] * rng.normal(scale=5.0, size=event.points.shape)
        ids = event.ids if with_ids else np.full(len(event.ids), UNKNOWN_ID)
        return replace(event, points=points, ids=ids)

    return world.with_observations(disturb).events


def bits_of(estimator):
    """All that an estimator knows, in each of the states that it follows."""
    found = [estimator.pose, estimator.world_points, estimator.landmark_ids, estimator.counts]
    if estimator.last_update is not None:
        found += [getattr(estimator.last_update, f.name) for f in fields(estimator.last_update)]
    for hypothesis in estimator._hypotheses._all:
        gains, observer = hypothesis.state.gains, hypothesis.state.observer
        found += [hypothesis.cost, observer.A, observer.points, observer.u]
        rows = np.arange(len(observer))
        found.append(gains.errors.joint.P if gains.errors else gains.joint_covariance(rows))
    return found


def have_same_bits(one, other):
    try:
        np.testing.assert_equal(bits_of(one), bits_of(other))
    except AssertionError:
        return False
    return True


def add_all(events, *estimators):
    for event in events:
        for estimator in estimators:
            assert estimator.add(event)


def agree_to_the_end(events, one, other):
    """Hold two estimators together, observation by observation."""
    observations = 0
    for event in events:
        add_all([event], one, other)
        if isinstance(event, ObservationEvent):
            np.testing.assert_equal(bits_of(one), bits_of(other))
            observations += 1
    assert observations > 8


def split_before_observation(events, number):
    """The events before the observation of that number, and the rest."""
    seen = [i for i, event in enumerate(events) if isinstance(event, ObservationEvent)]
    return events[: seen[number]], events[seen[number] :]


def test_a_changed_limit_refuses_velocities_from_then_on():
    estimator = Estimator(Settings())
    assert estimator.add(VelocityEvent(0, np.full(6, 2.0)))
    for number, row in enumerate(LIMITS, 1):
        estimator.change_settings(replace(Settings(), **{row.name: 3.0}))
        assert not estimator.add(VelocityEvent(number, np.full(6, 2.0)))
    assert estimator.dropped['too_fast'] == len(LIMITS) == 2


def test_every_live_setting_affects_some_filter():
    assert {row.name for row in OTHERS} == set().union(*AFFECTED_BY.values())


@pytest.mark.parametrize('gains', AFFECTED_BY)
@pytest.mark.parametrize('row', OTHERS, ids=lambda row: row.name)
@pytest.mark.parametrize('two_d_mode', [False, True])
def test_a_changed_setting_is_in_force_from_the_next_observation_on(row, gains, two_d_mode):
    """As in an estimator that was made with it, and that no observation has corrected so far."""
    settings = relinearised_often(gains, two_d_mode=two_d_mode)
    other = changed_in(settings, [row])
    before, after = split_before_observation(events_of(settings), 1)
    unchanged, changed, made = Estimator(settings), Estimator(settings), Estimator(other)
    add_all(before, unchanged, changed, made)
    np.testing.assert_equal(bits_of(changed)[:3], bits_of(made)[:3])
    changed.change_settings(other)
    agree_to_the_end(after, changed, made)
    add_all(after, unchanged)
    assert have_same_bits(unchanged, changed) == (row.name not in AFFECTED_BY[gains])


def test_changed_settings_are_in_force_where_points_have_no_ids():
    settings = relinearised_often('riccati', confirmations=2)
    before, after = split_before_observation(events_of(settings, with_ids=False), 1)
    changed, made = Estimator(settings), Estimator(changed_in(settings, OTHERS))
    add_all(before, changed, made)
    changed.change_settings(changed_in(settings, OTHERS))
    agree_to_the_end(after, changed, made)


@pytest.mark.parametrize('gains', AFFECTED_BY)
@pytest.mark.parametrize('mode', ['uncertain', 'fixed'])
def test_changed_settings_are_in_force_in_a_loaded_map(gains, mode):
    settings = relinearised_often(gains, localization_mode=mode)
    points = drive(settings, 1.0, landmarks=8, seen=5).world_points
    known = LandmarkMap(
        np.arange(8), points, np.tile(1e-4 * np.eye(3), (8, 1, 1)), np.ones(8, int)
    )
    changed, made = Estimator(settings), Estimator(changed_in(settings, OTHERS))
    for estimator in (changed, made):
        estimator.load_map(known, np.eye(4), 1e-2 * np.eye(6))
    changed.change_settings(changed_in(settings, OTHERS))
    agree_to_the_end(events_of(settings), changed, made)


@pytest.mark.parametrize(
    ('gains', 'with_ids'),
    [*((gains, True) for gains in AFFECTED_BY), ('riccati', False)],  # others need ids
)
def test_what_an_estimator_was_made_with_does_not_matter_after_a_change(gains, with_ids):
    """Nor how often it has changed: before each observation one setting has another value."""
    settings = relinearised_often(gains)
    others = [changed_in(settings, [row]) for row in LIVE]
    changed, changed_often = Estimator(settings), Estimator(changed_in(settings, LIVE))
    observations = 0
    for event in events_of(settings, with_ids):
        if isinstance(event, ObservationEvent):
            now = others[observations % len(others)]
            changed.change_settings(now)
            for passing in (settings, *others, now):
                changed_often.change_settings(passing)
            observations += 1
        add_all([event], changed, changed_often)
        np.testing.assert_equal(bits_of(changed), bits_of(changed_often))
        for estimator in (changed, changed_often):
            estimator.change_settings(settings)
    assert observations > len(others)


def test_all_hypotheses_follow_a_change():
    settings = Settings(two_d_mode=True, unknown_linear_motion=1.0, reorder_window=0.0)
    estimator = Estimator(settings)
    posts = np.array([[2.0, 1.0, 0.0], [2.0, -1.0, 0.0]])
    for step in range(10):
        estimator.add(VelocityEvent(step * 10**8, np.zeros(6)))
        estimator.add(ObservationEvent(step * 10**8, np.full(2, UNKNOWN_ID), posts))
    after_blind_stretch_ns = 9 * 10**9
    estimator.add(VelocityEvent(after_blind_stretch_ns, np.zeros(6)))
    either = np.array([UNKNOWN_ID]), np.array([[2.0, 0.0, 0.0]])
    estimator.add(ObservationEvent(after_blind_stretch_ns, *either))
    estimator.flush()
    assert len(estimator._hypotheses) > 1
    estimator.change_settings(replace(settings, huber_threshold=0.5, rejection_threshold=3.0))
    for hypothesis in estimator._hypotheses._all:
        state = hypothesis.state
        for settings_of in (state.gains._tuning, state.relinearisation._settings):
            assert settings_of.huber_threshold == 0.5
            assert settings_of.rejection_threshold == 3.0
        assert state.settings.rejection_threshold == 3.0


def test_live_settings_are_a_copy_that_follows():
    settings = Settings(gain_k=2.0)
    live = LiveSettings.of(settings)
    assert vars(live) == vars(settings)
    live.follow(replace(settings, gain_k=3.0))
    assert (live.gain_k, settings.gain_k) == (3.0, 2.0)
