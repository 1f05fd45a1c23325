"""The SLAM observer as a ROS 2 node."""

from __future__ import annotations

from slam_observer_ros.nodes.log_bridge import forward_logging
from slam_observer_ros.nodes.observer_core import ObserverCore
from slam_observer_ros.nodes.ros_parameters import declare_settings, RepeatableParameters
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import ObserverNodeSettings


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
