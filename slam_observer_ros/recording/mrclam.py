"""UTIAS Multi-Robot Cooperative Localization and Mapping: wheeled robots among coded landmarks.

K. Leung, Y. Halpern, T. Barfoot and H. Liu, *The UTIAS multi-robot cooperative localization and
mapping dataset*, International Journal of Robotics Research 30(8), 2011.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
import re
import warnings

import numpy as np

from slam_observer_ros.common.errors import DataSetError
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.evaluation.run_record import LandmarkTruth
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.geometry import se3, so3
from slam_observer_ros.recording.writer import DataSet

FIRST_LANDMARK_SUBJECT = 6
"""Subjects 1 to 5 are the robots."""

ROBOT_SIGHTING = 'robot'
MISREAD = 'misread'

_UNKNOWN_SUBJECT = 0
_MILLISECOND_NS = 1_000_000

_MAX_NUMBER = 4e9
"""More than any time, barcode or distance of the files; as nanoseconds it is still an int64."""


def load_mrclam(folder: Path | str, robot: int) -> DataSet:
    """Read one robot's run.

    Velocities are the commands that the robot was given: forward speed and yaw rate. Landmark ids
    are subject numbers; sightings of other robots and misread barcodes are left out and counted.
    Raises a DataSetError if a file is missing or malformed; if there is no such robot it lists
    those there are. Files of the truth may be missing.
    """
    folder = Path(folder)
    _require_robot(folder, robot)
    odometry = _table(folder / f'Robot{robot}_Odometry.dat', columns=3)
    truth = _truth(folder / f'Robot{robot}_Groundtruth.dat', columns=4)
    landmarks = _truth(folder / 'Landmark_Groundtruth.dat', columns=5)
    body_velocities = np.zeros((len(odometry), 6))
    body_velocities[:, 2] = odometry[:, 2]
    body_velocities[:, 3] = odometry[:, 1]
    observations, left_out = _observations(folder, robot)
    return DataSet(
        _stamps_ns(odometry),
        body_velocities,
        observations,
        _stamps_ns(truth),
        _planar_poses(truth[:, 1:]),
        LandmarkTruth(landmarks[:, 0].astype(np.int64), _on_ground(landmarks[:, 1:3])),
        left_out,
    )


def _require_robot(folder: Path, robot: int) -> None:
    if not folder.is_dir():
        raise DataSetError(f'{folder}: no such directory; give one such as MRCLAM_Dataset6')
    names = [re.fullmatch(r'Robot(\d+)_Odometry\.dat', path.name) for path in folder.iterdir()]
    robots = sorted(int(name.group(1)) for name in names if name)
    if not robots:
        raise DataSetError(f'{folder}: not an MRCLAM data set: no RobotN_Odometry.dat in it')
    if robot not in robots:
        raise DataSetError(f'{folder}: no robot {robot}; there are {", ".join(map(str, robots))}')


def _truth(path: Path, columns: int) -> FloatArray:
    """Read a table of what is true, which a run may be without."""
    return _table(path, columns) if path.exists() else np.empty((0, columns))


def _table(path: Path, columns: int) -> FloatArray:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')  # No data at all is refused below.
            table: FloatArray = np.loadtxt(path, ndmin=2)
    except FileNotFoundError as error:
        raise DataSetError(f'{path}: no such file') from error
    except OSError as error:
        raise DataSetError(f'{path}: {error}') from error
    except ValueError as error:
        reason = str(error).partition(';')[0]  # After it numpy has advice for programmers.
        raise DataSetError(f'{path}: {reason}') from error
    if len(table) == 0 or table.shape[1] != columns:
        raise DataSetError(f'{path}: {columns} columns of numbers are expected')
    # Written so that NaN is refused too.
    if not (np.abs(table).max() <= _MAX_NUMBER and table[:, 0].min() >= 0.0):
        reason = f'a number beyond {_MAX_NUMBER:g}, or a negative time or subject'
        raise DataSetError(f'{path}: damaged: it has {reason}')
    return table


def _stamps_ns(table: FloatArray) -> IntArray:
    """Read times, which the files give to the millisecond, without float64's rounding."""
    return np.rint(table[:, 0] * 1e3).astype(np.int64) * _MILLISECOND_NS


def _on_ground(xy: FloatArray) -> FloatArray:
    """Put (..., 2) positions on the plane z = 0."""
    return np.concatenate((xy, np.zeros_like(xy[..., :1])), axis=-1)


def _planar_poses(x_y_heading: FloatArray) -> FloatArray:
    rotations = so3.exp(x_y_heading[:, 2:] * np.array([0.0, 0.0, 1.0]))
    return se3.pose(rotations, _on_ground(x_y_heading[:, :2]))


def _observations(folder: Path, robot: int) -> tuple[list[ObservationEvent], Counter[str]]:
    """Return observations, and how many measurements are none, by reason."""
    # Which landmark each barcode is
    measurements = _table(folder / f'Robot{robot}_Measurement.dat', columns=4)
    barcodes = _table(folder / 'Barcodes.dat', columns=2).astype(np.int64)
    subject_of = dict(zip(barcodes[:, 1].tolist(), barcodes[:, 0].tolist(), strict=True))
    subjects = np.array(
        [subject_of.get(barcode, _UNKNOWN_SUBJECT) for barcode in measurements[:, 1].tolist()],
        dtype=np.int64,
    )
    misread = subjects == _UNKNOWN_SUBJECT
    is_landmark = subjects >= FIRST_LANDMARK_SUBJECT
    left_out = Counter(
        {
            ROBOT_SIGHTING: int(np.sum(~is_landmark & ~misread)),
            MISREAD: int(np.sum(misread)),
        }
    )

    # The rows of each stamp are one observation
    measurements, subjects = measurements[is_landmark], subjects[is_landmark]
    stamps_ns, starts = np.unique(_stamps_ns(measurements), return_index=True)
    ranges, bearings = measurements[:, 2], measurements[:, 3]
    directions = np.column_stack((np.cos(bearings), np.sin(bearings)))
    points = _on_ground(ranges[:, None] * directions)
    observations = [
        ObservationEvent(stamp_ns, seen_ids, seen_points)
        for stamp_ns, seen_ids, seen_points in zip(
            stamps_ns.tolist(),
            np.split(subjects, starts[1:]),
            np.split(points, starts[1:]),
            strict=True,
        )
    ]
    return observations, left_out
