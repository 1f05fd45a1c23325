"""When the estimate is published: as soon as there is something new, but not too often."""

from __future__ import annotations

import time
from types import SimpleNamespace
from unittest.mock import Mock

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
import numpy as np
import pytest

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import VelocityEvent
from slam_observer_ros.nodes.estimate_publisher import EstimatePublisher
from slam_observer_ros.recordings.frames import TransformBuffer
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import ObserverNodeSettings

pytestmark = pytest.mark.ros

SECOND = 1_000_000_000


class Published:
    """A publisher on a node that is none, and the odometry that it has published."""

    def __init__(self, monkeypatch, readers=1, **parameters):
        self.clock = SimpleNamespace(now_s=1000.0)
        monkeypatch.setattr(time, 'monotonic', lambda: self.clock.now_s)
        self.odometry = []
        self.poses = []
        self.readers = readers
        node = Mock()
        node.create_publisher.side_effect = self._publisher
        self.estimator = Estimator(Settings(reorder_window=0.0, **parameters))
        settings = ObserverNodeSettings(publish_rate=50.0, publish_tf=False)
        self.publisher = EstimatePublisher(node, settings, self.estimator, TransformBuffer())

    def _publisher(self, message_class, _topic, _qos):
        publisher = Mock()
        publisher.get_subscription_count.return_value = self.readers
        if message_class is Odometry:
            publisher.publish.side_effect = self.odometry.append
        if message_class is PoseWithCovarianceStamped:
            publisher.publish.side_effect = self.poses.append
        return publisher

    def at(self, now_s, velocity=None):
        """Take a velocity, in exact time, at some time; publish what is due."""
        self.clock.now_s = 1000.0 + now_s
        self.estimator.add(velocity or VelocityEvent(round(now_s * SECOND), np.ones(6)))
        self.publisher.publish_state('twist')


def test_each_state_of_an_input_of_the_same_rate_is_published_though_it_jitters(monkeypatch):
    published = Published(monkeypatch)
    jitter_s = np.random.default_rng(0).uniform(-0.004, 0.004, 500)
    for step in range(500):
        published.at(1.0 + 0.02 * step + jitter_s[step])
    assert len(published.odometry) == 500


def test_a_state_that_is_late_for_once_puts_off_no_other(monkeypatch):
    published = Published(monkeypatch)
    for step in range(500):
        published.at(1.0 + 0.02 * step + 0.015 * (step % 10 == 3))
    assert len(published.odometry) == 500


def test_a_faster_input_is_published_at_the_rate_that_was_set(monkeypatch):
    published = Published(monkeypatch)
    for step in range(2000):
        published.at(1.0 + 0.005 * step)
    assert 495 <= len(published.odometry) <= 505


def test_what_another_input_gives_in_between_takes_no_turn_of_the_one_that_sets_the_pace(
    monkeypatch,
):
    published = Published(monkeypatch)
    for step in range(100):
        at_s = 1.0 + 0.02 * step
        published.at(at_s)
        published.clock.now_s += 0.012
        published.estimator.add(VelocityEvent(round((at_s + 0.012) * SECOND), np.ones(6)))
        published.publisher.publish_state('landmarks')
        assert published.publisher.is_waiting
    assert len(published.odometry) == 100


def test_what_nobody_reads_is_not_published(monkeypatch):
    published = Published(monkeypatch, readers=0)
    for step in range(10):
        published.at(1.0 + 0.02 * step)
    assert not published.odometry
    assert not published.poses
    published.publisher.publish_overview()
    assert len(published.poses) == 1, 'which who comes late gets'


def test_a_lost_robot_is_drawn_as_arrows_at_the_places_that_fit(monkeypatch):
    published = Published(monkeypatch)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, 3] = 4.0, -2.0, 0.0
    lost = Mock(is_localised=False, stamp_ns=SECOND, possible_poses=poses)
    published.publisher._estimator = lost
    published.publisher._markers = markers = Mock()
    published.publisher.publish_overview()
    removal, *arrows = markers.publish.call_args.args[0].markers
    assert removal.action == removal.DELETEALL
    assert [(arrow.type, arrow.pose.position.x) for arrow in arrows] == [(0, 0.0), (0, 4.0)]
    # With nobody who looks nothing is made of them.
    markers.get_subscription_count.return_value = 0
    published.publisher.publish_overview()
    assert markers.publish.call_count == 1
