"""While it drives, a robot whose set-up is wrong says so, and no message waits for that."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

from diagnostic_msgs.msg import DiagnosticArray
from mistaken_drives import drive, MADE, SETTINGS
from node_processes import running
import pytest
from robots import Robot

from slam_observer_ros.common.findings import found
from slam_observer_ros.nodes.diagnostics import MistakeWatch
from slam_observer_ros.runs.mistakes import Search

SLIP = [found('slip')]


def watch(events):
    """Return a watch that has seen events, and its node."""
    node = Mock()
    watched = MistakeWatch(node, SimpleNamespace(settings=SETTINGS, loaded_maps=()), Search)
    for event in events:
        watched.note(event)
    return watched, node


def searched(watched, node):
    """Let the timer run until it cancels itself; return how often it did."""
    slices, cancelled = 0, watched.timer.cancel.call_count
    while watched.timer.cancel.call_count == cancelled:
        slices += 1
        node.create_steady_timer.call_args.args[1]()
    return slices


def test_a_mistake_is_named_once_in_the_log_and_stays_a_finding():
    watched, node = watch(MADE['turning_in_degrees'].apply(drive(seconds=25.0)))
    watched.look(SLIP, has_slipped=False)
    assert searched(watched, node) > 10
    assert [each.kind for each in watched.findings] == ['turning_in_degrees']
    node.get_logger().error.assert_called_once_with(watched.findings[0].text())
    watched.look(SLIP, has_slipped=False)  # at once it would see the same
    assert not watched.timer.reset.call_args_list[1:]


@pytest.mark.parametrize(
    ('seconds', 'findings', 'has_slipped', 'looks'),
    [
        (40.0, [], False, False),
        (40.0, [found('paused')], False, False),
        (40.0, SLIP, False, True),
        (40.0, [], True, True),
        (10.0, SLIP, True, False),
    ],
)
def test_it_costs_nothing_where_all_fits_or_little_was_driven(
    seconds, findings, has_slipped, looks
):
    watched, _ = watch(drive(seconds=seconds))
    watched.look(findings, has_slipped)
    assert watched.timer.reset.called == looks


def test_it_looks_again_once_it_has_driven_for_as_long_again(monkeypatch):
    now_s = [0.0]
    clock = SimpleNamespace(monotonic=lambda: now_s[0])
    monkeypatch.setattr('slam_observer_ros.nodes.diagnostics.time', clock)
    watched, node = watch(drive(seconds=25.0))
    for now_s[0], looks in [(25.0, True), (45.0, False), (51.0, True)]:
        watched.timer.reset.reset_mock()
        watched.look(SLIP, has_slipped=False)
        assert watched.timer.reset.called == looks
        if looks:
            searched(watched, node)


def test_a_mount_that_shows_by_no_symptom_is_looked_at_after_a_minute_and_seldom_again(
    monkeypatch,
):
    now_s = [0.0]
    clock = SimpleNamespace(monotonic=lambda: now_s[0])
    monkeypatch.setattr('slam_observer_ros.nodes.diagnostics.time', clock)
    watched, node = watch(MADE['mount_off'].apply(drive(seconds=25.0)))
    for now_s[0], looks in [(59.0, False), (61.0, True), (119.0, False), (122.0, True)]:
        watched.timer.reset.reset_mock()
        watched.look([], has_slipped=False)
        assert watched.timer.reset.called == looks
        if looks:
            searched(watched, node)
            assert [each.kind for each in watched.findings] == ['mount_off']
    node.get_logger().error.assert_called_once_with(watched.findings[0].text())
    watched._estimator.settings = replace(SETTINGS, sensor_rotation_stddev=(0.0, 0.0, 0.1))
    now_s[0] = 1000.0
    watched.timer.reset.reset_mock()
    watched.look([], has_slipped=False)  # it is estimated as it drives
    assert not watched.timer.reset.called


def test_what_is_of_another_time_is_forgotten():
    watched, _ = watch(drive(seconds=40.0))
    watched.clear()
    watched.look(SLIP, has_slipped=True)
    assert not watched.timer.reset.called


def test_a_node_names_it_on_diagnostics_in_place_of_its_symptoms(ros, tmp_path):
    parameters = {
        'two_d_mode': True,
        'observation_model': 'range_bearing',
        'max_clock_offset': 1000.0,
        'reorder_window': 0.0,
    }
    received = ros.collect(DiagnosticArray, '/diagnostics')

    def message():
        return received[-1].status[0].message if received else ''

    with running('observer_node', tmp_path / 'log', **parameters) as node, Robot(ros) as robot:
        for event in MADE['turning_negated'].apply(drive(seconds=30.0)):
            robot.send(event)
            ros.spin_for(0.002)
        ros.spin_until(lambda: 'angular velocity is negated' in message(), 'the mistake')
        assert 'noisier' not in message()
        node.wait_for_output('is negated: to the left is positive')
