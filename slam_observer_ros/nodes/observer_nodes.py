"""The SLAM observer as a ROS 2 node: one that always estimates, and one that others command.

First what a message passes, in one screen: from topics through the estimator to topics; then the
parts around that, put together on any node.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.timer import Timer

from slam_observer_ros.common.errors import ParameterError, SlamObserverError
from slam_observer_ros.estimates import Update
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.nodes.chosen_inputs import open_inputs
from slam_observer_ros.nodes.diagnostics import (
    DiagnosticsPublisher,
    LocalisationStatus,
    MistakeWatch,
)
from slam_observer_ros.nodes.estimate_publisher import EstimatePublisher, TOPICS
from slam_observer_ros.nodes.estimator_feed import EstimatorFeed
from slam_observer_ros.nodes.initial_pose import InitialPoseListener, KeptPose
from slam_observer_ros.nodes.input_topic import InputTopic
from slam_observer_ros.nodes.ros_node import (
    declare_settings,
    Entities,
    forward_logging,
    GuardedNode,
    install_command,
    read_settings,
    RepeatableParameters,
    ThrottledLog,
)
from slam_observer_ros.nodes.services import ControlServices, MapServices, NamedMapServices
from slam_observer_ros.nodes.transforms import LiveTransforms, TransformedOdometry
from slam_observer_ros.recordings.frames import BaseFrame, TransformBuffer
from slam_observer_ros.runs.health import NoiseFit
from slam_observer_ros.runs.mistakes import Search
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import ManagedNodeSettings, ObserverNodeSettings
from slam_observer_ros.settings.parameter_table import changed_names, Dataclass, table

RETRY_PERIOD_S = 0.02
MOTION_INPUTS = ('twist', 'imu')  # they are cheap to use, and move the estimate on to the present


class DataFlow:
    """Intake, estimator and output, each made of those before it.

    A message comes in on one of ``inputs``; ``feed`` gives it to ``estimator``, once ``buffer``
    places its sensor; and ``output`` publishes the new estimate, at once if it is due.

    ``on_update`` is as of :class:`.Estimator`.
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
        self.watch = MistakeWatch(node, self.estimator, Search)
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
            on_waiting=lambda: _start(self._retry_timer),
            note_event=self.watch.note,
        )
        self.inputs = open_inputs(node, settings, self.feed)
        _refuse_own_outputs(node, self.inputs)
        period_s = 1.0 / settings.publish_rate
        self._publish_timer = node.create_steady_timer(period_s, self._publish_waiting)
        self._retry_timer = node.create_steady_timer(RETRY_PERIOD_S, self._retry)
        # They run only while something waits
        self.timers = [self._publish_timer, self._retry_timer, self.watch.timer]
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
        self.watch.clear()
        self.output.reset()

    def _publish_new(self, source: str) -> None:
        """Publish what an input has given if it is due, else a little later."""
        if self._is_catching_up:
            return
        # With what is still to be used; a little later, if nothing comes of that.
        has_more = self._are_late_if_they_wait and any(each.has_more for each in self.inputs)
        if not has_more and self.output.pace.is_due(source):
            # What is published is not old: what waits is used, and published with it.
            self._is_catching_up = True
            self._read_waiting(but_landmarks=not self._are_late_if_they_wait)
            self._is_catching_up = False
            self._transforms.read_waiting()  # the odometry, to which the pose is put in relation
            self.output.publish_state(source)
        if self._must_publish:
            _start(self._publish_timer)

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

    def _retry(self) -> None:
        self.feed.retry()
        if not self.feed.is_waiting:
            self._retry_timer.cancel()


def _start(timer: Timer) -> None:
    """Start a timer that is stopped."""
    if timer.is_canceled():
        timer.reset()


def _refuse_own_outputs(node: Node, inputs: Iterable[InputTopic]) -> None:
    """Refuse the node's own estimate as an input: it would follow that for ever."""
    outputs = {node.resolve_topic_name(name): name for name in TOPICS}
    for source in inputs:
        if name := outputs.get(source.topic):
            raise ParameterError(
                f"the input '{source.name}' and the output '{name}' are both '{source.topic}': "
                f'remap one of them, as with -r {name}:=filter/{name.removeprefix("~/")}'
            )


OVERVIEW_PERIOD_S = 0.5
DIAGNOSTICS_PERIOD_S = 1.0
CHECK_PERIOD_S = 0.25
KEEP_PERIOD_S = 2.0
CLOCK_JITTER_NS = 100_000_000  # a /clock that steps back by less has not jumped: messages are late


class ObserverCore:
    """The flow of data, its state and controls; SlamObserverError if it can't be set up."""

    def __init__(self, node: GuardedNode) -> None:
        self._node = node
        self._entities = Entities(node)
        self._log = ThrottledLog(node)
        settings = read_settings(node, ObserverNodeSettings).with_plain_frames()
        settings.check_frames()
        estimator_settings = read_settings(node, Settings)
        noise = NoiseFit()
        self._flow = flow = DataFlow(node, settings, estimator_settings, noise.add)
        self._localisation = LocalisationStatus(node, settings, flow.estimator, noise)
        namespace = node.get_namespace()
        self._diagnostics = DiagnosticsPublisher(
            node,
            flow.estimator,
            flow.feed,
            flow.inputs,
            flow.output,
            self._localisation,
            flow.watch,
            hardware_id=settings.base_frame if namespace == '/' else namespace,
        )
        self._offer_services(settings)
        create = node.create_steady_timer
        self._timers = [
            *flow.timers,
            create(CHECK_PERIOD_S, self._check),
            create(OVERVIEW_PERIOD_S, self._publish_overview),
            create(DIAGNOSTICS_PERIOD_S, self._diagnostics.publish),
            create(KEEP_PERIOD_S, self._kept_pose.keep),
        ]
        self.stop()
        # The clock forgets a handle that nobody holds.
        self._jump_handle = node.get_clock().create_jump_callback(
            JumpThreshold(
                min_forward=None,
                min_backward=Duration(nanoseconds=-CLOCK_JITTER_NS),
                on_clock_change=False,
            ),
            post_callback=node.guarded(
                lambda jump: flow.handle_clock_jump(jump.delta.nanoseconds), 'a jump of the clock'
            ),
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
        self._flow.feed.is_active = True
        for source in self._flow.inputs:
            source.begin_looking()
        for timer in self._timers:
            timer.reset()

    def stop(self) -> None:
        """Drop what comes in and publish nothing, until the next start."""
        self._flow.feed.is_active = False
        self._flow.feed.clear()
        for timer in self._timers:
            timer.cancel()

    def close(self) -> None:
        """Save the map if that was asked for, or raise a MapError; remove all from the node."""
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

    def _offer_services(self, settings: ObserverNodeSettings) -> None:
        """Let others steer the estimate, in this order: the kept pose is one in the map."""
        node, flow = self._node, self._flow
        odometry = TransformedOdometry(settings, flow.buffer)
        controls = ControlServices(node, flow.estimator, flow.feed, flow.output, odometry)
        self._maps = MapServices(node, settings, flow.estimator, controls.note_move)
        NamedMapServices(node, self._maps)
        self._kept_pose = KeptPose(node, settings, flow.estimator, odometry)
        self._kept_pose.restore()
        InitialPoseListener(node, settings.map_frame, flow.estimator, odometry, controls.note_move)
        node.add_post_set_parameters_callback(self._apply_parameters)

    def _check(self) -> None:
        if not self._is_finite():
            self._log.error(
                'not finite',
                'the estimate is not finite any more, as after numbers that are far too large: '
                'starting again',
            )
            self._flow.estimator.reset()
            self._flow.output.reset()
        for source in self._flow.inputs:
            source.check_publishers()
        self._kept_pose.follow_odometry()
        self._localisation.publish()

    def _is_finite(self) -> bool:
        estimator = self._flow.estimator
        try:
            known = (*estimator.uncertain_pose, estimator.world_points)
        except (ArithmeticError, np.linalg.LinAlgError):
            return False
        return all(each is None or bool(np.isfinite(each).all()) for each in known)

    def _publish_overview(self) -> None:
        self._flow.output.publish_overview()
        self._maps.keep_recent()

    def _apply_parameters(self, changes: list[Parameter]) -> None:
        # Not of those that rclpy itself declares, as qos_overrides.
        if not {change.name for change in changes}.isdisjoint(row.name for row in table(Settings)):
            self._flow.estimator.change_settings(read_settings(self._node, Settings))


TOPIC = 'bond'
TIMEOUT_S = 4.0  # without a heartbeat after which the manager is given up, as in Nav2's nodes


class LifecycleBond:
    """Heartbeats to the lifecycle manager of an active node; ParameterError without bondpy."""

    def __init__(self, node: Node, heartbeat_period_s: float) -> None:
        self._node, self._period_s = node, heartbeat_period_s
        self._bond: Any = None
        if heartbeat_period_s:
            try:
                from bondpy.bondpy import Bond
            except ImportError as error:
                raise ParameterError(
                    f"'bond_heartbeat_period' needs bondpy: {install_command('bondpy')}; or set "
                    'it to 0, and bond_timeout of the lifecycle manager to 0.0'
                ) from error
            self._bond_class = Bond

    def start(self) -> None:
        """Begin with the heartbeats, if they were asked for."""
        if not self._period_s or self._bond is not None:
            return
        self._bond = self._bond_class(topic=TOPIC, id=self._node.get_name(), node=self._node)
        self._bond.set_heartbeat_period(self._period_s)
        self._bond.set_heartbeat_timeout(TIMEOUT_S)
        self._bond.start()

    def end(self) -> None:
        """Let the manager know that they end on purpose."""
        if self._bond is not None:
            self._bond.shutdown()
            self._bond = None


class CoreNode(RepeatableParameters):
    """A node with the observer in it, from when that is made to when it is closed."""

    _core: ObserverCore | None = None
    _bond: LifecycleBond | None = None

    def __init__(self, *more_settings: type[Dataclass]) -> None:
        super().__init__('observer_node')
        forward_logging(self.get_logger())
        declare_settings(self, Settings, ObserverNodeSettings, *more_settings)

    def end_in_haste(self) -> int | None:
        """See :meth:`.ObserverCore.end_in_haste`."""
        return None if self._core is None else self._core.end_in_haste()

    def destroy_node(self) -> None:
        """Save the map if that was asked for, and end; raise a MapError if it can't be saved."""
        try:
            self._close()
        finally:
            super().destroy_node()

    def _close(self) -> None:
        bond, self._bond = self._bond, None
        if bond is not None:
            bond.end()
        core, self._core = self._core, None
        if core is not None:
            core.close()


class ObserverNode(CoreNode):
    """Estimates from its start to its end."""

    def __init__(self) -> None:
        super().__init__()
        self._core = ObserverCore(self)
        self._core.start()


class LifecycleObserverNode(CoreNode, LifecycleNode):  # type: ignore[misc]
    """Estimates while it is active.

    Configured, it has its topics, services and map; inactive, it drops what comes in and
    publishes nothing; cleaned up, it has forgotten all but its parameters.
    """

    def __init__(self) -> None:
        super().__init__(ManagedNodeSettings)
        self._refuse_impossible_transitions()
        if not read_settings(self, ManagedNodeSettings).autostart_node:
            self.get_logger().info(
                'not configured: waiting for its transitions, by a lifecycle manager or '
                'ros2 lifecycle set'
            )
            return
        for transition in (self.trigger_configure, self.trigger_activate):
            if transition() != TransitionCallbackReturn.SUCCESS:
                raise ParameterError('autostart_node: the reason is logged above')

    def on_configure(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Create all parts."""
        entities = Entities(self)
        outcome = self._attempt(self._create, 'not configured: ')
        if outcome != TransitionCallbackReturn.SUCCESS:
            entities.remove_new()
        return outcome

    def on_activate(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to estimate and to publish, or go on."""
        return self._attempt(self._start)

    def on_deactivate(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Hold the estimate."""
        return self._attempt(self._stop)

    def on_cleanup(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Save the map if that was asked for, and forget all, also to end for good."""
        self._attempt(self._close)
        return TransitionCallbackReturn.SUCCESS

    on_shutdown = on_cleanup

    def _refuse_impossible_transitions(self) -> None:
        """Answer no to what the state does not allow; rclpy would end with a traceback."""
        service = next(each for each in self.services if each.srv_type.__name__ == 'ChangeState')
        change = service.callback

        def change_if_possible(request: Any, response: Any) -> Any:
            try:
                return change(request, response)
            except rclpy_implementation.RCLError:
                # rcl itself has logged a warning that names transition and state.
                response.success = False
                return response

        service.callback = change_if_possible

    def _attempt(self, act: Callable[[], None], says: str = '') -> TransitionCallbackReturn:
        """Do a part of a transition; log why it fails: rclpy does not."""
        try:
            act()
        except SlamObserverError as error:
            self.get_logger().error(f'{says}{error}')
            return TransitionCallbackReturn.FAILURE
        except Exception as error:  # noqa: BLE001
            self.note_failure(error, f'{says}a transition')
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def _create(self) -> None:
        period_s = read_settings(self, ManagedNodeSettings).bond_heartbeat_period
        self._bond = LifecycleBond(self, period_s)
        self._core = ObserverCore(self)

    def _start(self) -> None:
        if self._core is not None and self._bond is not None:
            self._core.start()
            self._bond.start()

    def _stop(self) -> None:
        if self._core is not None and self._bond is not None:
            self._bond.end()
            self._core.stop()
