"""The SLAM observer as a ROS 2 node: one that always estimates, and one that others command."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node

from slam_observer_ros.common.errors import ParameterError, SlamObserverError
from slam_observer_ros.nodes.observer_core import ObserverCore
from slam_observer_ros.nodes.ros_node import (
    declare_settings,
    Entities,
    forward_logging,
    install_command,
    read_settings,
    RepeatableParameters,
)
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import ManagedNodeSettings, ObserverNodeSettings

TOPIC = 'bond'
TIMEOUT_S = 4.0
"""After which without a heartbeat the manager is given up; as Nav2's own nodes have it."""


class LifecycleBond:
    """Heartbeats to the lifecycle manager while the node is active.

    Raises a ParameterError where they are asked for, and bondpy is not installed.
    """

    def __init__(self, node: Node, heartbeat_period_s: float) -> None:
        self._node = node
        self._period_s = heartbeat_period_s
        self._bond: Any = None
        if heartbeat_period_s:
            self._bond_class = _bond_class()

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


def _bond_class() -> Any:
    try:
        from bondpy.bondpy import Bond
    except ImportError as error:
        raise ParameterError(
            f"'bond_heartbeat_period' needs bondpy: {install_command('bondpy')}; or set it to 0, "
            'and bond_timeout of the lifecycle manager to 0.0'
        ) from error
    return Bond


class ObserverNode(RepeatableParameters):
    """Estimates from its start to its end."""

    def __init__(self) -> None:
        super().__init__('observer_node')
        self._core: ObserverCore | None = None  # till it is made: rclpy may end a node before
        forward_logging(self.get_logger())
        declare_settings(self, Settings, ObserverNodeSettings)
        self._core = ObserverCore(self)
        self._core.start()

    def end_in_haste(self) -> int | None:
        """See :meth:`.ObserverCore.end_in_haste`."""
        return None if self._core is None else self._core.end_in_haste()

    def destroy_node(self) -> None:
        """Save the map if that was asked for, and end; raise a MapError if it can't be saved."""
        try:
            if self._core is not None:
                self._core.close()
        finally:
            super().destroy_node()


class LifecycleObserverNode(RepeatableParameters, LifecycleNode):  # type: ignore[misc]
    """Estimates while it is active.

    Configured, it has its topics, services and map; inactive, it drops what comes in and
    publishes nothing; cleaned up, it has forgotten all but its parameters.
    """

    def __init__(self) -> None:
        super().__init__('observer_node')
        self._core: ObserverCore | None = None
        self._bond: LifecycleBond | None = None
        forward_logging(self.get_logger())
        declare_settings(self, Settings, ObserverNodeSettings, ManagedNodeSettings)
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
        """Save the map if that was asked for, and forget all."""
        self._attempt(self._close)
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Save the map if that was asked for, and end for good."""
        self._attempt(self._close)
        return TransitionCallbackReturn.SUCCESS

    def end_in_haste(self) -> int | None:
        """See :meth:`.ObserverCore.end_in_haste`."""
        return None if self._core is None else self._core.end_in_haste()

    def destroy_node(self) -> None:
        """End, whatever the state; raise a MapError if the map can't be saved."""
        try:
            self._close()
        finally:
            super().destroy_node()

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

    def _close(self) -> None:
        bond, self._bond = self._bond, None
        if bond is not None:
            bond.end()
        core, self._core = self._core, None
        if core is not None:
            core.close()
