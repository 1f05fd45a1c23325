"""Public data sets, in which truth is known: MRCLAM, Plaza and Starry Night.

UTIAS Multi-Robot Cooperative Localization and Mapping, wheeled robots among coded landmarks:
K. Leung, Y. Halpern, T. Barfoot and H. Liu, *The UTIAS multi-robot cooperative localization and
mapping dataset*, International Journal of Robotics Research 30(8), 2011.

Plaza, a mower among four radios that give distances: J. Djugash, B. Hamner and S. Roth,
*Navigating with ranging radios: five data sets with ground truth*, Journal of Field Robotics
26(9), 2009.

Starry Night, full 3D, a stereo camera and gyroscopes moved by hand above 20 LEDs: data set 3 of
T. Barfoot's course and book *State Estimation for Robotics*, University of Toronto.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
import re
import warnings

import numpy as np
import scipy.io

from slam_observer_ros.common.errors import DataSetError, message_of
from slam_observer_ros.common.files import not_special
from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.events import BEARING, ObservationEvent, RANGE
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.recordings.trajectory import LandmarkTruth
from slam_observer_ros.recordings.writer import DataSet

FIRST_LANDMARK_SUBJECT = 6
"""Subjects 1 to 5 are the robots."""

ROBOT_SIGHTING = 'robot'
MISREAD = 'misread'

_UNKNOWN_SUBJECT = 0
_MILLISECOND_NS = 1_000_000

_MAX_NUMBER = 4e9
"""More than any time, barcode or distance of MRCLAM; as nanoseconds it is still an int64."""


MEASURES = {'point': None, 'bearing': BEARING, 'range': RANGE}
"""What may be left of whole points."""


def load_mrclam(folder: Path | str, robot: int, measure: str = 'point') -> DataSet:
    """Read one robot's run of MRCLAM, or only directions or distances of its landmarks.

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
    observations = [_measured(event, MEASURES[measure]) for event in observations]
    return DataSet(
        _stamps_ns(odometry),
        body_velocities,
        observations,
        _stamps_ns(truth),
        _planar_poses(truth[:, 1:]),
        LandmarkTruth(landmarks[:, 0].astype(np.int64), _on_ground(landmarks[:, 1:3])),
        left_out,
    )


def _measured(event: ObservationEvent, kind: int | None) -> ObservationEvent:
    """Return points (m, 3) as a half sensor would have seen them; as they are if kind is None."""
    if kind is None:
        return event
    ranges = np.linalg.norm(event.points, axis=1)[:, None]
    points = ranges * [1.0, 0.0, 0.0] if kind == RANGE else event.points / ranges
    return replace(event, points=points, kinds=np.full(len(points), kind))


def _require_robot(folder: Path, robot: int) -> None:
    if not folder.is_dir():
        raise DataSetError(f'{folder}: no such directory; give one such as MRCLAM_Dataset6')
    names = [re.fullmatch(r'Robot(\d+)_Odometry\.dat', path.name) for path in folder.iterdir()]
    robots = sorted(int(name.group(1)) for name in names if name)
    if not robots:
        raise DataSetError(f'{folder}: not an MRCLAM data set: no RobotN_Odometry.dat in it')
    if robot not in robots:
        raise DataSetError(f'{folder}: no robot {robot}; there are {", ".join(map(str, robots))}')


def _truth(path: Path, columns: int, delimiter: str | None = None) -> FloatArray:
    """Read a table of what is true, which a run may be without."""
    return _table(path, columns, delimiter) if path.exists() else np.empty((0, columns))


def _table(path: Path, columns: int, delimiter: str | None = None) -> FloatArray:
    """Read columns of numbers: below one line of names, if a delimiter is between them."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')  # No data at all is refused below.
            skipped = 0 if delimiter is None else 1
            table: FloatArray = np.loadtxt(path, ndmin=2, delimiter=delimiter, skiprows=skipped)
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


NO_RANGE = 'without a range'


def load_plaza(folder: Path | str, run: int) -> DataSet:
    """Read a run of Plaza: distances from radios, whose ids are the landmarks'.

    The folder has ``plazaN_dr.csv``, the way t, forward m, turn rad since the row before;
    ``…_gt.csv``, the true t, x, y, yaw; ``…_td.csv``, t, sender, anchor, range m; ``…_tl.csv``,
    anchor, x, y: t in seconds, each below a line of names. Raises a DataSetError if one is missing
    or malformed; the truth's may be missing.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DataSetError(f'{folder}: no such directory; give the one of plaza1_td.csv')
    path = {name: folder / f'plaza{run}_{name}.csv' for name in ('dr', 'gt', 'td', 'tl')}
    way = _table(path['dr'], 3, ',')
    truth, anchors = _truth(path['gt'], 4, ','), _truth(path['tl'], 3, ',')
    measured = _table(path['td'], 4, ',')

    # A row's way is what was driven since the row before: a mean velocity from there on
    seconds = np.diff(way[:, 0])
    lasts = seconds > 0.0
    body_velocities = np.zeros((int(lasts.sum()), 6))
    body_velocities[:, [3, 2]] = way[1:][lasts, 1:] / seconds[lasts, None]
    is_range = measured[:, 3] > 0.0
    ranges = measured[is_range]
    ranges = ranges[np.argsort(ranges[:, 0], kind='stable')]
    observations = [
        ObservationEvent(
            stamp_ns, np.array([anchor]), np.array([[range_m, 0.0, 0.0]]), kinds=np.array([RANGE])
        )
        for stamp_ns, anchor, range_m in zip(
            _nanoseconds(ranges).tolist(),
            ranges[:, 2].astype(np.int64).tolist(),
            ranges[:, 3].tolist(),
            strict=True,
        )
    ]
    return DataSet(
        _nanoseconds(way[:-1][lasts]),
        body_velocities,
        observations,
        _nanoseconds(truth),
        _planar_poses(_facing_forwards(truth[:, 1:], float(way[:, 1].sum()))),
        LandmarkTruth(anchors[:, 0].astype(np.int64), _on_ground(anchors[:, 1:])),
        Counter({NO_RANGE: int(np.sum(~is_range))}),
    )


def _nanoseconds(table: FloatArray) -> IntArray:
    stamps_ns: IntArray = np.rint(table[:, 0] * NANOSECONDS_PER_SECOND).astype(np.int64)
    return stamps_ns


def _facing_forwards(poses: FloatArray, way_m: float) -> FloatArray:
    """Return true x, y, yaw (p, 3) with yaw along the motion, as far as the odometry says so.

    In Plaza 2 it is turned by π: the receiver's antennas were mounted back to front.
    """
    headings = np.column_stack([np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])])
    driven_m = float((np.diff(poses[:, :2], axis=0) * headings).sum())
    turned = np.pi if driven_m * way_m < 0.0 else 0.0
    return poses + [0.0, 0.0, turned]


EPOCH_NS = 1_256_566_448 * NANOSECONDS_PER_SECOND
"""Time zero of Starry Night, which states none: when its file was made, 2009-10-26."""

_SHAPES = {
    't': (1, -1),
    'v_vk_vk_i': (3, -1),
    'w_vk_vk_i': (3, -1),
    'y_k_j': (4, -1, 20),
    'r_i_vk_i': (3, -1),
    'theta_vk_i': (3, -1),
    'rho_i_pj_i': (3, 20),
    'C_c_v': (3, 3),
    'rho_v_c_v': (3, 1),
    **dict.fromkeys(('fu', 'fv', 'cu', 'cv', 'b'), (1, 1)),
}
"""Shape of each variable of Starry Night; -1 is the number of images."""

_MAX_SIZE = 1e6
"""More than any time, pixel or distance of Starry Night."""


def load_starry_night(file: Path | str) -> DataSet:
    """Read ``dataset3.mat``; raise a DataSetError if it is missing, damaged or another file.

    Landmark ids are the indices of the LEDs; the body frame is the data set's vehicle frame.
    """
    variables = _variables(Path(file))
    stamps_ns = EPOCH_NS + np.rint(variables['t'][0] * NANOSECONDS_PER_SECOND).astype(np.int64)
    # The file's angular velocity has its sign flipped, as the stereo points and the truth show.
    body_velocities = np.hstack((-variables['w_vk_vk_i'].T, variables['v_vk_vk_i'].T))
    rotations = so3.exp(variables['theta_vk_i'].T)
    world_points = variables['rho_i_pj_i'].T
    return DataSet(
        stamps_ns,
        body_velocities,
        _sightings(stamps_ns, variables),
        stamps_ns,
        se3.pose(rotations, variables['r_i_vk_i'].T),
        LandmarkTruth(np.arange(len(world_points)), world_points),
    )


def triangulate(pixels: FloatArray, variables: dict[str, FloatArray]) -> FloatArray:
    """Return points (..., 3) in the vehicle frame, metres, from where a stereo camera sees them.

    The pixels (4, ...) are columns and rows in the left and the right image: u_l, v_l, u_r, v_r.
    The variables are intrinsics ``fu fv cu cv``, baseline ``b`` in metres, and the camera's
    mounting: ``C_c_v`` takes vehicle axes to camera axes, ``rho_v_c_v`` is its position.
    """
    fu, fv, cu, cv, baseline = (variables[name].item() for name in ('fu', 'fv', 'cu', 'cv', 'b'))
    left_column, left_row, right_column, right_row = pixels
    depth = fu * baseline / (left_column - right_column)
    camera_points = np.stack(
        (
            (left_column - cu) * depth / fu,
            ((left_row + right_row) / 2.0 - cv) * depth / fv,
            depth,
        ),
        axis=-1,
    )
    # Row vectors: p C is Cᵀ p.
    vehicle_points: FloatArray = camera_points @ variables['C_c_v'] + variables['rho_v_c_v'][:, 0]
    return vehicle_points


def _variables(file: Path) -> dict[str, FloatArray]:
    try:
        with not_special(file).open('rb') as stream:
            variables: dict[str, FloatArray] = scipy.io.loadmat(stream)
    except FileNotFoundError as error:
        raise DataSetError(f'{file}: no such file; give dataset3.mat of Starry Night') from error
    except Exception as error:  # SciPy's reader raises nearly anything where bytes are damaged
        if isinstance(error, OSError) and error.errno:
            raise DataSetError(message_of(error)) from error
        raise DataSetError(f'{file}: not a MATLAB file, or damaged: {error}') from error
    missing = [name for name in _SHAPES if name not in variables]
    if missing:
        raise DataSetError(f'{file}: not Starry Night: it has no {" ".join(missing)}')
    images = np.size(variables['t'])
    for name, shape in _SHAPES.items():
        expected = tuple(images if size == -1 else size for size in shape)
        if variables[name].shape != expected:
            raise DataSetError(f'{file}: {name} has shape {variables[name].shape}, not {expected}')
        if not _are_plausible(variables[name]):
            raise DataSetError(
                f'{file}: damaged: {name} has no numbers, or some beyond {_MAX_SIZE:g}'
            )
    return {name: variables[name].astype(np.float64) for name in _SHAPES}


def _are_plausible(values: FloatArray) -> bool:
    """Return whether they are real numbers, none of them NaN or larger than any of the file."""
    return values.dtype.kind in 'fiu' and bool(
        (np.abs(values.astype(np.float64)) <= _MAX_SIZE).all()
    )


def _sightings(stamps_ns: IntArray, variables: dict[str, FloatArray]) -> list[ObservationEvent]:
    pixels = variables['y_k_j']
    seen = pixels.min(axis=0) >= 0.0  # -1 where a landmark isn't seen.
    observations = []
    for image in np.flatnonzero(seen.any(axis=1)).tolist():
        ids = np.flatnonzero(seen[image])
        with np.errstate(divide='ignore', invalid='ignore'):
            points = triangulate(pixels[:, image, ids], variables)
        if not np.isfinite(points).all():
            raise DataSetError(f'image {image} sees a point at infinity: the file is damaged')
        observations.append(ObservationEvent(int(stamps_ns[image]), ids, points))
    return observations
