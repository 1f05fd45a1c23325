"""A mistake of the set-up is named: signs, units and frames; and none where all is right."""

from __future__ import annotations

from dataclasses import replace
import math

import numpy as np
import pytest

from slam_observer_ros.common.findings import found
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID, VelocityEvent
from slam_observer_ros.geometry import se3, so3
from slam_observer_ros.runs.mistakes import (
    Correction,
    explained,
    first_drive,
    mistakes,
    OPTICAL,
)
from slam_observer_ros.settings.estimator_settings import Settings

SETTINGS = Settings(
    two_d_mode=True,
    angular_velocity_noise=(0.0, 0.0, 0.02),
    linear_velocity_noise=(0.02, 0.005, 0.0),
    observation_model='range_bearing',
    range_noise=0.05,
    bearing_noise=0.01,
)
PERIOD_NS = 50_000_000
POSITIVE = np.diag([-1.0, -1.0, 1.0])

MADE = {
    'points_in_optical_axes': Correction('', OPTICAL.T),
    'points_mirrored': Correction('', np.diag([1.0, -1.0, 1.0])),
    'points_backwards': Correction('', POSITIVE),
    'points_in_millimetres': Correction('', 1e3 * np.eye(3)),
    'tag_size': Correction('', 0.8 * np.eye(3)),
    'turning_in_degrees': Correction('', turn=math.degrees(1.0)),
    'speed_in_kmh': Correction('', drive=3.6),
    'turning_negated': Correction('', turn=-1.0),
    'driving_negated': Correction('', drive=-1.0),
    'no_turning': Correction('', turn=0.0),
}


def drive(seed=0, seconds=60.0, false=0.0):
    """Events of a robot that drives an eight among landmarks, as noisy as stated."""
    rng, events, A = np.random.default_rng(seed), [], np.eye(4)
    landmarks = np.column_stack([rng.uniform(-9.0, 9.0, (25, 2)), np.zeros(25)])
    for step in range(round(seconds * 1e9 / PERIOD_NS)):
        stamp_ns, dt_s = (step + 1) * PERIOD_NS, PERIOD_NS * 1e-9
        V = np.array([0.0, 0.0, 0.5 if step % 500 < 250 else -0.5, 0.6, 0.0, 0.0])
        noise = np.array([0.0, 0.0, 0.02, 0.02, 0.0, 0.0]) * rng.normal(size=6) / math.sqrt(dt_s)
        events.append(VelocityEvent(stamp_ns - PERIOD_NS, V + noise))
        A = A @ se3.exp(dt_s * V)
        if step % 4:
            continue
        points = se3.transform(se3.inverse(A), landmarks)
        ranges_m, bearings = np.linalg.norm(points, axis=1), np.arctan2(points[:, 1], points[:, 0])
        ids = np.flatnonzero((ranges_m < 6.0) & (np.abs(bearings) < 1.0))
        ranges_m = ranges_m[ids] + 0.05 * rng.normal(size=len(ids))
        bearings = bearings[ids] + 0.01 * rng.normal(size=len(ids))
        seen = ranges_m[:, None] * np.column_stack(
            [np.cos(bearings), np.sin(bearings), np.zeros(len(ids))]
        )
        wrong = rng.random(len(ids)) < false
        seen[wrong] += rng.normal(scale=2.0, size=(np.count_nonzero(wrong), 3)) * [1.0, 1.0, 0.0]
        events.append(ObservationEvent(stamp_ns, ids, seen))
    return events


def named(events, settings=SETTINGS):
    return [finding.kind for finding in mistakes(settings, events)]


@pytest.mark.parametrize('kind', MADE)
def test_a_mistake_that_was_made_is_named(kind):
    assert kind in named(list(MADE[kind].apply(drive())))


@pytest.mark.parametrize('factor', [1.0 / 3.0, 1.0, 3.0])
@pytest.mark.parametrize('false', [0.0, 0.1])
def test_where_all_is_right_nothing_is_named(factor, false):
    settings = replace(
        SETTINGS,
        angular_velocity_noise=(0.0, 0.0, 0.02 * factor),
        linear_velocity_noise=(0.02 * factor, 0.005 * factor, 0.0),
    )
    assert named(drive(seed=1, false=false), settings) == []


def test_what_differs_by_a_mirror_or_by_the_front_alone_is_named_with_its_like():
    mirrored = named(list(MADE['points_mirrored'].apply(drive())))
    assert mirrored == ['points_mirrored', 'turning_negated']
    backwards = named(list(MADE['driving_negated'].apply(drive())))
    assert backwards == ['driving_negated', 'points_backwards']


def test_without_ids_or_points_nothing_is_named():
    events = drive(seconds=5.0)
    nameless = [
        replace(event, ids=np.full(len(event.ids), UNKNOWN_ID))
        if isinstance(event, ObservationEvent)
        else event
        for event in events
    ]
    assert named(nameless) == named([e for e in events if isinstance(e, VelocityEvent)]) == []


def test_a_robot_that_stands_is_looked_at_for_longer():
    parked = [VelocityEvent(k * PERIOD_NS, np.zeros(6)) for k in range(1000)]
    assert len(first_drive(parked)) == len(parked)
    assert first_drive([]) == []


@pytest.mark.parametrize('kind', ['points_mirrored', 'points_in_millimetres'])
def test_a_sensor_that_looks_sideways_from_a_mast_is_judged_in_its_own_axes(kind):
    R, mast = so3.exp(np.array([0.0, 0.0, 1.2])), np.array([1.5, -0.5, 0.0])
    wrong = [
        event
        if isinstance(event, VelocityEvent)
        else replace(
            event,
            points=(event.points - mast) @ (R @ MADE[kind].points @ R.T).T + mast,
            sensor=np.tile(mast, (len(event.points), 1)),
            sensor_axis=R[:, 0],
        )
        for event in drive()
    ]
    assert kind in named(wrong)


def test_two_mistakes_are_both_named():
    twice = MADE['points_in_millimetres'].apply(MADE['points_in_optical_axes'].apply(drive()))
    assert set(named(list(twice))) == {'points_in_millimetres', 'points_in_optical_axes'}
    twice = list(MADE['speed_in_kmh'].apply(MADE['turning_in_degrees'].apply(drive())))
    assert set(named(twice)) == {'speed_in_kmh', 'turning_in_degrees'}


def test_the_factor_of_a_size_is_estimated():
    (finding,) = mistakes(SETTINGS, list(MADE['tag_size'].apply(drive())))
    assert float(finding.what.split(' times')[0].split()[-1]) == pytest.approx(1.25, abs=0.05)


def test_what_a_mistake_explains_is_left_out():
    symptoms = [found('slip'), found('noisy_odometry', factor=2.0, motion='turning', proposed='')]
    others = [found('damaged', path='x', loss='y')]
    assert explained(symptoms + others) == symptoms + others
    assert explained([found('turning_negated'), *symptoms, *others]) == [
        found('turning_negated'),
        *others,
    ]
