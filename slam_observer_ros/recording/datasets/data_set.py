"""What every data set is read into, and its way into a recording."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.evaluation.run_record import LandmarkTruth, PoseTruth
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.recording.writer import RecordingWriter


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
