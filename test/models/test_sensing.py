"""Ranges that are depths along the sensor's axis are recognised, and others taken for no such."""

from __future__ import annotations

from dataclasses import replace

from gain_worlds import drive
import numpy as np
import pytest

from slam_observer_ros.estimates import RangePower
from slam_observer_ros.events import BEARING, ObservationEvent
from slam_observer_ros.runs.health import of_ranges
from slam_observer_ros.runs.replay import replay
from slam_observer_ros.settings.estimator_settings import Settings

CAMERA = Settings(
    angular_velocity_noise=(0.005,) * 3,
    linear_velocity_noise=(0.01,) * 3,
    range_noise=0.05,
    range_scale_noise=0.03,
    bearing_noise=0.02,
    velocity_delay_stddev=0.0,
)


def seen_ahead(settings, power, axis=None):
    """Return what a sensor sees ahead, whose ranges have the cosine to a power in them."""
    forward = np.array([1.0, 0.0, 0.0]) if axis is None else axis

    def shown(_, event):
        cosine = event.points @ forward / np.linalg.norm(event.points, axis=1)
        ahead = cosine > 0.75
        points = event.points[ahead] * cosine[ahead, None] ** power
        return replace(event, ids=event.ids[ahead], points=points, sensor_axis=axis)

    world = drive(settings, 60.0, landmarks=25, seen=25)
    return world.with_observations(shown).events


@pytest.mark.parametrize(
    ('power', 'is_depth', 'two_d_mode'),
    [(0.0, False, False), (0.0, True, True), (1.0, False, True), (1.0, True, False)],
)
def test_the_power_says_what_ranges_are(power, is_depth, two_d_mode):
    settings = replace(CAMERA, two_d_mode=two_d_mode, range_is_depth=is_depth)
    found = replay(seen_ahead(settings, power), settings).range_power
    findings = of_ranges(found, is_depth)
    if power == is_depth:
        assert abs(found.value - power) < 4.0 * found.deviation + 0.02
        assert findings == []
    else:
        assert [finding.kind for finding in findings] == ['depth_for_range']
        assert f'range_is_depth: {str(not is_depth).lower()}' in findings[0].remedy


def test_the_axis_is_that_of_the_sensor():
    left = np.array([0.0, 1.0, 0.0])
    found = replay(seen_ahead(CAMERA, 1.0, left), CAMERA).range_power
    assert len(of_ranges(found, is_depth=False)) == 1


def test_directions_alone_say_nothing_of_ranges():
    unit = [
        replace(
            event,
            points=event.points / np.linalg.norm(event.points, axis=1)[:, None],
            kinds=np.full(len(event.ids), BEARING),
        )
        if isinstance(event, ObservationEvent)
        else event
        for event in seen_ahead(CAMERA, 1.0)
    ]
    assert replay(unit, CAMERA).range_power is None


def test_a_sensor_that_sees_all_around_has_no_axis():
    assert replay(drive(CAMERA, 30.0).events, CAMERA).range_power is None
    assert of_ranges(None, is_depth=False) == []


def test_a_power_that_is_not_sure_says_nothing():
    assert of_ranges(RangePower(0.9, 0.3), is_depth=False) == []
    assert of_ranges(RangePower(0.1, 0.01), is_depth=False) == []
    assert of_ranges(RangePower(-0.9, 0.01), is_depth=False) == []
