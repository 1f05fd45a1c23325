"""The estimated pose on /tf: map to odom where others publish odom to base, else map to base."""

from __future__ import annotations

from collections import deque
import time

from rclpy.node import Node

from slam_observer_ros.errors import TransformError
from slam_observer_ros.geometry import se3
from slam_observer_ros.nodes.qos import RELIABLE_QOS
from slam_observer_ros.nodes.settings import ObserverNodeSettings
from slam_observer_ros.nodes.transforms import TransformPublisher
from slam_observer_ros.recording.frames import TransformSource
from slam_observer_ros.types import FloatArray
from slam_observer_ros.units import to_ns

DISCOVERY_S = 2.0
"""How long to look for odom to base on /tf before the base is taken to have no parent there."""

MAX_WAITING = 25
"""Most poses that wait for odometry of their time."""


class PoseBroadcaster:
    """Keeps the tree of frames whole, as REP 105 asks: each frame has one parent.

    Nothing goes out before it is known who is the base frame's parent. Where that is the odometry
    frame, its correction goes out post-dated by ``transform_tolerance``, so that it holds until
    the next one; while the observer is paused, the last correction is repeated. A frame is never
    published twice with one stamp.

    Parameters
    ----------
    node : Node
        Node that publishes.
    settings : ObserverNodeSettings
        Frames and tolerances.
    transforms : TransformSource
        Where the odometry is.

    """

    def __init__(
        self, node: Node, settings: ObserverNodeSettings, transforms: TransformSource
    ) -> None:
        self._node = node
        self._settings = settings
        self._transforms = transforms
        self._publisher = TransformPublisher(node, '/tf', RELIABLE_QOS)
        self._tolerance_ns = to_ns(settings.transform_tolerance)
        self._begin_s = time.monotonic()
        self._child = '' if settings.odom_frame else settings.base_frame
        self._waiting: deque[tuple[int, FloatArray]] = deque(maxlen=MAX_WAITING)
        self._correction: FloatArray | None = None
        self._last_ns: int | None = None

    def add(self, stamp_ns: int, pose: FloatArray) -> None:
        """Publish a pose (4, 4) of the base in the map, now or once its odometry is there."""
        self._waiting.append((stamp_ns, pose))
        self.retry()

    def retry(self) -> None:
        """Publish the newest pose that can be."""
        if not self._waiting or self._publish_correction():
            return
        if not self._child and time.monotonic() - self._begin_s > DISCOVERY_S:
            self._settle(self._settings.base_frame, 'nobody publishes')
        if self._child == self._settings.base_frame:
            stamp_ns, pose = self._waiting.pop()
            self._waiting.clear()
            self._publish(stamp_ns, pose)

    def repeat(self, now_ns: int) -> None:
        """Publish the last correction of the odometry again, as of now; the base's pose never."""
        if self._correction is not None:
            self._publish(now_ns + self._tolerance_ns, self._correction)

    def forget(self) -> None:
        """Begin anew, as after a reset or a jump of the clock."""
        self._waiting.clear()
        self._correction = None

    def _publish_correction(self) -> bool:
        """Publish the newest correction that the odometry known by now gives."""
        settings = self._settings
        for index in reversed(range(len(self._waiting) if settings.odom_frame else 0)):
            stamp_ns, pose = self._waiting[index]
            try:
                odometry = self._transforms.lookup(
                    settings.odom_frame, settings.base_frame, stamp_ns
                )
            except TransformError:
                continue
            for _ in range(index + 1):
                self._waiting.popleft()
            if self._child != settings.odom_frame:
                self._settle(settings.odom_frame, '/tf has')
            self._correction = pose @ se3.inverse(odometry)
            self._publish(stamp_ns + self._tolerance_ns, self._correction)
            return True
        return False

    def _settle(self, child: str, reason: str) -> None:
        self._child = child
        settings = self._settings
        self._node.get_logger().info(
            f"publishing '{settings.map_frame}' to '{child}' on /tf: "
            f"{reason} '{settings.odom_frame}' to '{settings.base_frame}'"
        )

    def _publish(self, stamp_ns: int, pose: FloatArray) -> None:
        if stamp_ns == self._last_ns:
            return
        self._last_ns = stamp_ns
        if self._settings.invert_tf:
            self._publisher.publish(
                stamp_ns, self._child, self._settings.map_frame, se3.inverse(pose)
            )
        else:
            self._publisher.publish(stamp_ns, self._settings.map_frame, self._child, pose)
