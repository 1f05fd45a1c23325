"""Where sensors are: measurements brought into the base frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from slam_observer_ros.common.errors import ParameterError, TransformError
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import AngularVelocityEvent, ObservationEvent, VelocityEvent
from slam_observer_ros.geometry import se3
from slam_observer_ros.inputs.transform_buffer import TransformBuffer
from slam_observer_ros.messages.poses import pose_stack, PoseMessage
from slam_observer_ros.settings.input_settings import InputSettings, Pose6

OPTICAL = 'optical'
"""What the name of a frame has, by REP 103, whose axis z points forward; of others x does."""

_ALONG_X, _ALONG_Z = np.eye(3)[[0, 2]]

EventT = TypeVar('EventT', ObservationEvent, VelocityEvent, AngularVelocityEvent)


def insert_transforms(
    buffer: TransformBuffer, transforms: Sequence[PoseMessage], *, is_static: bool
) -> None:
    """Put the transforms of a message on /tf or /tf_static into a buffer, without the bad ones."""
    good = []
    for transform in transforms:
        if problem := transform.problem:
            buffer.refuse(transform.child_frame_id, problem)
        else:
            good.append(transform)
    for transform, pose in zip(good, pose_stack(good), strict=True):
        buffer.insert(
            transform.frame_id,
            transform.child_frame_id,
            transform.stamp_ns,
            pose,
            is_static=is_static,
        )


class BaseFrame:
    """Brings measurements into the base frame, whose ``name`` it knows.

    A message without frame is taken to be in the base frame already. What needs a transform that
    is not known (yet) raises a TransformError. A map's frame without name is a ParameterError,
    and so is an angle of ``sensor_pose`` beyond 2π, as those in degrees are.
    """

    def __init__(self, settings: InputSettings, transforms: TransformBuffer) -> None:
        settings = settings.with_plain_frames()
        self._transforms = transforms
        self.name = settings.base_frame
        self._map_frame = settings.map_frame
        self._world_frames = {self._map_frame, settings.odom_frame} - {''}
        self._sensor_frame = settings.sensor_frame
        self._tag_frame_prefix = settings.tag_frame_prefix
        self._sensor_pose = _sensor_pose(settings.sensor_pose)

    def observation(self, event: ObservationEvent) -> ObservationEvent:
        """Return landmarks in the base frame; those measured in the map's frame are refused.

        Its ``sensor_frame`` is '' where they were measured in the base frame itself. Fiducials
        are where /tf has them in the camera's frame.
        """
        frame_id = self._sensor_frame or event.sensor_frame
        if event.families is not None:
            event = self._placed_tags(event, event.families, frame_id)
        plain = frame_id.lstrip('/')
        axis = _ALONG_Z if OPTICAL in plain else _ALONG_X
        event = replace(event, sensor_frame='' if plain == self.name else plain, sensor_axis=axis)
        if self._sensor_pose is not None:
            return event.moved(self._sensor_pose)
        self._refuse_map_frame(frame_id)
        return self._moved(event, frame_id)

    def velocity(self, event: VelocityEvent) -> VelocityEvent:
        """Return the velocity of the base, given that of a frame that moves with the robot."""
        if event.sensor_frame.lstrip('/') in self._world_frames:
            raise TransformError(f"'{event.sensor_frame}' does not move with the robot")
        return self._moved(event, event.sensor_frame)

    def is_base(self, frame_id: str) -> bool:
        """Return whether velocities in a frame are those of the base as they are."""
        plain = frame_id.lstrip('/')
        return plain in ('', self.name) and plain not in self._world_frames

    def angular_velocity(self, event: AngularVelocityEvent) -> AngularVelocityEvent:
        """Return an angular velocity in the base frame's axes."""
        return self._moved(event, event.sensor_frame)

    def _placed_tags(
        self, event: ObservationEvent, families: tuple[str, ...], camera_frame: str
    ) -> ObservationEvent:
        self._refuse_map_frame(camera_frame)
        found = [
            self._tag_pose(camera_frame, family, number, event.stamp_ns)
            for family, number in zip(families, event.ids.tolist(), strict=True)
        ]
        poses = np.array(found).reshape(-1, 4, 4)
        R = poses[:, :3, :3]
        R[(np.eye(3) == R).all(axis=(1, 2))] = 0.0  # unknown, as where nobody filled it in
        return replace(event, points=poses[:, :3, 3], orientations=R, families=None)

    def _refuse_map_frame(self, frame_id: str) -> None:
        """Refuse landmarks that the estimate itself would bring to where it has them."""
        if frame_id.lstrip('/') == self._map_frame != '':
            raise TransformError(
                f"landmarks are given in '{self._map_frame}', which is estimated from these very "
                "landmarks: publish them in the sensor's frame"
            )

    def _moved(self, event: EventT, frame_id: str) -> EventT:
        if frame_id.lstrip('/') in ('', self.name):
            return event
        try:
            return event.moved(self._transforms.lookup(self.name, frame_id, event.stamp_ns))
        except TransformError as error:
            if hint := self._prefix_hint(frame_id):
                raise TransformError(f'{error}; {hint}') from error
            raise

    def _prefix_hint(self, frame_id: str) -> str:
        """Say what may be meant where frames that are not connected have other prefixes."""
        prefix = frame_id.lstrip('/').rpartition('/')[0]
        base_prefix, _, base = self.name.rpartition('/')
        if prefix == base_prefix or self._transforms.newest_ns(self.name, frame_id) is not None:
            return ''
        meant = f'{prefix}/{base}' if prefix else base
        return f"'{frame_id}' has another prefix than base_frame: set that to '{meant}'"

    def _tag_pose(self, camera: str, family: str, number: int, stamp_ns: int) -> FloatArray:
        """Return the pose (4, 4) of a tag in the camera's frame, under either of its names."""
        try:
            return self._transforms.lookup_child(camera, f'{family}:{number}', stamp_ns)
        except TransformError as error:
            reason = error
        try:
            frame = f'{self._tag_frame_prefix}{number}'
            return self._transforms.lookup_child(camera, frame, stamp_ns)
        except TransformError as error:
            raise TransformError(f'{reason}; {error}') from error


def _sensor_pose(values: Pose6) -> FloatArray | None:
    """Return the sensor's pose (4, 4) of the settings; None if they give none."""
    angles_rad = list(values[3:])
    if np.max(np.abs(angles_rad)) > 2.0 * np.pi:
        raise ParameterError(
            f"parameter 'sensor_pose': roll, pitch and yaw are radians, which {angles_rad} are not"
        )
    return se3.from_rpy(values) if any(values) else None
