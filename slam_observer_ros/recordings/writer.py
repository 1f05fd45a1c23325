"""Writing of recordings: one MCAP file that ros2 bag, Foxglove and our own reader play.

Every public data set is read into a :class:`DataSet`, and written from it.
"""

from __future__ import annotations

from collections import Counter
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer, WriterError
from rosbags.typesys import get_typestore, Stores

from slam_observer_ros.common.errors import failing, RecordingError
from slam_observer_ros.common.files import destination, unfinished_directory
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.messages.cdr import Buffer
from slam_observer_ros.messages.outgoing import OutgoingMessages
from slam_observer_ros.recordings.trajectory import LandmarkTruth, PoseTruth

VELOCITY_TOPIC = '/twist'
LANDMARKS_TOPIC = '/landmarks'
POSE_TRUTH_TOPIC = '/ground_truth/pose'
LANDMARK_TRUTH_TOPIC = '/ground_truth/landmarks'
BASE_FRAME = 'base_link'
MAP_FRAME = 'map'

_NO_LIMIT = QosTime(0, 0)
_LATCHED = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    _NO_LIMIT,
    _NO_LIMIT,
    QosLiveliness.AUTOMATIC,
    _NO_LIMIT,
    False,
)


class RecordingWriter:
    """Writes messages to a .mcap file that appears, whole, when the ``with`` block ends.

    After an error in the block there is none. ``messages`` makes what it writes. Raises a
    RecordingError if the file exists and may not be replaced, isn't named .mcap, or can't be
    written, as on a full disk.
    """

    def __init__(self, path: Path | str, overwrite: bool = False) -> None:
        self.path = Path(path)
        self._overwrite = overwrite
        self._connections: dict[tuple[str, str], Connection] = {}
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        self.messages = OutgoingMessages(
            self._typestore.types.__getitem__, lambda data: np.frombuffer(data, np.uint8)
        )
        if self.path.suffix != '.mcap':
            raise RecordingError(f'{self.path}: recordings are written as .mcap files')
        self._refuse_to_overwrite()
        self._directory = ExitStack()
        with failing(RecordingError, f"can't write {self.path}"):
            # Beside its destination, so that the file can be moved there in one step.
            directory = destination(self.path).parent
            unfinished = self._directory.enter_context(unfinished_directory(directory))
        self._bag = Writer(
            unfinished / self.path.stem,
            version=Writer.VERSION_LATEST,
            storage_plugin=StoragePlugin.MCAP,
        )
        self._bag.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._bag.open()

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _traceback: object) -> None:
        if error is None:
            self.close()
        else:
            self.abort()

    def close(self) -> None:
        """Finish the file and put it in its place."""
        with self._directory:
            try:
                self._bag.close()
                self._refuse_to_overwrite()
                (self._bag.path / self.path.name).replace(destination(self.path))
            except WriterError as error:
                raise RecordingError(f'{self.path}: {error}') from error
            except OSError as error:
                raise RecordingError(f"can't write {self.path}: {error.strerror}") from error

    def abort(self) -> None:
        """Leave nothing behind."""
        # On a full disk closing fails, too; the file goes with its directory.
        with self._directory, suppress(OSError):
            self._bag.abort()

    def write(
        self,
        topic: str,
        message_type: str,
        data: Buffer,
        receive_stamp_ns: int,
        latched: bool = False,
    ) -> None:
        """Write a message of a type such as ``geometry_msgs/msg/Twist`` from its CDR bytes.

        Messages play in the order of their receive stamps, nanoseconds; players keep latched ones
        for late subscribers.
        """
        key = (topic, message_type)
        if key not in self._connections:
            self._connections[key] = self._bag.add_connection(
                topic,
                message_type,
                typestore=self._typestore,
                offered_qos_profiles=[_LATCHED] if latched else [],
            )
        with failing(RecordingError, f"can't write {self.path}"):
            self._bag.write(self._connections[key], receive_stamp_ns, memoryview(data))

    def knows(self, message_type: str) -> bool:
        """Return whether messages of a type can be written."""
        return message_type in self._typestore.types

    def write_event(self, event: VelocityEvent | ObservationEvent | PoseTruth) -> None:
        """Write a velocity, an observation or a true pose to its default topic."""
        if isinstance(event, VelocityEvent):
            self.write_velocity(event)
        elif isinstance(event, ObservationEvent):
            self.write_observation(event)
        else:
            self.write_pose(event)

    def write_velocity(
        self,
        event: VelocityEvent,
        topic: str = VELOCITY_TOPIC,
        frame_id: str = BASE_FRAME,
        receive_stamp_ns: int | None = None,
    ) -> None:
        """Write a TwistStamped, received at its stamp by default; it can hold no covariance."""
        message = self.messages.twist_stamped(event.stamp_ns, frame_id, event.body_velocity)
        self.write_message(topic, message, event.stamp_ns, receive_stamp_ns)

    def write_observation(
        self,
        event: ObservationEvent,
        topic: str = LANDMARKS_TOPIC,
        frame_id: str = BASE_FRAME,
        receive_stamp_ns: int | None = None,
    ) -> None:
        """Write a PointCloud2 with ids, and what else the event has of its points."""
        message = self.messages.point_cloud2(
            event.stamp_ns,
            frame_id,
            event.ids,
            event.lines_of_sight if event.kinds is not None else event.points,
            event.covariances,
            event.velocities,
            event.kinds,
        )
        self.write_message(topic, message, event.stamp_ns, receive_stamp_ns)

    def write_pose(self, truth: PoseTruth) -> None:
        """Write a true pose as PoseStamped."""
        message = self.messages.pose_stamped(truth.stamp_ns, MAP_FRAME, truth.pose)
        self.write_message(POSE_TRUTH_TOPIC, message, truth.stamp_ns)

    def write_landmarks(self, stamp_ns: int, truth: LandmarkTruth) -> None:
        """Write true landmark positions as a latched PointCloud2 with ids."""
        message = self.messages.point_cloud2(stamp_ns, MAP_FRAME, truth.ids, truth.world_points)
        self.write_message(LANDMARK_TRUTH_TOPIC, message, stamp_ns, latched=True)

    def write_message(
        self,
        topic: str,
        message: object,
        stamp_ns: int,
        receive_stamp_ns: int | None = None,
        latched: bool = False,
    ) -> None:
        """Write what :attr:`messages` has made, received at its stamp by default, nanoseconds."""
        message_type: str = message.__msgtype__  # type: ignore[attr-defined]
        data = self._typestore.serialize_cdr(message, message_type)
        received = stamp_ns if receive_stamp_ns is None else receive_stamp_ns
        self.write(topic, message_type, data, received, latched)

    def _refuse_to_overwrite(self) -> None:
        if self.path.exists() and not self._overwrite:
            raise RecordingError(f'{self.path}: exists already, and is not overwritten')


@dataclass(frozen=True, slots=True)
class DataSet:
    """One run of one robot, in its body frame.

    ``body_velocities`` (k, 6) are angular then linear, rad/s and m/s; ``true_poses`` (p, 4, 4)
    body to world. The observations are in stamp order and none is empty; ``left_out`` counts
    measurements that are no landmark observations, by reason. The truth may be empty.
    """

    velocity_stamps_ns: IntArray
    body_velocities: FloatArray
    observations: list[ObservationEvent]
    truth_stamps_ns: IntArray
    true_poses: FloatArray
    landmarks: LandmarkTruth
    left_out: Counter[str] = field(default_factory=Counter)


def write_data_set(data_set: DataSet, out: Path | str, overwrite: bool = False) -> None:
    """Write velocities, observations and truth in stamp order, with a :class:`RecordingWriter`."""
    # At equal stamps the velocity comes first, then what is seen, then the truth.
    velocities = [
        VelocityEvent(stamp_ns, body_velocity)
        for stamp_ns, body_velocity in zip(
            data_set.velocity_stamps_ns.tolist(), data_set.body_velocities, strict=True
        )
    ]
    true_poses = [
        PoseTruth(stamp_ns, pose)
        for stamp_ns, pose in zip(
            data_set.truth_stamps_ns.tolist(), data_set.true_poses, strict=True
        )
    ]
    items: list[VelocityEvent | ObservationEvent | PoseTruth] = [
        *velocities,
        *data_set.observations,
        *true_poses,
    ]
    order = np.argsort([item.stamp_ns for item in items], kind='stable')
    with RecordingWriter(out, overwrite) as writer:
        if len(data_set.landmarks.ids):
            writer.write_landmarks(items[order[0]].stamp_ns, data_set.landmarks)
        for index in order:
            writer.write_event(items[index])
