"""A robot that publishes events as its sensors would."""

from __future__ import annotations

import time

from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import PointCloud, PointCloud2

from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.nodes.conversions import (
    header_message,
    point_cloud2_message,
    twist_message,
)
from slam_observer_ros.recording.point_cloud_layout import encode_point_cloud
from slam_observer_ros.simulation import Simulation


class Robot:
    """Publishes events as a robot's sensors would."""

    def __init__(
        self,
        ros,
        twist_class=TwistStamped,
        cloud_class=PointCloud2,
        namespace='',
        frame_id='base_link',
    ):
        self.ros = ros
        self.frame_id = frame_id
        self.twist_class = twist_class
        self.cloud_class = cloud_class
        self.twist = ros.node.create_publisher(twist_class, f'{namespace}/twist', 1000)
        self.landmarks = ros.node.create_publisher(cloud_class, f'{namespace}/landmarks', 1000)

    def __enter__(self):
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
        twist = twist_message(event.body_velocity)
        header = header_message(event.stamp_ns, self.frame_id)
        if self.twist_class is Twist:
            return twist
        if self.twist_class is TwistStamped:
            return TwistStamped(header=header, twist=twist)
        message = Odometry(header=header, child_frame_id=self.frame_id)
        message.twist.twist = twist
        return message

    def _observation(self, event):
        contents = (event.stamp_ns, self.frame_id, event.ids, event.points)
        if self.cloud_class is PointCloud:
            return encode_point_cloud(*contents)
        return point_cloud2_message(*contents, velocities=event.velocities)


def stamp_ns(message):
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
