"""From topics through the estimator to topics: what a message passes, in one screen."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from rclpy.node import Node
from rclpy.timer import Timer

from slam_observer_ros.common.errors import ParameterError
from slam_observer_ros.estimates import Update
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.inputs.frames import BaseFrame, TransformBuffer
from slam_observer_ros.nodes.guarded_node import GuardedNode
from slam_observer_ros.nodes.intake.chosen_inputs import open_inputs
from slam_observer_ros.nodes.intake.estimator_feed import EstimatorFeed
from slam_observer_ros.nodes.intake.input_topic import InputTopic
from slam_observer_ros.nodes.intake.transforms import LiveTransforms
from slam_observer_ros.nodes.publishing.estimate_publisher import EstimatePublisher, TOPICS
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import ObserverNodeSettings

RETRY_PERIOD_S = 0.02

MOTION_INPUTS = ('twist', 'imu')
"""Inputs that are cheap to use, and move the estimate on to the present."""


class DataFlow:
    """Intake, estimator and output, each made of those before it.

    A message comes in on one of ``inputs``; ``feed`` gives it to ``estimator``, once ``buffer``
    places its sensor; and ``output`` publishes the new estimate, at once if it is due.

    Parameters
    ----------
    node : GuardedNode
    settings : ObserverNodeSettings
    estimator_settings : Settings
    on_update : callable
        As of :class:`.Estimator`.

    Attributes
    ----------
    buffer : TransformBuffer
        What is known of /tf.
    estimator : Estimator
    output : EstimatePublisher
    feed : EstimatorFeed
    inputs : list of InputTopic
    timers : list of Timer
        They run only while something waits.

    """

    def __init__(
        self,
        node: GuardedNode,
        settings: ObserverNodeSettings,
        estimator_settings: Settings,
        on_update: Callable[[Update], None],
    ) -> None:
        self.estimator = Estimator(
            estimator_settings,
            on_update=on_update,
            on_jump=self._forget_time,
            judges_innovations=True,
        )
        self.buffer = TransformBuffer()
        self.output = EstimatePublisher(node, settings, self.estimator, self.buffer)
        self._transforms = LiveTransforms(
            node, self.buffer, (settings.map_frame, settings.base_frame), self.output.broadcaster
        )
        self.feed = EstimatorFeed(
            node,
            settings,
            self.estimator,
            BaseFrame(settings, self.buffer),
            on_events=self._publish_new,
            on_waiting=self._begin_to_retry,
        )
        self.inputs = open_inputs(node, settings, self.feed)
        _refuse_own_outputs(node, self.inputs)
        period_s = 1.0 / settings.publish_rate
        self._publish_timer = node.create_steady_timer(period_s, self._publish_waiting)
        self._retry_timer = node.create_steady_timer(RETRY_PERIOD_S, self._retry)
        self.timers = [self._publish_timer, self._retry_timer]
        self._is_catching_up = False
        window_s = estimator_settings.reorder_window
        self._are_late_if_they_wait = settings.landmarks_max_wait > window_s

    def handle_clock_jump(self, by_ns: int) -> None:
        """Use what still waits of the run that has ended, and then what has come of the next."""
        self.feed.begin_clock_jump(-by_ns)
        self._read_waiting()
        self.estimator.handle_clock_jump(by_ns)
        self.feed.end_clock_jump()

    def _forget_time(self) -> None:
        """Forget what is of the time before a jump, which /clock or the stamps have shown."""
        self.feed.clear()
        self.buffer.clear()
        self.output.reset()

    def _publish_new(self, source: str) -> None:
        """Publish what an input has given if it is due, else a little later."""
        if self._is_catching_up:
            return
        # With what is still to be used; a little later, if nothing comes of that.
        has_more = self._are_late_if_they_wait and any(each.has_more for each in self.inputs)
        if not has_more and self.output.is_due(source):
            self._catch_up()
            self.output.publish_state(source)
        if self._must_publish:
            _start(self._publish_timer)

    def _catch_up(self) -> None:
        """Use what waits, so that what is published is not old."""
        self._is_catching_up = True  # their events are published with it
        self._read_waiting(but_landmarks=not self._are_late_if_they_wait)
        self._is_catching_up = False
        self._transforms.read_waiting()  # the odometry, to which the pose is put in relation

    def _read_waiting(self, but_landmarks: bool = False) -> None:
        """Use what waits, in the order in which it was received."""
        # Landmarks first, which read the velocities before them: after all of these they are late.
        for source in sorted(self.inputs, key=lambda source: source.name in MOTION_INPUTS):
            if source.name in MOTION_INPUTS or not but_landmarks:
                source.read_waiting()

    def _publish_waiting(self) -> None:
        self.output.publish_state()
        if self.feed.is_paused:
            self.output.repeat_transform()
        if not self._must_publish:
            self._publish_timer.cancel()

    @property
    def _must_publish(self) -> bool:
        """Whether something is to be published though nothing comes in."""
        return self.feed.is_active and (self.feed.is_paused or self.output.is_waiting)

    def _begin_to_retry(self) -> None:
        _start(self._retry_timer)

    def _retry(self) -> None:
        self.feed.retry()
        if not self.feed.is_waiting:
            self._retry_timer.cancel()


def _start(timer: Timer) -> None:
    """Let a timer run, unless it does."""
    if timer.is_canceled():
        timer.reset()


def _refuse_own_outputs(node: Node, inputs: Iterable[InputTopic[Any]]) -> None:
    """Refuse the node's own estimate as an input: it would follow that for ever."""
    outputs = {node.resolve_topic_name(name): name for name in TOPICS}
    for source in inputs:
        if name := outputs.get(source.topic):
            raise ParameterError(
                f"the input '{source.name}' and the output '{name}' are both '{source.topic}': "
                f'remap one of them, as with -r {name}:=observer/{name.removeprefix("~/")}'
            )
