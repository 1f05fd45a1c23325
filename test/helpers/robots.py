"""A robot that publishes events as its sensors would."""

from __future__ import annotations

import time

from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
import numpy as np
from sensor_msgs.msg import PointCloud, PointCloud2

from slam_observer_ros.common.stamps import AGREEING_STAMPS
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.messages.outgoing import encode_point_cloud
from slam_observer_ros.messages.poses import pose_matrices
from slam_observer_ros.nodes.ros_node import LATCHED_QOS, MESSAGES, TFMessage
from slam_observer_ros.simulation import Simulation


def reliable(namespace='', **policies):
    """Return the parameters by which an observer hears a robot reliably, with more policies."""
    return {
        f'qos_overrides.{namespace}/{topic}.subscription.{policy}': value
        for topic in ('twist', 'landmarks')
        for policy, value in {'reliability': 'reliable', **policies}.items()
    }


class Robot:
    """Publishes events as a robot's sensors would."""

    def __init__(
        self,
        ros,
        twist_class=TwistStamped,
        cloud_class=PointCloud2,
        namespace='',
        frame_id='base_link',
        sensor_frame_id=None,
        subscribers=True,
    ):
        self.ros = ros
        self.subscribers = subscribers
        self.frame_id = frame_id
        self.sensor_frame_id = sensor_frame_id or frame_id
        self.twist_class = twist_class
        self.cloud_class = cloud_class
        self.twist = ros.node.create_publisher(twist_class, f'{namespace}/twist', 1000)
        self.landmarks = ros.node.create_publisher(cloud_class, f'{namespace}/landmarks', 1000)

    def __enter__(self):
        if self.subscribers:
            self.ros.wait_for_subscriber(self.twist, self.landmarks)
        return self

    def __exit__(self, *_error):
        self.ros.node.destroy_publisher(self.twist)
        self.ros.node.destroy_publisher(self.landmarks)

    def send(self, event):
        if isinstance(event, VelocityEvent):
            self.twist.publish(self._velocity(event))
        elif isinstance(event, ObservationEvent):
            self.landmarks.publish(self._observation(event))

    def send_zeros(self):
        """Stand still for long enough that nothing is held back, even after a pause."""
        for _ in range(AGREEING_STAMPS + 2):
            self.send(VelocityEvent(time.time_ns(), np.zeros(6)))
            self.ros.spin_for(0.06)

    def run(self, scenario):
        """Publish a simulated run in real time; return its events in order of arrival."""
        start_ns, start_s = time.time_ns(), time.monotonic()
        deliveries = list(Simulation(scenario, start_ns).deliveries())
        for delivery in deliveries:
            due_s = start_s + (delivery.arrival_ns - start_ns) * 1e-9
            self.ros.spin_for(due_s - time.monotonic())
            self.send(delivery.event)
        return [
            delivery.event
            for delivery in deliveries
            if isinstance(delivery.event, VelocityEvent | ObservationEvent)
        ]

    def _velocity(self, event):
        if self.twist_class is Twist:
            return MESSAGES.twist(event.body_velocity)
        if self.twist_class is TwistStamped:
            return MESSAGES.twist_stamped(event.stamp_ns, self.frame_id, event.body_velocity)
        header = MESSAGES.header(event.stamp_ns, self.frame_id)
        message = Odometry(header=header, child_frame_id=self.frame_id)
        message.twist.twist = MESSAGES.twist(event.body_velocity)
        return message

    def _observation(self, event):
        contents = (event.stamp_ns, self.sensor_frame_id, event.ids, event.points)
        if self.cloud_class is PointCloud:
            return encode_point_cloud(*contents)
        return MESSAGES.point_cloud2(*contents, velocities=event.velocities)


class TransformSender:
    """Publishes on a robot's /tf and /tf_static, to which the node's are remapped."""

    def __init__(self, ros, namespace):
        self.ros = ros
        self.dynamic = ros.node.create_publisher(TFMessage, f'{namespace}/tf', 1000)
        self.static = ros.node.create_publisher(TFMessage, f'{namespace}/tf_static', LATCHED_QOS)

    def send(self, *poses, stamp_ns=0):
        """Publish (parent, child, pose) in one message; without stamp they are static."""
        publisher = self.dynamic if stamp_ns else self.static
        publisher.publish(
            TFMessage(
                transforms=[
                    MESSAGES.transform_stamped(stamp_ns, parent, child, pose)
                    for parent, child, pose in poses
                ]
            )
        )


def own_topics(namespace):
    """Return the arguments that give a node a namespace and a /tf of its own."""
    remaps = [f'__ns:={namespace}', f'/tf:={namespace}/tf', f'/tf_static:={namespace}/tf_static']
    return [argument for remap in remaps for argument in ('-r', remap)]


def pose_of(transform):
    """Return a geometry_msgs/Transform as a pose (4, 4)."""
    t, q = transform.translation, transform.rotation
    return pose_matrices(np.array([t.x, t.y, t.z]), np.array([q.x, q.y, q.z, q.w]))


def stamp_ns(message):
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
