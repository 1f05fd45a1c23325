"""The parts of the observer node, put together on any node, plain or managed."""

from __future__ import annotations

import numpy as np
from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from rclpy.timer import Timer

from slam_observer_ros.nodes.control_services import ControlServices
from slam_observer_ros.nodes.data_flow import DataFlow
from slam_observer_ros.nodes.guarded_node import Entities, GuardedNode, ThrottledLog
from slam_observer_ros.nodes.initial_pose import InitialPoseListener, KeptPose
from slam_observer_ros.nodes.intake.transforms import TransformedOdometry
from slam_observer_ros.nodes.map_services import MapServices, NamedMapServices
from slam_observer_ros.nodes.publishing.diagnostics import DiagnosticsPublisher
from slam_observer_ros.nodes.publishing.localisation_status import LocalisationStatus, NoiseFit
from slam_observer_ros.nodes.ros_interface import read_settings
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import ObserverNodeSettings
from slam_observer_ros.settings.parameter_table import changed_names

OVERVIEW_PERIOD_S = 0.5
DIAGNOSTICS_PERIOD_S = 1.0
CHECK_PERIOD_S = 0.25
KEEP_PERIOD_S = 2.0

CLOCK_JITTER_NS = 100_000_000
"""/clock may step back by less without having jumped, nanoseconds: messages are then just late."""


class ObserverCore:
    """The flow of data, what says how that goes, and what others may do to it.

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
            hardware_id=settings.base_frame if namespace == '/' else namespace,
        )
        self._offer_services(settings)
        self._timers = [*flow.timers, *self._create_timers()]
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
        self._flow.feed.is_active = True
        for timer in self._timers:
            timer.reset()

    def stop(self) -> None:
        """Drop what comes in and publish nothing, until the next start."""
        self._flow.feed.is_active = False
        self._flow.feed.clear()
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

    def _offer_services(self, settings: ObserverNodeSettings) -> None:
        """Let others steer the estimate, in this order: the kept pose is one in the map."""
        node, flow = self._node, self._flow
        odometry = TransformedOdometry(settings, flow.buffer)
        controls = ControlServices(node, flow.estimator, flow.feed, flow.output, odometry)
        self._maps = MapServices(node, settings, flow.estimator, controls.note_move)
        NamedMapServices(node, self._maps)
        self._kept_pose = KeptPose(node, settings, flow.estimator)
        self._kept_pose.restore()
        InitialPoseListener(node, settings.map_frame, flow.estimator, odometry, controls.note_move)
        node.add_post_set_parameters_callback(self._apply_parameters)

    def _create_timers(self) -> list[Timer]:
        create = self._node.create_steady_timer
        return [
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
            self._flow.estimator.reset()
            self._flow.output.reset()
        for source in self._flow.inputs:
            source.check_publishers()
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

    def _on_clock_jump(self, jump: TimeJump) -> None:
        self._flow.handle_clock_jump(jump.delta.nanoseconds)

    def _apply_parameters(self, _changes: list[Parameter]) -> None:
        self._flow.estimator.change_settings(read_settings(self._node, Settings))
