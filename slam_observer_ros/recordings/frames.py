"""Where sensors are: transforms of /tf and /tf_static, and measurements in the base frame.

The semantics of transforms are tf2's: each frame has one parent, dynamic transforms are
interpolated between their stamps and never extrapolated, static ones hold at all times. A slash
that leads, as ROS 1 had it, is ignored. Of a fiducial that several cameras see, and that has each
of them as its parent in turn, what each has seen is kept, too.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
import logging
from typing import TypeVar

import numpy as np

from slam_observer_ros.common.errors import TransformError
from slam_observer_ros.common.findings import found
from slam_observer_ros.common.stamps import NEAR_NS, StrayStamps, to_s
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import AngularVelocityEvent, BEARING, ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.messages.clouds import is_measured
from slam_observer_ros.messages.detections import Camera
from slam_observer_ros.messages.poses import pose_stack, PoseMessage
from slam_observer_ros.settings.node_settings import InputSettings
from slam_observer_ros.settings.parameter_table import checked

logger = logging.getLogger(__name__)

HISTORY_NS = 10_000_000_000  # how far back transforms are kept; tf2's default
ALWAYS_NS = 2**63 - 1  # newest stamp of what is static


@dataclass(slots=True)
class _Track:
    """Poses of one frame in its parent, by stamp; of a static one there is only the latest."""

    parent: str
    is_static: bool
    stamps_ns: list[int] = field(default_factory=list)
    poses: list[FloatArray] = field(default_factory=list)
    strays: StrayStamps = field(default_factory=StrayStamps)

    def insert(self, stamp_ns: int, pose: FloatArray) -> None:
        if not self.is_static:
            self._follow_jump(stamp_ns)
        position = 0 if self.is_static else bisect_left(self.stamps_ns, stamp_ns)
        is_known = self.is_static or self.stamps_ns[position : position + 1] == [stamp_ns]
        self.stamps_ns[position : position + is_known] = [stamp_ns]
        self.poses[position : position + is_known] = [pose]
        outdated = bisect_left(self.stamps_ns, self.stamps_ns[-1] - HISTORY_NS)
        del self.stamps_ns[:outdated], self.poses[:outdated]

    def _follow_jump(self, stamp_ns: int) -> None:
        """Forget all if stamps in a row are far behind the newest, one after the other.

        That is a straggler of the lap before, when a recording is looped: what is to come would
        seem too old.
        """
        if not self.stamps_ns or stamp_ns >= self.stamps_ns[-1] - NEAR_NS:
            self.strays.clear()
            return
        last_ns = self.strays.last_ns
        if (last_ns is None or stamp_ns > last_ns) and self.strays.add(stamp_ns):
            self.stamps_ns, self.poses = [], []

    def pose_at(self, stamp_ns: int) -> FloatArray | None:
        """Interpolate the pose (4, 4); None outside of what is known."""
        if self.is_static:
            return self.poses[0]
        after = bisect_left(self.stamps_ns, stamp_ns)
        if after == len(self.stamps_ns) or (after == 0 and self.stamps_ns[0] != stamp_ns):
            return None
        if self.stamps_ns[after] == stamp_ns:
            return self.poses[after]
        start_ns, end_ns = self.stamps_ns[after - 1 : after + 1]
        return se3.interpolate(
            self.poses[after - 1], self.poses[after], (stamp_ns - start_ns) / (end_ns - start_ns)
        )


class TransformBuffer:
    """A tree of frames over the last seconds.

    Attributes
    ----------
    cameras : dict of str to Camera
        What CameraInfo says of the cameras in some of the frames.

    """

    def __init__(self) -> None:
        self.cameras: dict[str, Camera] = {}
        self._tracks: dict[str, _Track] = {}  # of each frame in its newest parent
        self._of_parents: dict[tuple[str, str], _Track] = {}  # by parent and frame
        self._refused: set[str] = set()

    def insert(
        self, parent: str, child: str, stamp_ns: int, pose: FloatArray, *, is_static: bool = False
    ) -> None:
        """Take the pose (4, 4) of ``child`` in ``parent``; one of a frame to itself is refused."""
        parent, child = parent.lstrip('/'), child.lstrip('/')
        if parent == child:
            self.refuse(child, 'it is to the frame itself')
            return
        track = self._of_parents.get((parent, child))
        if track is None or track.is_static != is_static:
            track = self._of_parents[parent, child] = _Track(parent, is_static)
        self._tracks[child] = track
        track.insert(stamp_ns, pose)

    def refuse(self, child: str, reason: str) -> None:
        """Log, once for each frame, why a transform is not used."""
        if child not in self._refused:
            self._refused.add(child)
            logger.warning('%s', found('unused_transform', frame=child, reason=reason))

    def clear(self) -> None:
        """Forget what has a time, as after a jump of the clock; static transforms stay."""
        self._tracks = {child: track for child, track in self._tracks.items() if track.is_static}
        self._of_parents = {(track.parent, child): track for child, track in self._tracks.items()}

    def lookup(self, target: str, source: str, stamp_ns: int) -> FloatArray:
        """Return the pose (4, 4) of ``source`` in ``target``; TransformError if unknown then."""
        target_chain, source_chain = self._chains(target, source)
        return se3.inverse(self._pose(target_chain, stamp_ns)) @ self._pose(source_chain, stamp_ns)

    def lookup_child(self, parent: str, child: str, stamp_ns: int) -> FloatArray:
        """As :meth:`lookup`, but what came with this parent, if others give the frame one, too."""
        track = self._of_parents.get((parent.lstrip('/'), child.lstrip('/')))
        pose = None if track is None else track.pose_at(stamp_ns)
        return self.lookup(parent, child, stamp_ns) if pose is None else pose

    def parent_of(self, frame: str) -> str | None:
        """Return the parent of a frame; None if it has none."""
        track = self._tracks.get(frame.lstrip('/'))
        return None if track is None else track.parent

    def newest_ns(self, target: str, source: str) -> int | None:
        """Return the newest stamp at which both frames are known; None if they are not connected.

        :data:`ALWAYS_NS` if all between them is static.
        """
        try:
            chains = self._chains(target, source)
        except TransformError:
            return None
        tracks = [self._tracks[frame] for chain in chains for frame in chain]
        moving = (track.stamps_ns[-1] for track in tracks if not track.is_static)
        return min(moving, default=ALWAYS_NS)

    def _chains(self, target: str, source: str) -> tuple[list[str], list[str]]:
        """Return the frames from each of the two up to below the first that both have above."""
        target, source = target.lstrip('/'), source.lstrip('/')
        target_chain, source_chain = self._ancestry(target), self._ancestry(source)
        common = next((frame for frame in source_chain if frame in target_chain), None)
        if common is None:
            raise TransformError(f"'{source}' and '{target}' are not connected on /tf")
        return (
            target_chain[: target_chain.index(common)],
            source_chain[: source_chain.index(common)],
        )

    def _ancestry(self, frame: str) -> list[str]:
        """Return the frame, its parent, and so on up to the root."""
        chain = [frame]
        while (track := self._tracks.get(chain[-1])) is not None:
            if track.parent in chain:
                raise TransformError(f"'{frame}' is its own ancestor on /tf")
            chain.append(track.parent)
        return chain

    def _pose(self, chain: list[str], stamp_ns: int) -> FloatArray:
        """Return the pose (4, 4) of the chain's first frame in the last one's parent."""
        pose = np.eye(4)
        for frame in chain:
            track = self._tracks[frame]
            step = track.pose_at(stamp_ns)
            if step is None:
                raise TransformError(
                    f"'{track.parent}' to '{frame}' is known "
                    f'from {to_s(track.stamps_ns[0]):.3f} to {to_s(track.stamps_ns[-1]):.3f} s, '
                    f'not at {to_s(stamp_ns):.3f} s'
                )
            pose = step @ pose
        return pose


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
        settings = checked(settings).with_plain_frames()
        self._transforms = transforms
        self.name = settings.base_frame
        self._map_frame = settings.map_frame
        self._world_frames = {self._map_frame, settings.odom_frame} - {''}
        self._sensor_frame = settings.sensor_frame
        self._tag_frame_prefix = settings.tag_frame_prefix
        pose = settings.sensor_pose  # all zeros: from /tf
        self._sensor_pose = se3.from_rpy(pose) if any(pose) else None
        self._is_rectified = settings.image_is_rectified
        self._without_poses: set[str] = set()  # frames of cameras whose tags /tf does not have

    def observation(self, event: ObservationEvent) -> ObservationEvent:
        """Return landmarks in the base frame; those measured in the map's frame are refused.

        Its ``sensor_frame`` is '' where they were measured in the base frame itself. Fiducials
        are where /tf has them in the camera's frame; what only an image shows is a direction.
        """
        frame_id = self._sensor_frame or event.sensor_frame
        has_poses = event.sensor_frame.lstrip('/') not in self._without_poses
        if event.families is not None and (has_poses or self._is_any_on_tf(event)):
            event = self._placed_tags(event, event.families, frame_id)
        elif event.pixels is not None:
            event = self._seen_directions(event)
        plain = frame_id.lstrip('/')
        axis = _ALONG_Z if OPTICAL in plain else _ALONG_X
        event = replace(event, sensor_frame='' if plain == self.name else plain, sensor_axis=axis)
        if self._sensor_pose is not None:
            return event.moved(self._sensor_pose)
        self._refuse_map_frame(frame_id)
        return self._moved(event, frame_id)

    def velocity(self, event: VelocityEvent) -> VelocityEvent:
        """Return the velocity of the base, given the velocity of a frame on the robot."""
        if event.sensor_frame.lstrip('/') in self._world_frames:
            raise TransformError(f"'{event.sensor_frame}' does not move with the robot")
        return self._moved(event, event.sensor_frame)

    def is_base(self, frame_id: str) -> bool:
        """Return whether velocities in a frame are the base's as they are."""
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
        return replace(event, points=poses[:, :3, 3], orientations=R, families=None, pixels=None)

    def give_up_poses(self, event: ObservationEvent) -> bool:
        """Return whether fiducials whose poses have not come in time are directions from now on.

        They are where their camera is known, and /tf has never had any of them: their size is
        not known to the detector then.
        """
        camera = event.sensor_frame.lstrip('/')
        has_pixels = event.families is not None and event.pixels is not None
        if not has_pixels or camera not in self._transforms.cameras or self._is_any_on_tf(event):
            return False
        if camera not in self._without_poses:
            self._without_poses.add(camera)
            logger.info(
                "Fiducials in '%s' are directions from now on: /tf does not have where they are.",
                camera,
            )
        return True

    def expect_no_poses(self) -> None:
        """Take fiducials of all known cameras for directions: their poses will not come."""
        self._without_poses |= set(self._transforms.cameras)

    def _is_any_on_tf(self, event: ObservationEvent) -> bool:
        """Return whether /tf has, or had, the frame of one of the fiducials."""
        families, prefix = event.families or (), self._tag_frame_prefix
        names = [
            name
            for family, number in zip(families, event.ids.tolist(), strict=True)
            for name in (f'{family}:{number}', f'{prefix}{number}')
        ]
        return any(self._transforms.parent_of(name) is not None for name in names)

    def _seen_directions(self, event: ObservationEvent) -> ObservationEvent:
        """Return what an image shows as directions, in the axes of its camera."""
        camera = self._transforms.cameras.get(event.sensor_frame.lstrip('/'))
        if camera is None or event.pixels is None:
            raise TransformError(
                f"no CameraInfo of '{event.sensor_frame}' has come (on camera_info), without "
                'which a pixel is no direction'
            )
        # Fiducials are found in the rectified image, whose name apriltag_ros subscribes to.
        is_rectified = self._is_rectified or event.families is not None
        directions = camera.directions(event.pixels, is_rectified=is_rectified)
        kinds = np.full(len(directions), BEARING)
        seen = replace(event, points=directions, kinds=kinds, families=None, pixels=None)
        return seen.select(is_measured(directions))

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
