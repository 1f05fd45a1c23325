"""A mistake of the set-up is named: signs, units and frames; and none where all is right."""

from __future__ import annotations

from dataclasses import replace

from mistaken_drives import drive, MADE, PERIOD_NS, SETTINGS, surveyed
import numpy as np
import pytest

from slam_observer_ros.common.findings import explained, found
from slam_observer_ros.events import ObservationEvent, RANGE, UNKNOWN_ID, VelocityEvent
from slam_observer_ros.lie import so3
from slam_observer_ros.runs.mistakes import _Score, AS_IT_IS, Correction, first_drive, mistakes
from slam_observer_ros.runs.recorders import Likelihood


def named(events, settings=SETTINGS):
    return [finding.kind for finding in mistakes(settings, events)]


ALIKE = 'points_mirrored', 'driving_negated'


@pytest.mark.parametrize('kind', [kind for kind in MADE if kind not in (*ALIKE, 'tag_size')])
def test_a_mistake_that_was_made_is_named(kind):
    seconds = 25.0 if kind == 'mount_off' else 20.0
    assert kind in named(list(MADE[kind].apply(drive(seconds=seconds))))


@pytest.mark.parametrize(('factor', 'false'), [(1.0 / 3.0, 0.1), (1.0, 0.0), (3.0, 0.1)])
def test_where_all_is_right_nothing_is_named(factor, false):
    settings = replace(
        SETTINGS,
        angular_velocity_noise=(0.0, 0.0, 0.02 * factor),
        linear_velocity_noise=(0.02 * factor, 0.005 * factor, 0.0),
    )
    assert named(drive(seed=1, false=false), settings) == []


@pytest.mark.parametrize(('turned_deg', 'kinds'), [(-5.0, ['mount_off']), (2.0, [])])
def test_how_a_sensor_is_mounted_is_named_where_it_is_more_than_brackets_usually_are(
    turned_deg, kinds
):
    R = so3.exp(np.array([0.0, 0.0, np.radians(turned_deg)]))
    events = Correction('', R).apply(drive(seconds=25.0))
    findings = mistakes(SETTINGS, events, of_mount_only=True)
    assert [each.kind for each in findings] == kinds
    assert all('further to the left' in each.what for each in findings)


def test_a_mount_that_is_estimated_is_not_named():
    settings = replace(SETTINGS, sensor_rotation_stddev=(0.0, 0.0, 0.1))
    assert named(list(MADE['mount_off'].apply(drive(seconds=25.0))), settings) == []


@pytest.mark.parametrize('size', [0.0, np.nan, np.inf, 1e300])
def test_what_sensors_write_for_no_point_at_all_names_and_ends_nothing(size):
    events = [
        replace(event, points=np.full_like(event.points, size))
        if isinstance(event, ObservationEvent)
        else event
        for event in drive(seconds=15.0)
    ]
    assert mistakes(SETTINGS, events) == mistakes(SETTINGS, events, of_mount_only=True) == []


def test_who_goes_straight_on_does_not_turn_in_degrees():
    """Undoing that takes the noise of the turning away, which is stated too small."""
    settings = replace(SETTINGS, angular_velocity_noise=(0.0, 0.0, 0.02 / 3.0))
    assert named(drive(seconds=15.0, turn=0.0), settings) == []


def test_what_differs_by_a_mirror_or_by_the_front_alone_is_named_with_its_like():
    mirrored, backwards = (named(list(MADE[kind].apply(drive()))) for kind in ALIKE)
    assert mirrored == ['points_mirrored', 'turning_negated']
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


def test_of_ranges_alone_no_size_of_tags_is_named():
    long = [
        replace(event, points=1.5 * event.points, kinds=np.full(len(event.ids), RANGE))
        if isinstance(event, ObservationEvent)
        else event
        for event in drive()
    ]
    assert named(long) == []


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


def test_more_of_the_drive_is_looked_at_where_less_leaves_it_open(monkeypatch):
    monkeypatch.setattr('slam_observer_ros.runs.mistakes.DRIVE_S', 6.0)
    monkeypatch.setattr('slam_observer_ros.runs.mistakes.TURNED_RAD', 0.0)
    longer = list(MADE['tag_size'].apply(drive(seconds=13.0)))
    assert named(first_drive(longer)) == []
    assert named(longer) == ['tag_size']


def test_two_mistakes_are_both_named():
    twice = MADE['points_in_millimetres'].apply(MADE['points_in_optical_axes'].apply(drive()))
    assert set(named(list(twice))) == {'points_in_millimetres', 'points_in_optical_axes'}
    twice = list(MADE['speed_in_kmh'].apply(MADE['turning_in_degrees'].apply(drive())))
    assert set(named(twice)) == {'speed_in_kmh', 'turning_in_degrees'}


def test_in_a_map_both_mirror_images_at_once_are_named():
    right = drive()
    twice = list(MADE['points_mirrored'].apply(MADE['turning_negated'].apply(right)))
    assert named(twice) == []  # a robot that is right, in a mirrored world
    found_in_map = mistakes(SETTINGS, twice, surveyed())
    assert {finding.kind for finding in found_in_map} == {'points_mirrored', 'turning_negated'}


def test_no_turning_hides_no_other_mistake():
    twice = list(MADE['no_turning'].apply(MADE['points_in_millimetres'].apply(drive())))
    assert set(named(twice)) == {'no_turning', 'points_in_millimetres'}


def test_somebody_who_carries_the_robot_makes_no_mistake_likelier():
    """As for a while it turned the other way: what helps then is wrong before and after."""
    events = drive()
    a_while = range(len(events) // 2, 6 * len(events) // 10)
    other_way = list(MADE['turning_negated'].apply(events))
    assert named([other_way[i] if i in a_while else e for i, e in enumerate(events)]) == []


@pytest.mark.parametrize(('gain', 'most', 'is_clear'), [(5.0, 1e3, True), (0.1, 1e3, False)])
def test_what_helps_throughout_is_clear_though_it_helps_once_far_more(gain, most, is_clear):
    stamps_ns, ones = 5_000_000_000 * np.arange(20), np.ones(20)

    def score(log_densities):
        return _Score(
            AS_IT_IS, Likelihood(stamps_ns, log_densities, ones), 0.0, 0.0, 1.0, 1.0, 1.0
        )

    gains = np.where(stamps_ns > 0, gain, most)
    assert score(gains).is_clearly_better(score(0.0 * ones)) == is_clear


@pytest.mark.parametrize('stddev', [0.0, 0.05])
def test_a_wrong_size_of_tags_is_named_and_its_factor_estimated(stddev):
    settings = replace(SETTINGS, linear_scale_stddev=(stddev, 0.0, 0.0))
    (finding,) = mistakes(settings, list(MADE['tag_size'].apply(drive())))
    assert finding.kind == 'tag_size'
    assert float(finding.what.split(' times')[0].split()[-1]) == pytest.approx(1.25, abs=0.05)


def test_what_a_mistake_explains_is_left_out():
    symptoms = [found('slip'), found('noisy_odometry', factor=2.0, motion='turning', proposed='')]
    others = [found('damaged', path='x', loss='y')]
    assert explained(symptoms + others) == symptoms + others
    assert explained([found('turning_negated'), *symptoms, *others]) == [
        found('turning_negated'),
        *others,
    ]


def test_two_publishers_explain_what_a_mistake_would_and_each_is_said_once():
    rivals = found('several_publishers', count=2, names='/a, /b', topic='/odom')
    rare = found('rare_velocity', period_s=1.5)
    late = found('late_odometry', delay_s=0.5, when='late', set_to=0.5)
    lost, negated = found('unknown_pose'), found('turning_negated')
    assert explained([late, rivals]) == [rivals]
    assert explained([late, rare]) == [rare]
    assert explained([late, rare, negated]) == [negated]
    # What they explain explains nothing, but where the robot is must be known.
    assert explained([lost, negated, late, rare, rivals]) == [lost, rivals]
