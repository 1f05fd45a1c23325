"""The paper's simulation as a ROS 2 node, with the truth beside the measurements."""

from __future__ import annotations

from collections.abc import Iterator
import time

from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from rclpy.duration import Duration
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud, PointCloud2

from slam_observer_ros.common.stamps import to_ns
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.messages.outgoing import encode_point_cloud
from slam_observer_ros.nodes.ros_node import (
    declare_settings,
    LATCHED_QOS,
    MESSAGES,
    read_settings,
    RepeatableParameters,
    ThrottledLog,
)
from slam_observer_ros.nodes.transforms import TransformPublisher
from slam_observer_ros.recordings.trajectory import PoseTruth
from slam_observer_ros.settings.node_settings import SimulatorNodeSettings
from slam_observer_ros.simulation import Delivery, Scenario, SimulatedEvent, Simulation

QUEUE_DEPTH = 1000  # nothing is lost while a reliable reader falls behind for a moment
TICK_S = 0.005  # wall time between two checks of what is due
MATCH_DELAY_S = 1.0  # a publisher knows of its reader before the reader can receive
ACKNOWLEDGED_S = 10.0  # how long the first and last messages may be on their way, if it is busy
SIMULATED_EPOCH_NS = 1_000_000_000  # first stamp of a simulated /clock; zero means 'no time yet'


class SimulatorNode(RepeatableParameters):
    """Publishes a :class:`Simulation` in real time, or faster or slower with ``/clock``."""

    def __init__(self) -> None:
        super().__init__('simulator_node')
        declare_settings(self, Scenario, SimulatorNodeSettings)
        self._settings = read_settings(self, SimulatorNodeSettings)
        self._scenario = read_settings(self, Scenario)
        self._log = ThrottledLog(self)
        twist_class = TwistStamped if self._settings.stamped else Twist
        is_cloud2 = self._settings.landmarks_type == 'PointCloud2'
        cloud_class = PointCloud2 if is_cloud2 else PointCloud
        self._twist = self.create_publisher(twist_class, 'twist', QUEUE_DEPTH)
        self._landmarks = self.create_publisher(cloud_class, 'landmarks', QUEUE_DEPTH)
        self._true_pose = self.create_publisher(PoseStamped, 'ground_truth/pose', QUEUE_DEPTH)
        self._true_landmarks = self.create_publisher(
            PointCloud2, 'ground_truth/landmarks', LATCHED_QOS
        )
        self._publishes_clock = self._settings.real_time_factor != 1.0
        if self._publishes_clock:
            self._clock_publisher = self.create_publisher(Clock, '/clock', 10)
        self._wait_timer = self.create_steady_timer(TICK_S, self._wait)

    def _wait(self) -> None:
        """Start once the subscribers are there: the biased first sighting must not be missed."""
        needed = self._settings.wait_for_subscribers
        missing = [
            publisher.topic_name
            for publisher in (self._twist, self._landmarks)
            if publisher.get_subscription_count() < needed
        ]
        if missing:
            topics = ' and '.join(missing)
            self._log.info(
                'waiting',
                f'waiting for {needed} subscriber(s) on {topics} (parameter wait_for_subscribers)',
            )
            return
        self.destroy_timer(self._wait_timer)
        delay_s = MATCH_DELAY_S if needed else 0.0
        self._start_timer = self.create_steady_timer(delay_s, self._start)

    def _start(self) -> None:
        self.destroy_timer(self._start_timer)
        self._start_ns = (
            SIMULATED_EPOCH_NS if self._publishes_clock else self.get_clock().now().nanoseconds
        )
        self._simulation = Simulation(self._scenario, self._start_ns)
        self._deliveries: Iterator[Delivery] = self._simulation.deliveries()
        self._next: Delivery | None = next(self._deliveries, None)
        self._publish_true_landmarks(self._start_ns)
        # The pose, in the true world, of an estimate that starts at the identity
        self._start_transform = TransformPublisher(self, '/tf_static', LATCHED_QOS)
        self._start_transform.publish(
            self._start_ns,
            self._settings.truth_frame,
            self._settings.map_frame,
            self._simulation.pose(self._start_ns),
        )
        self._give_up_s = time.monotonic()
        if self._publishes_clock:  # which can stand still until reliable readers have heard
            self._publish_until(self._start_ns)
            self._give_up_s += ACKNOWLEDGED_S
        self._start_timer = self.create_steady_timer(TICK_S, self._drive)

    def _drive(self) -> None:
        """Let time pass once the first messages are acknowledged: their readers hear the rest."""
        at_once = Duration()
        publishers = (self._twist, self._landmarks)
        are_heard = all(publisher.wait_for_all_acked(at_once) for publisher in publishers)
        if not are_heard and time.monotonic() < self._give_up_s:
            return
        self.destroy_timer(self._start_timer)
        self._start_wall_s = time.monotonic()
        self.create_steady_timer(TICK_S, self._publish_due)
        self.get_logger().info('the robot starts')

    def _publish_due(self) -> None:
        elapsed_s = (time.monotonic() - self._start_wall_s) * self._settings.real_time_factor
        self._publish_until(self._start_ns + to_ns(elapsed_s))
        if self._next is None:
            for publisher in (self._twist, self._landmarks, self._true_pose):
                publisher.wait_for_all_acked(Duration(seconds=ACKNOWLEDGED_S))
            self.get_logger().info('the run is over')
            self.context.try_shutdown()

    def _publish_until(self, now_ns: int) -> None:
        if self._publishes_clock:
            self._clock_publisher.publish(Clock(clock=MESSAGES.time(now_ns)))
        while self._next is not None and self._next.arrival_ns <= now_ns:
            self._publish(self._next.event)
            self._next = next(self._deliveries, None)

    def _publish(self, event: SimulatedEvent) -> None:
        match event:
            case VelocityEvent(stamp_ns, velocity) if self._settings.stamped:
                frame = self._settings.base_frame
                self._twist.publish(MESSAGES.twist_stamped(stamp_ns, frame, velocity))
            case VelocityEvent():
                self._twist.publish(MESSAGES.twist(event.body_velocity))
            case ObservationEvent():
                contents = (event.stamp_ns, self._settings.base_frame, event.ids, event.points)
                if self._settings.landmarks_type == 'PointCloud2':
                    cloud = MESSAGES.point_cloud2(*contents, velocities=event.velocities)
                    self._landmarks.publish(cloud)
                else:
                    self._landmarks.publish(encode_point_cloud(*contents))
            case PoseTruth(stamp_ns, pose):
                frame = self._settings.truth_frame
                self._true_pose.publish(MESSAGES.pose_stamped(stamp_ns, frame, pose))
                if self._scenario.landmark_speed > 0.0:
                    self._publish_true_landmarks(stamp_ns)

    def _publish_true_landmarks(self, stamp_ns: int) -> None:
        truth = self._simulation.landmark_truth(stamp_ns)
        self._true_landmarks.publish(
            MESSAGES.point_cloud2(
                stamp_ns, self._settings.truth_frame, truth.ids, truth.world_points
            )
        )
