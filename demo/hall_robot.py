"""The simulated robot as a ROS node: what it publishes, and what it hears of its localisation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

from geometry_msgs.msg import PoseWithCovarianceStamped
import hall
from nav_msgs.msg import Odometry
import numpy as np
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2
from tf2_msgs.msg import TFMessage

from slam_observer_ros.common.stamps import to_ns
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import RANGE, UNKNOWN_ID
from slam_observer_ros.messages.poses import pose_matrices
from slam_observer_ros.nodes.ros_node import MESSAGES

START_NS = 1_000_000_000  # a simulated /clock of zero means that there is no time yet
ODOMETRY_HZ = 50
CAMERA_FRAME = 'camera_optical'

DEEP_QOS = QoSProfile(depth=1000)
STATIC_QOS = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)


Sightings: TypeAlias = Callable[[FloatArray, FloatArray, FloatArray], dict[int, FloatArray]]
Scan: TypeAlias = Callable[[FloatArray, FloatArray, FloatArray, np.random.Generator], FloatArray]


@dataclass(frozen=True)
class World:
    """Where the robot drives, and what it sees there."""

    kind: str  # of its landmarks
    enough: int  # of these in view, by which the robot is found
    params_file: str
    landmarks: FloatArray  # (k, 4, 4) poses of tags, or (k, 3) points without ids, metres
    has_orientations: bool  # whether the map says how tags are turned
    true_pose: Callable[[float], FloatArray]  # (4, 4) of the base, by the time in seconds
    lap_s: float
    camera: FloatArray  # (4, 4) pose of the optical frame in the base, as /tf has it
    steps_per_image: int
    # What is seen at a pose (4, 4) with errors (k, 7): of tags by ids, of points where (m, 3).
    sightings: Sightings | None
    scan: Scan | None = None
    # Distances (k,) at a pose (4, 4) of all landmarks, which have ids.
    ranges: Callable[[FloatArray, FloatArray, np.random.Generator], FloatArray] | None = None
    parameters: tuple[str, ...] = ()  # of the observer, beside those of its file
    back_within_s: float = 1.0  # after a restart, from enough landmarks in view on


@dataclass(frozen=True)
class Seen:
    """What Nav2 has of the robot at an image: its pose by /tf, and the truth; (4, 4) each."""

    time_s: float
    truth: FloatArray
    by_tf: FloatArray | None
    landmarks: int


@dataclass(frozen=True)
class Estimated:
    """A pose that was published with its covariance, and the truth at its stamp."""

    time_s: float
    truth: FloatArray
    pose: FloatArray  # (4, 4)
    covariance: FloatArray  # (6, 6) of position and rotation, as ROS has it


class HallRobot(Node):  # type: ignore[misc]  # rclpy comes untyped
    """Drives about in a world, a step of ``1 / ODOMETRY_HZ`` at a time.

    Attributes
    ----------
    world : World
    seen : list of Seen
    estimated : list of Estimated
    corrections_s : list of float
        Simulated times at which map → odom came.

    """

    def __init__(self, seed: int, world: World) -> None:
        super().__init__('hall_robot')
        self._random = np.random.default_rng(seed)
        self.world = world
        self._carried_s = np.inf
        self._odometry = hall.WheelOdometry(self._random)
        self._truth = world.true_pose(0.0)
        self._errors = hall.SightErrors(self._random, len(world.landmarks))
        self._steps = 0
        self._correction: FloatArray | None = None
        self.seen: list[Seen] = []
        self.estimated: list[Estimated] = []
        self.corrections_s: list[float] = []
        self._clock_publisher = self.create_publisher(Clock, '/clock', 10)
        self._odom = self.create_publisher(Odometry, 'odom', DEEP_QOS)
        self._cloud = self.create_publisher(PointCloud2, 'landmarks', DEEP_QOS)
        self._tf = self.create_publisher(TFMessage, '/tf', DEEP_QOS)
        static = self.create_publisher(TFMessage, '/tf_static', STATIC_QOS)
        camera = MESSAGES.transform_stamped(START_NS, 'base_link', CAMERA_FRAME, world.camera)
        static.publish(TFMessage(transforms=[camera]))
        self._static = static
        self.create_subscription(TFMessage, '/tf', self._hear_transforms, DEEP_QOS)
        self.create_subscription(PoseWithCovarianceStamped, 'amcl_pose', self._hear_pose, DEEP_QOS)

    @property
    def time_s(self) -> float:
        """Simulated time since the start."""
        return self._steps / ODOMETRY_HZ

    @property
    def is_heard(self) -> bool:
        """Whether somebody reads the odometry."""
        return bool(self._odom.get_subscription_count())

    def forget_correction(self) -> None:
        """Wait for a new map → odom, as after a restart."""
        self._correction = None

    def carry(self) -> None:
        """Put the robot down on the other side of the lap, which its wheels don't notice."""
        self._carried_s = self.time_s + 0.5 / ODOMETRY_HZ  # what it has published is from before
        self._truth = self.world.true_pose(self.time_s + 0.5 * self.world.lap_s)

    def _true_pose(self, time_s: float) -> FloatArray:
        ahead_s = 0.5 * self.world.lap_s if time_s >= self._carried_s else 0.0
        return self.world.true_pose(time_s + ahead_s)

    def step(self) -> None:
        """Move on, and publish what is measured."""
        self._steps += 1
        before, self._truth = self._truth, self._true_pose(self.time_s)
        self._odometry.advance(before, self._truth, 1.0 / ODOMETRY_HZ)
        stamp_ns = START_NS + to_ns(self.time_s)
        self._clock_publisher.publish(Clock(clock=MESSAGES.time(stamp_ns)))
        self._publish_odometry(stamp_ns)
        if self._steps % self.world.steps_per_image == 0:
            self._errors.go_on(self.world.steps_per_image / ODOMETRY_HZ)
            count = self._publish_tags(stamp_ns) + self._publish_scan(stamp_ns)
            count += self._publish_ranges(stamp_ns)
            by_tf = None if self._correction is None else self._correction @ self._odometry.pose
            self.seen.append(Seen(self.time_s, self._truth, by_tf, count))

    def _publish_odometry(self, stamp_ns: int) -> None:
        odometry = self._odometry
        message = Odometry(header=MESSAGES.header(stamp_ns, 'odom'), child_frame_id='base_link')
        message.pose.pose = MESSAGES.pose(odometry.pose)
        turn, forward = odometry.turn_rad_s, odometry.forward_m_s
        message.twist.twist = MESSAGES.twist(np.array([0.0, 0.0, turn, forward, 0.0, 0.0]))
        self._odom.publish(message)
        transform = MESSAGES.transform_stamped(stamp_ns, 'odom', 'base_link', odometry.pose)
        self._tf.publish(TFMessage(transforms=[transform]))

    def _publish_scan(self, stamp_ns: int) -> int:
        if self.world.scan is None:
            return 0
        landmarks, errors = self.world.landmarks, self._errors.values
        points = self.world.scan(self._truth, landmarks, errors, self._random)
        ids = np.full(len(points), UNKNOWN_ID)
        self._cloud.publish(MESSAGES.point_cloud2(stamp_ns, 'base_link', ids, points))
        return len(points)

    def _publish_ranges(self, stamp_ns: int) -> int:
        if self.world.ranges is None:
            return 0
        ranges_m = self.world.ranges(self._truth, self.world.landmarks, self._random)
        count = len(ranges_m)
        points = ranges_m[:, None] * [1.0, 0.0, 0.0]
        cloud = MESSAGES.point_cloud2(
            stamp_ns, 'base_link', np.arange(count), points, kinds=np.full(count, RANGE)
        )
        self._cloud.publish(cloud)
        return count

    def _publish_tags(self, stamp_ns: int) -> int:
        if self.world.sightings is None:
            return 0
        landmarks, errors = self.world.landmarks, self._errors.values
        tags = self.world.sightings(self._truth, landmarks, errors)
        transforms = [
            MESSAGES.transform_stamped(stamp_ns, CAMERA_FRAME, f'tag36h11:{tag_id}', pose)
            for tag_id, pose in tags.items()
        ]
        if transforms:
            self._tf.publish(TFMessage(transforms=transforms))
        return len(tags)

    def _hear_transforms(self, message: TFMessage) -> None:
        for each in message.transforms:
            if (each.header.frame_id, each.child_frame_id) == ('map', 'odom'):
                position, rotation = each.transform.translation, each.transform.rotation
                self._correction = _matrix(position, rotation)
                self.corrections_s.append(self.time_s)

    def _hear_pose(self, message: PoseWithCovarianceStamped) -> None:
        stamp = message.header.stamp
        time_s = stamp.sec + stamp.nanosec * 1e-9 - START_NS * 1e-9
        pose = message.pose.pose
        covariance = np.array(message.pose.covariance).reshape(6, 6)
        self.estimated.append(
            Estimated(
                time_s,
                self._true_pose(time_s),
                _matrix(pose.position, pose.orientation),
                covariance,
            )
        )


def _matrix(position: Any, rotation: Any) -> FloatArray:
    """Return the pose (4, 4) of a message's position and quaternion."""
    return pose_matrices(
        np.array([position.x, position.y, position.z]),
        np.array([rotation.x, rotation.y, rotation.z, rotation.w]),
    )


def error_of(truth: FloatArray, pose: FloatArray) -> FloatArray:
    """Return how far off a pose is in the plane: x, y and heading (3,), along the map's axes."""
    turn = pose[:3, :3] @ truth[:3, :3].T
    heading = np.arctan2(turn[1, 0], turn[0, 0])
    return np.array([*(pose[:2, 3] - truth[:2, 3]), heading])
