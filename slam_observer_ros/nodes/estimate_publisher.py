"""What the observer publishes about its estimate, and how often."""

from __future__ import annotations

from collections import deque
import time

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry, Path
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import PointCloud, PointCloud2
from std_msgs.msg import Float64
from visualization_msgs.msg import MarkerArray

from slam_observer_ros.common.findings import fault
from slam_observer_ros.common.stamps import is_due, to_s
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimator.estimate import Estimate
from slam_observer_ros.messages.clouds import FLOAT32_ID_LIMIT
from slam_observer_ros.messages.outgoing import (
    encode_point_cloud,
    EstimateMessages,
    PATH_SPACING_NS,
    StateMessages,
    uncertain_pose,
)
from slam_observer_ros.nodes.ros_node import (
    LATCHED_POSE_QOS,
    LATCHED_QOS,
    MESSAGES,
    RELIABLE_QOS,
    ThrottledLog,
)
from slam_observer_ros.nodes.transforms import PoseBroadcaster
from slam_observer_ros.recordings.frames import ALWAYS_NS, TransformBuffer
from slam_observer_ros.runs.health import of_publishers
from slam_observer_ros.settings.node_settings import ObserverNodeSettings

PATH_LENGTH = 2000  # most poses kept in the path, 0.1 s apart or more; the oldest go first

# Part of the period by which a state of the input that sets the pace may come early, as inputs
# jitter, and by which other inputs wait for it.
SLACK = 0.5


class Pace:
    """Allows a state at most at a rate, at the times at which one input gives them.

    The rate follows the input that produced the last published state. States from other inputs
    wait for that input's next one.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_s = 1.0 / rate_hz
        self._due_s = 0.0  # by a steady clock
        self._source = ''

    def is_due(self, source: str) -> bool:
        """Return whether a state may be published now, which an input gave; '' for none."""
        slack_s = SLACK * self._period_s
        sets_pace = bool(source) and source == self._source
        return time.monotonic() >= self._due_s + (-slack_s if sets_pace else slack_s)

    def note(self, source: str) -> None:
        """Take that a state is published now, which an input gave."""
        self._source = source or self._source
        # One that is late for a moment puts off no other.
        earliest_s = time.monotonic() + SLACK * self._period_s
        self._due_s = max(self._due_s + self._period_s, earliest_s)


# Topics of the estimate, before remapping.
TOPICS = (
    '~/odometry',
    'pose',
    'lyapunov',
    'landmark_estimates',
    'path',
    'landmark_map',
    'markers',
)

MAX_AHEAD_S = 0.25  # odometry on /tf may be post-dated a little, so that it holds until the next


class EstimatePublisher:
    """Publishes the estimate on ``TOPICS`` and /tf; ``buffer`` has others' odometry.

    Each message carries the stamp of the estimator's state, never the present time, and no stamp
    is published twice, unless landmarks were forgotten. Nothing is published while the pose in a
    loaded map is unknown, but an empty map instead of one that is out.
    """

    def __init__(
        self,
        node: Node,
        settings: ObserverNodeSettings,
        estimator: Estimate,
        buffer: TransformBuffer,
    ) -> None:
        self._node, self._settings = node, settings
        self._log = ThrottledLog(node)
        self._estimator = estimator
        self._messages = EstimateMessages(MESSAGES, settings.map_frame)
        self._state = StateMessages(settings.map_frame, settings.base_frame)
        self.pace = Pace(settings.publish_rate)
        self._fast_stamp_ns: int | None = None
        self._slow_stamp_ns: int | None = None
        self._path: deque[PoseStamped] = deque(maxlen=PATH_LENGTH)
        self._path_stamp_ns: int | None = None
        self._odometry = node.create_publisher(Odometry, '~/odometry', RELIABLE_QOS)
        self._pose = node.create_publisher(PoseWithCovarianceStamped, 'pose', LATCHED_POSE_QOS)
        self._lyapunov = node.create_publisher(Float64, 'lyapunov', RELIABLE_QOS)
        self._estimates = node.create_publisher(PointCloud, 'landmark_estimates', RELIABLE_QOS)
        self._path_publisher = node.create_publisher(Path, 'path', RELIABLE_QOS)
        self._map = node.create_publisher(PointCloud2, 'landmark_map', LATCHED_QOS)
        self._markers = node.create_publisher(MarkerArray, 'markers', RELIABLE_QOS)
        self.broadcaster: PoseBroadcaster | None = None
        if settings.publish_tf:
            self.broadcaster = PoseBroadcaster(
                node, settings, buffer, estimator.settings.reorder_window
            )

    @property
    def problem(self) -> str:
        """Why the transform is not published as it should be; empty while it is."""
        if self.broadcaster is None:
            return ''
        return self.broadcaster.problem or self.broadcaster.rival

    @property
    def odometry_age_s(self) -> float | None:
        """Age of the newest odometry on /tf, seconds; None if there is none."""
        newest_ns = None if self.broadcaster is None else self.broadcaster.odometry_ns()
        if newest_ns in (None, ALWAYS_NS):
            return None
        now_ns: int = self._node.get_clock().now().nanoseconds
        return to_s(now_ns - newest_ns)

    def early_odometry(self) -> str:
        """Report, and log, that the odometry on /tf is of the future; empty if it is not."""
        age_s = self.odometry_age_s
        if age_s is None or age_s > -MAX_AHEAD_S:
            return ''
        frames = {'odom_frame': self._settings.odom_frame, 'base_frame': self._settings.base_frame}
        text = fault('odometry_ahead', **frames, ahead_s=-age_s)
        self._log.warning('early odometry', text)
        return text

    def rivals(self) -> str:
        """Report other publishers of the odometry; empty if there are none. It is logged, too."""
        topic = self._node.resolve_topic_name('~/odometry')
        finding = of_publishers(topic, self._node.get_publishers_info_by_topic(topic))
        if finding is None:
            return ''
        self._log.warning(topic, finding.text())
        return finding.text()

    @property
    def is_waiting(self) -> bool:
        """Whether there is something to publish, once it is due or the odometry is there."""
        is_waiting = self.broadcaster is not None and self.broadcaster.is_waiting
        return is_waiting or self._is_new(self._fast_stamp_ns)

    def publish_state(self, source: str = '') -> None:
        """Publish odometry, pose, transform, Lyapunov value and landmarks if new and due."""
        if self.broadcaster is not None:
            self.broadcaster.retry()
        stamp_ns = self._estimator.stamp_ns
        if stamp_ns is None or not self._is_new(self._fast_stamp_ns):
            return
        if not self.pace.is_due(source):
            return
        self.pace.note(source)
        self._fast_stamp_ns = stamp_ns
        pose = self._publish_pose(stamp_ns)
        if self.broadcaster is not None:
            self.broadcaster.add(stamp_ns, pose)
        if is_due(stamp_ns, self._path_stamp_ns, PATH_SPACING_NS):
            self._path_stamp_ns = stamp_ns
            self._path.append(self._messages.path_pose(stamp_ns, pose))
        # What nobody reads, and nobody can read later, is not made.
        if self._lyapunov.get_subscription_count():
            self._lyapunov.publish(self._messages.value(self._estimator.lyapunov))
        if self._estimates.get_subscription_count():
            self._publish_estimates(stamp_ns)

    def publish_overview(self) -> None:
        """Publish path, map and markers if they are new; they are costly, so seldom."""
        stamp_ns = self._estimator.stamp_ns
        if stamp_ns is None:
            return
        if not self._estimator.is_localised and self._markers.get_subscription_count():
            poses = self._estimator.possible_poses
            self._markers.publish(self._messages.places(stamp_ns, poses))
        if not self._is_new(self._slow_stamp_ns):
            return
        self._slow_stamp_ns = stamp_ns
        if not self._pose.get_subscription_count():  # it is kept for whoever comes later
            uncertain = uncertain_pose(*self._estimator.uncertain_pose)
            self._pose.publish(self._state.pose(stamp_ns, uncertain))
        if self._path_publisher.get_subscription_count():
            self._path_publisher.publish(self._messages.path(stamp_ns, self._path))
        self._publish_landmarks(stamp_ns)

    def replace_landmarks(self) -> None:
        """Replace map and markers, if any are out, as some of their landmarks are forgotten."""
        if self._slow_stamp_ns is None:
            return
        stamp_ns, map_frame = self._estimator.stamp_ns, self._settings.map_frame
        if stamp_ns is None:
            stamp_ns = self._node.get_clock().now().nanoseconds
        if self._estimator.is_localised:
            self._publish_landmarks(stamp_ns)
            return
        no_ids = np.empty(0, dtype=np.int64)
        self._map.publish(MESSAGES.point_cloud2(stamp_ns, map_frame, no_ids, np.empty((0, 3))))
        self._markers.publish(self._messages.no_markers(stamp_ns))

    def repeat_transform(self) -> None:
        """Publish the odometry's correction as of now, while no new one comes."""
        if self.broadcaster is not None:
            self.broadcaster.repeat(self._node.get_clock().now().nanoseconds)

    def reset(self) -> None:
        """Forget the path, what waits and landmarks that are out: the estimate is another one."""
        self._path.clear()
        self._path_stamp_ns = None
        if self.broadcaster is not None:
            self.broadcaster.clear()
        self.replace_landmarks()

    def _is_new(self, published_ns: int | None) -> bool:
        """Return whether there is a state of another stamp than the one that was published."""
        stamp_ns = self._estimator.stamp_ns
        return stamp_ns not in (None, published_ns) and self._estimator.is_localised

    def _publish_pose(self, stamp_ns: int) -> FloatArray:
        """Publish pose and odometry where they are read; return the pose (4, 4)."""
        estimator = self._estimator
        poses = self._pose.get_subscription_count()
        odometries = self._odometry.get_subscription_count()
        if not (poses or odometries):
            return estimator.pose
        pose, covariance = estimator.uncertain_pose
        uncertain = uncertain_pose(pose, covariance)
        if poses:
            self._pose.publish(self._state.pose(stamp_ns, uncertain))
        if odometries:
            velocity = estimator.body_velocity, estimator.body_velocity_covariance
            self._odometry.publish(self._state.odometry(stamp_ns, uncertain, *velocity))
        return pose

    def _publish_landmarks(self, stamp_ns: int) -> None:
        estimator = self._estimator
        points, covariances = estimator.world_points, estimator.landmark_covariances
        landmarks = estimator.landmark_ids, points, covariances
        velocities = estimator.landmark_velocities
        self._map.publish(self._messages.landmarks(stamp_ns, *landmarks, velocities))
        if self._markers.get_subscription_count() > 0:
            last, doubted = estimator.last_update, estimator.doubted_ids
            markers = self._messages.markers(stamp_ns, *landmarks, last, doubted)
            self._markers.publish(markers)

    def _publish_estimates(self, stamp_ns: int) -> None:
        ids = self._estimator.landmark_ids
        if np.any(ids >= FLOAT32_ID_LIMIT):
            self._node.get_logger().warning(
                f"landmark_estimates can't carry ids from {FLOAT32_ID_LIMIT} on; "
                'landmark_map does',
                once=True,
            )
            return
        points = self._estimator.world_points
        raw = encode_point_cloud(stamp_ns, self._settings.map_frame, ids, points)
        self._estimates.publish(raw)
