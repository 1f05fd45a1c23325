"""Whether the robot knows where it is, in words, as a level and as a latched Bool."""

from __future__ import annotations

from types import SimpleNamespace
from unittest.mock import Mock

from diagnostic_msgs.msg import DiagnosticStatus
from node_processes import running
import numpy as np
import pytest
from robots import Robot
from std_msgs.msg import Bool

from slam_observer_ros.estimates import NormalisedInnovation
from slam_observer_ros.nodes.diagnostics import LocalisationStatus
from slam_observer_ros.nodes.ros_node import LATCHED_QOS
from slam_observer_ros.runs.health import NoiseFit
from slam_observer_ros.settings.node_settings import ObserverNodeSettings
from slam_observer_ros.simulation import Scenario

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
SETTINGS = ObserverNodeSettings(position_limits=(0.1, 0.3), heading_limits=(0.05, 0.2))


class Watched:
    """A status, and what it publishes."""

    def __init__(
        self,
        is_localised=True,
        stamp_ns=1,
        deviations=(0.0,) * 6,
        noise=None,
        is_contradicted=False,
        is_ambiguous=False,
    ):
        self.estimator = SimpleNamespace(
            is_localised=is_localised,
            is_contradicted=is_contradicted,
            stamp_ns=stamp_ns,
            map_name='hall' if is_ambiguous else '',
            ambiguity=object() if is_ambiguous else None,
            pose_covariance=None if deviations is None else np.diag(deviations) ** 2,
        )
        self.node = Mock()
        self.node.get_fully_qualified_name.return_value = '/robot1/observer_node'
        noise = NoiseFit() if noise is None else noise
        self.part = LocalisationStatus(self.node, SETTINGS, self.estimator, noise)

    @property
    def status(self):
        return self.part.status('robot1', self.part.findings)

    @property
    def published(self):
        self.part.publish()
        return [call.args[0].data for call in self.node.create_publisher().publish.mock_calls]


@pytest.mark.parametrize(
    ('state', 'level', 'message', 'is_localised'),
    [
        ({'stamp_ns': None}, WARN, 'no estimate yet', False),
        ({'is_localised': False}, ERROR, 'the pose in the loaded map is not known', False),
        (
            {'is_contradicted': True},
            ERROR,
            'the pose in the map is wrong, or the landmarks in view were moved: they '
            'contradict it',
            False,
        ),
        (
            {'is_ambiguous': True},
            ERROR,
            'what is seen fits several places of the map',
            False,
        ),
        ({'deviations': None}, OK, 'localised; the gains know no standard deviation', True),
        ({}, OK, 'localised', True),
        ({'deviations': (0, 0, 0, 0.2, 0, 0)}, WARN, 'position uncertain: σ = 0.20 m', True),
        ({'deviations': (0, 0, 0, 0, 0.4, 0)}, ERROR, 'position uncertain: σ = 0.40 m', False),
        ({'deviations': (0, 0, 0.1, 0, 0, 0)}, WARN, 'heading uncertain: σ = 0.10 rad', True),
        ({'deviations': (0, 0, 0.3, 0, 0, 0)}, ERROR, 'heading uncertain: σ = 0.30 rad', False),
        ({'deviations': (0.5, 0.5, 0, 0, 0, 0)}, OK, 'localised', True),
    ],
)
def test_level_and_message_follow_the_standard_deviations(state, level, message, is_localised):
    watched = Watched(**state)
    assert (watched.status.level, watched.status.message) == (level, message)
    assert watched.published == [is_localised]


def test_two_robots_have_statuses_of_different_names():
    assert Watched().status.name == 'robot1/observer_node: localisation'


def test_a_robot_near_the_limit_is_not_lost_and_found_all_the_time():
    watched = Watched()
    outcomes = []
    for sigma_m in (0.29, 0.31, 0.29, 0.31, 0.25, 0.23, 0.29):
        watched.estimator.pose_covariance = np.diag([0, 0, 0, sigma_m, 0, 0]) ** 2
        outcomes.append(watched.published[-1])
    assert outcomes == [True, False, False, False, False, True, True]


def test_it_is_published_when_it_changes():
    watched = Watched(is_localised=False)
    assert watched.published == [False]
    assert watched.published == [False]
    watched.estimator.is_localised = True
    assert watched.published == [False, True]


def test_that_the_robot_is_lost_and_found_again_is_logged():
    watched = Watched()
    log = watched.node.get_logger()
    assert watched.published == [True]
    log.info.assert_not_called()
    watched.estimator.pose_covariance = np.diag((0, 0, 0, 0.4, 0, 0)) ** 2
    assert watched.published == [True, False]
    log.warning.assert_called_once_with('not localised any more: position uncertain: σ = 0.40 m')
    watched.estimator.pose_covariance = np.zeros((6, 6))
    assert watched.published == [True, False, True]
    log.info.assert_called_once_with('localised again')


def innovations(times_as_large, count=200):
    """Innovations of two landmarks in the plane, so many times as large as is stated."""
    random = np.random.default_rng(0)
    noise = NoiseFit()
    for nis in times_as_large**2 * random.chisquare(4, count):
        innovation = NormalisedInnovation(
            np.zeros(2), np.ones(2), float(nis), 4, np.zeros(2), np.ones(2)
        )
        noise.add(SimpleNamespace(innovation=innovation))
    return noise


@pytest.mark.parametrize('times', [0.2, 1.0, 3.0])
def test_innovations_show_by_what_factor_the_stated_noise_is_wrong(times):
    assert innovations(times).factor == pytest.approx(times, rel=0.1)


def test_noise_that_is_stated_too_small_is_a_warning():
    status = Watched(noise=innovations(3.0)).status
    assert status.level == WARN
    assert 'the stated noise is too small by a factor of ' in status.message


def test_noise_that_is_stated_too_large_is_said_without_a_warning():
    status = Watched(noise=innovations(0.2)).status
    assert status.level == OK
    values = {value.key: value.value for value in status.values}
    assert 'the stated noise is too large by a factor of 5' in values['innovations / stated noise']


def test_sensors_without_any_noise_are_no_fault():
    assert str(innovations(0.0)) == '0.00'


def test_few_innovations_say_nothing():
    assert innovations(3.0, count=20).factor is None
    assert innovations(3.0, count=20).findings == []


@pytest.mark.ros
def test_a_late_behaviour_tree_hears_whether_the_robot_is_localised(ros, tmp_path):
    arguments = ('-r', '__ns:=/seen')
    with (
        running('observer_node', tmp_path / 'log', *arguments),
        Robot(ros, namespace='/seen') as robot,
    ):
        before = ros.collect(Bool, '/seen/observer_node/is_localised', LATCHED_QOS)
        ros.spin_until(lambda: before, 'the first answer')
        assert not before[0].data
        robot.run(Scenario(duration=1.0))
        ros.spin_until(lambda: before[-1].data, 'the second')
        after = ros.collect(Bool, '/seen/observer_node/is_localised', LATCHED_QOS)
        ros.spin_until(lambda: after, 'the latched answer')
        assert after[0].data
