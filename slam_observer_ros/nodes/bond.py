"""A bond, by which Nav2's lifecycle manager notices that a managed node has died."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node

from slam_observer_ros.common.errors import ParameterError
from slam_observer_ros.nodes.message_classes import install_command

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
