"""Events measured in a sensor's frame, as the base frame has them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import AngularVelocityEvent, ObservationEvent, VelocityEvent
from slam_observer_ros.geometry import se3


def move_observation(event: ObservationEvent, pose: FloatArray) -> ObservationEvent:
    """Express an observation in another frame.

    Parameters
    ----------
    event : ObservationEvent
        As measured in a sensor's frame.
    pose : FloatArray
        (4, 4) pose of that frame in the new one.

    """
    R = pose[:3, :3]
    sensor = np.zeros_like(event.points) if event.sensor is None else event.sensor
    return replace(
        event,
        points=se3.transform(pose, event.points),
        covariances=None if event.covariances is None else R @ event.covariances @ R.T,
        velocities=None if event.velocities is None else se3.rotate(pose, event.velocities),
        sensor=se3.transform(pose, sensor),
    )


def move_velocity(event: VelocityEvent, pose: FloatArray) -> VelocityEvent:
    """Give the velocity of the base whose sensor moves as ``event`` says.

    Both move as one rigid body, so V_base = Ad_T V_sensor: where the sensor turns off the base's
    origin, the linear velocity has a lever arm.

    Parameters
    ----------
    event : VelocityEvent
        Velocity of the sensor's frame, expressed in it.
    pose : FloatArray
        (4, 4) pose T of the sensor's frame in the base frame, which does not change.

    """
    Ad = se3.adjoint(pose)
    covariance = event.covariance
    if covariance is not None:
        is_linear_known = covariance[3:, 3:].any()
        covariance = Ad @ covariance @ Ad.T
        if not is_linear_known:  # what the lever arm adds to it would pass for all of it
            covariance[3:] = covariance[:, 3:] = 0.0
    return replace(event, body_velocity=Ad @ event.body_velocity, covariance=covariance)


def turn_angular_velocity(event: AngularVelocityEvent, pose: FloatArray) -> AngularVelocityEvent:
    """Express an angular velocity along the axes of another frame.

    Parameters
    ----------
    event : AngularVelocityEvent
        As measured in a sensor's frame.
    pose : FloatArray
        (4, 4) pose of that frame in the new one.

    """
    R, covariance = pose[:3, :3], event.covariance
    return replace(
        event,
        angular_velocity=R @ event.angular_velocity,
        covariance=None if covariance is None else R @ covariance @ R.T,
    )
