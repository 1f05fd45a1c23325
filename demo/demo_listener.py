"""What the demo hears: every topic of both nodes, recorded and read."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TwistStamped
from nav_msgs.msg import Odometry, Path
import numpy as np
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud, PointCloud2
from std_msgs.msg import Float64
from visualization_msgs.msg import MarkerArray

from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.messages.cdr import CdrReader
from slam_observer_ros.messages.clouds import decode_point_cloud, decode_point_cloud2
from slam_observer_ros.messages.poses import (
    decode_pose_stamped,
    decode_pose_with_covariance_stamped,
)
from slam_observer_ros.nodes.ros_node import LATCHED_QOS, TFMessage
from slam_observer_ros.recordings.trajectory import associate, Trajectory
from slam_observer_ros.recordings.writer import RecordingWriter

CAUGHT_UP_NS = 500_000_000  # lag of an estimate at the end: the last events are held back

DEEP_QOS = QoSProfile(depth=10_000)

MEASURED = {'/twist': TwistStamped, '/landmarks': PointCloud2}
ESTIMATED = {
    '/observer_node/odometry': Odometry,
    '/pose': PoseWithCovarianceStamped,
    '/path': Path,
    '/landmark_estimates': PointCloud,
    '/lyapunov': Float64,
    '/markers': MarkerArray,
}
SHARED = {'/diagnostics': DiagnosticArray}
TRUE = {'/ground_truth/pose': PoseStamped}
LATCHED = {'/landmark_map': PointCloud2, '/ground_truth/landmarks': PointCloud2}


class DemoListener(Node):  # type: ignore[misc]  # rclpy comes untyped
    """Records all topics byte for byte, and keeps what the demo's figures need.

    Messages are recorded at the time of ``/clock`` if ``is_simulated_time``. ``lyapunov`` has one
    value an estimate.
    """

    def __init__(self, writer: RecordingWriter, is_simulated_time: bool) -> None:
        super().__init__(
            'demo',
            parameter_overrides=[Parameter('use_sim_time', value=is_simulated_time)],
        )
        self._writer = writer
        self._stamps_ns: list[int] = []
        self._poses: list[FloatArray] = []
        self._true_stamps_ns: list[int] = []
        self._true_poses: list[FloatArray] = []
        self._estimates: dict[int, dict[int, FloatArray]] = {}
        self._true_landmarks: dict[int, FloatArray] = {}
        self.lyapunov: list[float] = []
        transforms = {} if TFMessage is None else {'/tf': TFMessage}
        static_transforms = {} if TFMessage is None else {'/tf_static': TFMessage}
        for topic, message_class in {
            **MEASURED,
            **ESTIMATED,
            **SHARED,
            **TRUE,
            **transforms,
        }.items():
            self._listen(topic, message_class, DEEP_QOS)
        for topic, message_class in {**LATCHED, **static_transforms}.items():
            self._listen(topic, message_class, LATCHED_QOS)

    def hears_observer(self) -> bool:
        """Return whether all of the observer's publishers have been found."""
        return all(self.count_publishers(topic) > 0 for topic in ESTIMATED)

    def is_disturbed(self) -> bool:
        """Return whether another program publishes on the demo's topics too."""
        return any(self.count_publishers(topic) > 1 for topic in {**MEASURED, **ESTIMATED})

    @property
    def is_behind(self) -> bool:
        """Whether the latest estimate is far from the latest true pose in time."""
        if not self._true_stamps_ns:
            return False
        newest_ns = self._stamps_ns[-1] if self._stamps_ns else 0
        return self._true_stamps_ns[-1] - newest_ns > CAUGHT_UP_NS

    @property
    def elapsed_s(self) -> float:
        """Stamp of the latest estimate since the run's start, simulated seconds."""
        if not (self._stamps_ns and self._true_stamps_ns):
            return 0.0
        return to_s(self._stamps_ns[-1] - self._true_stamps_ns[0])

    @property
    def times_s(self) -> FloatArray:
        """(k,) times of the estimates since the run's start, simulated seconds."""
        start_ns = self._true_stamps_ns[0] if self._true_stamps_ns else 0
        return to_s(np.array(self._stamps_ns, dtype=np.int64) - start_ns)

    def trajectories(self) -> tuple[Trajectory, Trajectory]:
        """Return the estimated and the true poses at the stamps of those estimates."""
        truth = Trajectory.from_samples(self._true_stamps_ns, self._true_poses)
        estimate = Trajectory.from_samples(self._stamps_ns, self._poses)
        return associate(estimate, truth)[:2]

    def landmark_tracks(self, stamps_ns: list[int]) -> FloatArray:
        """Return the estimates (k, n, 3) of all true landmarks at k stamps, NaN where unknown."""
        tracks = np.full((len(stamps_ns), len(self._true_landmarks), 3), np.nan)
        for row, stamp_ns in enumerate(stamps_ns):
            known = self._estimates.get(stamp_ns, {})
            for column, landmark_id in enumerate(self._true_landmarks):
                if landmark_id in known:
                    tracks[row, column] = known[landmark_id]
        return tracks

    def true_landmarks(self) -> FloatArray:
        """Return the true landmarks (n, 3), metres."""
        return np.array(list(self._true_landmarks.values()))

    def _listen(self, topic: str, message_class: type, qos: QoSProfile) -> None:
        package = message_class.__module__.split('.')[0]
        read = {
            '/pose': self._read_pose,
            '/lyapunov': self._read_lyapunov,
            '/landmark_estimates': self._read_estimates,
            '/ground_truth/pose': self._read_true_pose,
            '/ground_truth/landmarks': self._read_true_landmarks,
        }.get(topic)
        type_name = f'{package}/msg/{message_class.__name__}'
        self.create_subscription(
            message_class, topic, partial(self._receive, topic, type_name, read), qos, raw=True
        )

    def _receive(
        self, topic: str, type_name: str, read: Callable[[bytes], None] | None, raw: bytes
    ) -> None:
        receive_stamp_ns = self.get_clock().now().nanoseconds
        self._writer.write(topic, type_name, raw, receive_stamp_ns, latched=topic in LATCHED)
        if read is not None:
            read(raw)

    def _read_pose(self, raw: bytes) -> None:
        message = decode_pose_with_covariance_stamped(raw)
        self._stamps_ns.append(message.stamp_ns)
        self._poses.append(message.pose)

    def _read_lyapunov(self, raw: bytes) -> None:
        self.lyapunov.append(float(CdrReader(raw).float64(1)[0]))

    def _read_estimates(self, raw: bytes) -> None:
        event = decode_point_cloud(raw)
        self._estimates[event.stamp_ns] = dict(zip(event.ids.tolist(), event.points, strict=True))

    def _read_true_pose(self, raw: bytes) -> None:
        message = decode_pose_stamped(raw)
        self._true_stamps_ns.append(message.stamp_ns)
        self._true_poses.append(message.pose)

    def _read_true_landmarks(self, raw: bytes) -> None:
        event = decode_point_cloud2(raw)
        self._true_landmarks = dict(zip(event.ids.tolist(), event.points, strict=True))
