"""The SLAM observer as a ROS 2 node."""

from __future__ import annotations

import sys

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from slam_observer_ros.estimator import Estimator
from slam_observer_ros.nodes.diagnostics import Diagnostics
from slam_observer_ros.nodes.inputs import Input
from slam_observer_ros.nodes.log_bridge import forward_logging
from slam_observer_ros.nodes.outputs import Outputs
from slam_observer_ros.nodes.parameters import declare_settings, read_settings
from slam_observer_ros.nodes.runner import run
from slam_observer_ros.nodes.settings import ObserverNodeSettings
from slam_observer_ros.recording.messages import (
    LANDMARK_DECODERS,
    VELOCITY_DECODERS,
    VelocityMessage,
)
from slam_observer_ros.recording.point_clouds import ObservationMessage
from slam_observer_ros.settings import Settings

OVERVIEW_PERIOD_S = 0.5
DIAGNOSTICS_PERIOD_S = 1.0
LOOK_PERIOD_S = 0.25


class ObserverNode(Node):  # type: ignore[misc]  # rclpy comes untyped
    """Feeds what it receives to an :class:`Estimator` and publishes the estimate."""

    def __init__(self) -> None:
        super().__init__('observer_node')
        forward_logging(self.get_logger())
        declare_settings(self, Settings, ObserverNodeSettings)
        settings = read_settings(self, ObserverNodeSettings)
        estimator_settings = read_settings(self, Settings)
        self._estimator = Estimator(estimator_settings)
        self._outputs = Outputs(self, settings, self._estimator)
        self._accepted_frames = {'', settings.base_frame}
        self._twist = Input(self, 'twist', settings.velocity_type, VELOCITY_DECODERS, self._add)
        self._landmarks = Input(
            self, 'landmarks', settings.landmarks_type, LANDMARK_DECODERS, self._add
        )
        inputs = (self._twist, self._landmarks)
        self._diagnostics = Diagnostics(self, self._estimator, inputs)
        self._create_timers(settings.publish_rate)
        self.create_service(Trigger, '~/reset', self._reset)
        self.add_post_set_parameters_callback(self._apply_parameters)
        self.get_logger().info(
            f"estimating '{settings.base_frame}' in '{settings.map_frame}' with "
            f'{estimator_settings.gains} gains'
        )

    def _create_timers(self, publish_rate_hz: float) -> None:
        # A steady clock: with use_sim_time the ROS clock may stand still or jump back.
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        for period_s, callback in (
            (1.0 / publish_rate_hz, self._outputs.publish_state),
            (OVERVIEW_PERIOD_S, self._outputs.publish_overview),
            (DIAGNOSTICS_PERIOD_S, self._diagnostics.publish),
            (LOOK_PERIOD_S, self._twist.look),
            (LOOK_PERIOD_S, self._landmarks.look),
        ):
            self.create_timer(period_s, callback, clock=clock)

    def _add(self, message: VelocityMessage | ObservationMessage) -> None:
        if message.frame_id not in self._accepted_frames:
            self._accepted_frames.add(message.frame_id)
            self.get_logger().warning(
                f"what comes in frame '{message.frame_id}' is taken to be in the base frame: "
                'no transform is applied'
            )
        self._estimator.add(message.event)

    def _apply_parameters(self, _changes: list[Parameter]) -> None:
        self._estimator.change_settings(read_settings(self, Settings))

    def _reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._estimator.flush()  # what has come before the reset belongs to the old run
        self._estimator.reset()
        self._outputs.forget_path()
        response.success = True
        response.message = 'pose and map are forgotten'
        return response


def main() -> int:
    """Run the observer node until it is asked to stop; return the exit code."""
    return run(ObserverNode)


if __name__ == '__main__':
    sys.exit(main())
