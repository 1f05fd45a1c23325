"""Feeds a node with velocities and landmarks over DDS, and sees when something comes of them."""

from __future__ import annotations

from bisect import bisect_left
import time
from types import TracebackType
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped, Twist
from nav_msgs.msg import Odometry, Path
from node_costs import LANDMARKS_HZ, POINTS, TICK_HZ, TWIST_HZ, VELOCITY
import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud, PointCloud2
from std_msgs.msg import Float64
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from slam_observer_ros.lie import se3
from slam_observer_ros.messages.cdr import CdrReader
from slam_observer_ros.nodes.ros_node import MESSAGES

RELIABLE = QoSProfile(depth=100)
TICK_S = 1.0 / TICK_HZ
OTHER_TOPICS = {
    'pose': PoseWithCovarianceStamped,
    'lyapunov': Float64,
    'landmark_estimates': PointCloud,
    'path': Path,
    'landmark_map': PointCloud2,
    'markers': MarkerArray,
}
"""What ``observer_node`` publishes beside the odometry and /tf."""


class Driver:
    """A node with a context of its own.

    What the observer publishes is read as it would be on a robot: odometry and /tf, or all of it.
    """

    def __init__(self, reads_all: bool) -> None:
        self._context = Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node('driver', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._twist = self._node.create_publisher(Twist, 'twist', RELIABLE)
        self._landmarks = self._node.create_publisher(PointCloud2, 'landmarks', RELIABLE)
        self._world = np.random.default_rng(0).uniform(-10.0, 10.0, (POINTS, 3))
        self._tick = 0
        self.forget()
        self._subscribe(Twist, 'echo/twist', self._on_echo)
        self._subscribe(Odometry, 'observer_node/odometry', self._on_odometry)
        self._subscribe(TFMessage, '/tf', lambda _raw: None)
        for topic, message_class in OTHER_TOPICS.items() if reads_all else ():
            self._subscribe(message_class, topic, lambda _raw: None)

    def __enter__(self) -> Driver:
        return self

    def __exit__(
        self,
        _kind: type[BaseException] | None,
        _error: BaseException | None,
        _trace: TracebackType | None,
    ) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def wait_for_subscribers(self, patience_s: float) -> None:
        """Wait until somebody receives both inputs; raise a TimeoutError if nobody ever does."""
        deadline_s = time.monotonic() + patience_s
        publishers = self._twist, self._landmarks
        while not all(publisher.get_subscription_count() for publisher in publishers):
            if time.monotonic() > deadline_s:
                raise TimeoutError('the node does not subscribe to twist and landmarks')
            # The type that it subscribes to may be what it finds.
            self.rest(0.1)

    def feed(self, duration_s: float) -> None:
        """Publish velocities and landmarks for a while."""
        begin_s = time.monotonic()
        for tick in range(round(duration_s * TICK_HZ)):
            self.rest(begin_s + tick * TICK_S - time.monotonic())
            self._tick += 1
            if self._tick % (TICK_HZ // LANDMARKS_HZ) == 0:
                self._publish_landmarks()
            if self._tick % (TICK_HZ // TWIST_HZ) == 0:
                self._publish_twist()

    def rest(self, duration_s: float) -> None:
        """Only receive, for a while."""
        end_s = time.monotonic() + duration_s
        while (left_s := end_s - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=left_s)

    def forget(self) -> None:
        """Forget what was published and received so far."""
        self._published_ns: list[int] = []
        self._echoed_ns: list[int] = []
        self._odometry_ns: list[tuple[int, int]] = []  # stamp, reception

    def latencies_s(self) -> list[float]:
        """Return the time from each Twist to what came of it, seconds."""
        if self._echoed_ns:
            pairs = zip(self._published_ns, self._echoed_ns, strict=False)
            return [1e-9 * (received_ns - sent_ns) for sent_ns, received_ns in pairs]
        latencies_s = []
        for sent_ns in self._published_ns:
            index = bisect_left(self._odometry_ns, (sent_ns, 0))
            if index < len(self._odometry_ns):
                latencies_s.append(1e-9 * (self._odometry_ns[index][1] - sent_ns))
        return latencies_s

    def _publish_twist(self) -> None:
        message = MESSAGES.twist(VELOCITY)
        self._published_ns.append(time.time_ns())
        self._twist.publish(message)

    def _publish_landmarks(self) -> None:
        pose = se3.exp(VELOCITY * self._tick * TICK_S)
        points = se3.transform(se3.inverse(pose), self._world)
        ids = np.arange(POINTS)
        message = MESSAGES.point_cloud2(time.time_ns(), 'base_link', ids, points)
        self._landmarks.publish(message)

    def _subscribe(self, message_class: Any, topic: str, callback: Any) -> None:
        self._node.create_subscription(message_class, topic, callback, RELIABLE, raw=True)

    def _on_echo(self, _raw: bytes, info: dict[str, int]) -> None:
        self._echoed_ns.append(info['received_timestamp'])

    def _on_odometry(self, raw: bytes, info: dict[str, int]) -> None:
        self._odometry_ns.append((CdrReader(raw).stamp_ns(), info['received_timestamp']))
