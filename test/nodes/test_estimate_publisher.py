"""When the estimate is published: as soon as there is something new, but not too often."""

from __future__ import annotations

import time
from types import SimpleNamespace
from unittest.mock import Mock

from nav_msgs.msg import Odometry
import numpy as np
import pytest

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import VelocityEvent
from slam_observer_ros.inputs.transform_buffer import TransformBuffer
from slam_observer_ros.nodes.publishing.estimate_publisher import EstimatePublisher
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import ObserverNodeSettings

pytestmark = pytest.mark.ros

SECOND = 1_000_000_000


class Published:
    """A publisher on a node that is none, and the odometry that it has published."""

    def __init__(self, monkeypatch, **parameters):
        self.clock = SimpleNamespace(now_s=1000.0)
        monkeypatch.setattr(time, 'monotonic', lambda: self.clock.now_s)
        self.odometry = []
        node = Mock()
        node.create_publisher.side_effect = self._publisher
        self.estimator = Estimator(Settings(reorder_window=0.0, **parameters))
        settings = ObserverNodeSettings(publish_rate=50.0, publish_tf=False)
        self.publisher = EstimatePublisher(node, settings, self.estimator, TransformBuffer())

    def _publisher(self, message_class, _topic, _qos):
        publisher = Mock()
        if message_class is Odometry:
            publisher.publish.side_effect = self.odometry.append
        return publisher

    def at(self, now_s, velocity=None):
        """Take a velocity, in exact time, at some time; publish what is due."""
        self.clock.now_s = 1000.0 + now_s
        self.estimator.add(velocity or VelocityEvent(round(now_s * SECOND), np.ones(6)))
        if self.publisher.is_due:
            self.publisher.publish_state()


def test_each_state_of_an_input_of_the_same_rate_is_published_though_it_jitters(monkeypatch):
    published = Published(monkeypatch)
    jitter_s = np.random.default_rng(0).uniform(-0.004, 0.004, 500)
    for step in range(500):
        published.at(1.0 + 0.02 * step + jitter_s[step])
    assert len(published.odometry) == 500


def test_a_faster_input_is_published_at_the_rate_that_was_set(monkeypatch):
    published = Published(monkeypatch)
    for step in range(2000):
        published.at(1.0 + 0.005 * step)
    assert 495 <= len(published.odometry) <= 505
