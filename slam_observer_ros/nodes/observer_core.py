"""The parts of the observer node, put together on any node, plain or managed."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np
from rclpy.clock import Clock, ClockType, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.timer import Timer

from slam_observer_ros.common.errors import ParameterError
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.inputs.frames import BaseFrame
from slam_observer_ros.nodes.guarded_node import Entities, GuardedNode
from slam_observer_ros.nodes.intake.chosen_inputs import open_inputs
from slam_observer_ros.nodes.intake.estimator_feed import EstimatorFeed
from slam_observer_ros.nodes.intake.input_topic import InputTopic
from slam_observer_ros.nodes.intake.transforms import LiveTransforms, TransformedOdometry
from slam_observer_ros.nodes.logs import ThrottledLog
from slam_observer_ros.nodes.publishing.diagnostics import DiagnosticsPublisher
from slam_observer_ros.nodes.publishing.estimate_publisher import EstimatePublisher, TOPICS
from slam_observer_ros.nodes.publishing.localisation_status import LocalisationStatus, NoiseFit
from slam_observer_ros.nodes.ros_parameters import read_settings
from slam_observer_ros.nodes.services.control_services import ControlServices
from slam_observer_ros.nodes.services.initial_pose import InitialPoseListener
from slam_observer_ros.nodes.services.kept_pose import KeptPose
from slam_observer_ros.nodes.services.map_services import MapServices
from slam_observer_ros.nodes.services.named_map_services import NamedMapServices
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import ObserverNodeSettings
from slam_observer_ros.settings.parameter_table import changed_names

OVERVIEW_PERIOD_S = 0.5
DIAGNOSTICS_PERIOD_S = 1.0
CHECK_PERIOD_S = 0.25
KEEP_PERIOD_S = 2.0
RETRY_PERIOD_S = 0.02

MOTION_INPUTS = ('twist', 'imu')
"""Inputs that are cheap to use, and move the estimate on to the present."""

CLOCK_JITTER_NS = 100_000_000
"""/clock may step back by less without having jumped, nanoseconds: messages are then just late."""


class ObserverCore:
    """Gives what a node receives to an :class:`Estimator` and publishes the estimate.

    The node's parameters are declared. Raises a SlamObserverError if one, or a file that it names,
    can't be used.
    """

    def __init__(self, node: GuardedNode) -> None:
        self._node = node
        self._entities = Entities(node)
        self._log = ThrottledLog(node)
        settings = read_settings(node, ObserverNodeSettings).with_checked_frames()
        estimator_settings = read_settings(node, Settings)
        noise = NoiseFit()
        self._estimator = Estimator(
            estimator_settings,
            on_update=noise.add,
            on_jump=self._on_estimator_jump,
            judges_innovations=True,
        )
        # What comes in and what goes out
        self._transforms = LiveTransforms(node, (settings.map_frame, settings.base_frame))
        self._feed = EstimatorFeed(
            node, settings, self._estimator, BaseFrame(settings, self._transforms.buffer)
        )
        self._publisher = EstimatePublisher(node, settings, self._estimator, self._transforms)
        self._feed.on_events = self._publish_new
        self._feed.on_waiting = self._begin_to_retry
        self._inputs = open_inputs(node, settings, self._feed)
        self._is_catching_up = False
        window_s = estimator_settings.reorder_window
        self._are_late_if_they_wait = settings.landmarks_max_wait > window_s
        _refuse_own_outputs(node, self._inputs)
        self._localisation = LocalisationStatus(node, settings, self._estimator, noise)
        namespace = node.get_namespace()
        self._diagnostics = DiagnosticsPublisher(
            node,
            self._estimator,
            self._feed,
            self._inputs,
            self._publisher,
            self._localisation,
            hardware_id=settings.base_frame if namespace == '/' else namespace,
        )
        # What others may do to the estimate
        odometry = TransformedOdometry(settings, self._transforms.buffer)
        controls = ControlServices(node, self._estimator, self._feed, self._publisher, odometry)
        self._maps = MapServices(node, settings, self._estimator, controls.note_move)
        NamedMapServices(node, self._maps)
        self._kept_pose = KeptPose(node, settings, self._estimator)
        self._kept_pose.restore()
        InitialPoseListener(
            node, settings.map_frame, self._estimator, odometry, controls.note_move
        )
        node.add_post_set_parameters_callback(self._apply_parameters)
        # The times at which all that happens
        self._timers = self._create_timers(settings.publish_rate)
        self.stop()
        # The clock forgets a handle that nobody holds.
        self._jump_handle = node.get_clock().create_jump_callback(
            JumpThreshold(
                min_forward=None,
                min_backward=Duration(nanoseconds=-CLOCK_JITTER_NS),
                on_clock_change=False,
            ),
            post_callback=node.guarded(self._on_clock_jump, 'a jump of the clock'),
        )
        changed = len(changed_names(estimator_settings)) + len(changed_names(settings))
        node.get_logger().info(
            f"estimating '{settings.base_frame}' in '{settings.map_frame}' with "
            f'{estimator_settings.gains} gains, '
            f'{"in the plane" if estimator_settings.two_d_mode else "in 3D"}; '
            f'parameters that differ from their defaults: {changed}'
        )

    def start(self) -> None:
        """Begin to use what comes in and to publish; a new core waits for this."""
        self._feed.is_active = True
        for timer in self._timers:
            timer.reset()

    def stop(self) -> None:
        """Drop what comes in and publish nothing, until the next start."""
        self._feed.is_active = False
        self._feed.clear()
        for timer in self._timers:
            timer.cancel()

    def close(self) -> None:
        """Save the map if that was asked for, and remove all from the node again.

        Raises a MapError if the map can't be saved; all is removed nevertheless.
        """
        try:
            self._kept_pose.keep()
            self._maps.save_at_end()
        finally:
            self._jump_handle.unregister()
            self._entities.remove_new()

    def end_in_haste(self) -> int | None:
        """Save the map, if that was asked for, while another thread is busy with an observation.

        Return the exit code of a process that ends at once then; None if it is ending anyway.
        """
        return self._maps.end_in_haste()

    def _create_timers(self, publish_rate_hz: float) -> list[Timer]:
        # A steady clock: with use_sim_time the ROS clock may stand still or jump back.
        create = partial(self._node.create_timer, clock=Clock(clock_type=ClockType.STEADY_TIME))
        # One of each period: rclpy's executor warns of a clock with eight timers or more. The
        # first two run only while something waits, the others always.
        self._publish_timer = create(1.0 / publish_rate_hz, self._publish_waiting)
        self._retry_timer = create(RETRY_PERIOD_S, self._retry)
        return [
            self._publish_timer,
            self._retry_timer,
            create(CHECK_PERIOD_S, self._check),
            create(OVERVIEW_PERIOD_S, self._publish_overview),
            create(DIAGNOSTICS_PERIOD_S, self._diagnostics.publish),
            create(KEEP_PERIOD_S, self._kept_pose.keep),
        ]

    def _check(self) -> None:
        if not self._is_finite():
            self._log.error(
                'not finite',
                'the estimate is not finite any more, as after numbers that are far too large: '
                'starting again',
            )
            self._estimator.reset()
            self._publisher.reset()
        for source in self._inputs:
            source.check_publishers()
        self._localisation.publish()

    def _is_finite(self) -> bool:
        estimator = self._estimator
        try:
            known = (estimator.pose, estimator.pose_covariance, estimator.world_points)
        except (ArithmeticError, np.linalg.LinAlgError):
            return False
        return all(each is None or bool(np.isfinite(each).all()) for each in known)

    def _publish_overview(self) -> None:
        self._publisher.publish_overview()
        self._maps.keep_recent()

    def _publish_new(self, source: str) -> None:
        """Publish what an input has given if it is due, else a little later."""
        if self._is_catching_up:
            return
        # With what is still to be used; a little later, if nothing comes of that.
        has_more = self._are_late_if_they_wait and any(each.has_more for each in self._inputs)
        if not has_more and self._publisher.is_due(source):
            self._catch_up()
            self._publisher.publish_state(source)
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
        for source in sorted(self._inputs, key=lambda source: source.name in MOTION_INPUTS):
            if source.name in MOTION_INPUTS or not but_landmarks:
                source.read_waiting()

    def _publish_waiting(self) -> None:
        self._publisher.publish_state()
        if self._feed.is_paused:
            self._publisher.repeat_transform()
        if not self._must_publish:
            self._publish_timer.cancel()

    @property
    def _must_publish(self) -> bool:
        """Whether something is to be published though nothing comes in."""
        return self._feed.is_active and (self._feed.is_paused or self._publisher.is_waiting)

    def _begin_to_retry(self) -> None:
        _start(self._retry_timer)

    def _retry(self) -> None:
        self._feed.retry()
        if not self._feed.is_waiting:
            self._retry_timer.cancel()

    def _on_clock_jump(self, jump: TimeJump) -> None:
        """Use what still waits of the run that has ended, and then what has come of the next."""
        self._feed.begin_clock_jump(-jump.delta.nanoseconds)
        self._read_waiting()
        self._estimator.handle_clock_jump(jump.delta.nanoseconds)
        self._feed.end_clock_jump()

    def _on_estimator_jump(self) -> None:
        """Forget what is of the time before a jump, which /clock or the stamps have shown."""
        self._feed.clear()
        self._transforms.buffer.clear()
        self._publisher.reset()

    def _apply_parameters(self, _changes: list[Parameter]) -> None:
        self._estimator.change_settings(read_settings(self._node, Settings))


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
