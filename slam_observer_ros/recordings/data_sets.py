"""Public data sets, in which truth is known, and graphs of a robot in the plane, as recordings.

UTIAS Multi-Robot Cooperative Localization and Mapping, wheeled robots among coded landmarks:
K. Leung, Y. Halpern, T. Barfoot and H. Liu, *The UTIAS multi-robot cooperative localization and
mapping dataset*, International Journal of Robotics Research 30(8), 2011.

Plaza, a mower among four radios that give distances: J. Djugash, B. Hamner and S. Roth,
*Navigating with ranging radios: five data sets with ground truth*, Journal of Field Robotics
26(9), 2009.

Starry Night, full 3D, a stereo camera and gyroscopes moved by hand above 20 LEDs: data set 3 of
T. Barfoot's course and book *State Estimation for Robotics*, University of Toronto.

Graphs, in the text formats of iSAM and g2o: a pose is a second of time, and an edge from one to
the next a constant velocity for that second.

iSAM: ``ODOMETRY`` or ``EDGE2 i j x y θ`` is pose j in pose i, ``LANDMARK i id x y`` a point in
pose i, each followed by the upper triangle of the square root of its information matrix.
g2o: ``EDGE_SE2`` and ``EDGE_SE2_XY`` are the same with the information matrix itself.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
import re
import warnings

import numpy as np
import scipy.io

from slam_observer_ros.common.errors import DataSetError, message_of, shown
from slam_observer_ros.common.files import not_special
from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.events import BEARING, MAX_ID, ObservationEvent, RANGE
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.recordings.trajectory import LandmarkTruth
from slam_observer_ros.recordings.writer import DataSet

FIRST_LANDMARK_SUBJECT = 6  # subjects 1 to 5 are the robots

ROBOT_SIGHTING = 'robot'
MISREAD = 'misread'

_UNKNOWN_SUBJECT = 0
_MILLISECOND_NS = 1_000_000

_MAX_NUMBER = 4e9
"""More than any time, barcode or distance of MRCLAM; as nanoseconds it is still an int64."""


MEASURES = {'point': None, 'bearing': BEARING, 'range': RANGE}  # what may be left of whole points


def load_mrclam(folder: Path | str, robot: int, measure: str = 'point') -> DataSet:
    """Read one robot's run of MRCLAM, or only directions or distances of its landmarks.

    Velocities are the commands that the robot was given: forward speed and yaw rate. Landmark ids
    are subject numbers; sightings of other robots and misread barcodes are left out and counted.
    Raises a DataSetError if a file is missing or malformed; if there is no such robot it lists
    those there are. Files of the truth may be missing.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DataSetError(f'{folder}: no such directory; give one such as MRCLAM_Dataset6')
    names = [re.fullmatch(r'Robot(\d+)_Odometry\.dat', path.name) for path in folder.iterdir()]
    robots = sorted(int(name.group(1)) for name in names if name)
    if not robots:
        raise DataSetError(f'{folder}: not an MRCLAM data set: no RobotN_Odometry.dat in it')
    if robot not in robots:
        raise DataSetError(f'{folder}: no robot {robot}; there are {", ".join(map(str, robots))}')
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
    seen_robots = int(np.sum(~is_landmark & ~misread))
    left_out = Counter({ROBOT_SIGHTING: seen_robots, MISREAD: int(np.sum(misread))})

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

_MAX_SIZE = 1e6  # more than any time, pixel or distance of Starry Night


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
        ((left_column - cu) * depth / fu, ((left_row + right_row) / 2.0 - cv) * depth / fv, depth),
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
        # Real numbers, none of them NaN or larger than any of the file
        is_real = variables[name].dtype.kind in 'fiu'
        if not (is_real and (np.abs(variables[name].astype(np.float64)) <= _MAX_SIZE).all()):
            raise DataSetError(
                f'{file}: damaged: {name} has no numbers, or some beyond {_MAX_SIZE:g}'
            )
    return {name: variables[name].astype(np.float64) for name in _SHAPES}


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


START_NS = NANOSECONDS_PER_SECOND  # stamp of the first pose; zero stands for an unknown time

LOOP_CLOSURE = 'edge between poses that do not follow each other'
REPEATED = 'second edge between the same two'

_MAX_ENTRY = 1e6
_NUMBERS = {'ODOMETRY': 9, 'EDGE2': 9, 'EDGE_SE2': 9, 'LANDMARK': 5, 'EDGE_SE2_XY': 5}
"""How many numbers follow the two that an edge is between."""

_OF_POINTS = ('LANDMARK', 'EDGE_SE2_XY')
_OF_G2O = ('EDGE_SE2', 'EDGE_SE2_XY')
_ESTIMATES = ('VERTEX_SE2', 'VERTEX_XY', 'VERTEX2', 'POINT2', 'FIX', '#')
"""What is not measured: where an optimisation begins."""


class _Graph:
    """The edges of a file, by the numbers of what they are between; x, y, θ in metres, radians."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.motions: dict[int, FloatArray] = {}
        self.points: defaultdict[int, dict[int, FloatArray]] = defaultdict(dict)
        self.covariances: dict[tuple[int, int], FloatArray] = {}
        self.poses: set[int] = set()
        self.left_out: Counter[str] = Counter()
        edges = [edge for line in enumerate(_lines(path), 1) if (edge := _edge(path, *line))]
        for kind, first, second, _ in edges:
            self.poses |= {first} if kind in _OF_POINTS else {first, second}
        self.numbers = sorted(self.poses)
        following = dict(zip(self.numbers, self.numbers[1:], strict=False))
        for kind, first, second, numbers in edges:
            if kind in _OF_POINTS:
                self._add_point(kind, first, second, numbers)
            elif second != following.get(first):
                self.left_out[LOOP_CLOSURE] += 1
            elif first in self.motions:
                self.left_out[REPEATED] += 1
            else:
                self.motions[first] = numbers[:3]

    def _add_point(self, kind: str, pose: int, landmark_id: int, numbers: FloatArray) -> None:
        if landmark_id in self.points[pose]:
            self.left_out[REPEATED] += 1
            return
        xx, xy, yy = numbers[2:]
        information = np.array([[xx, xy], [xy, yy]])
        if kind not in _OF_G2O:
            root = np.array([[xx, xy], [0.0, yy]])
            information = root.T @ root
        if not (np.linalg.det(information) > 0.0 and np.trace(information) > 0.0):
            raise DataSetError(
                f'{self.path}: the information of landmark {landmark_id} in pose {pose} is not '
                'positive'
            )
        covariance = np.zeros((3, 3))
        covariance[:2, :2] = np.linalg.inv(information)
        covariance[2, 2] = np.trace(covariance) / 2.0
        self.points[pose][landmark_id] = numbers[:2]
        self.covariances[pose, landmark_id] = covariance

    def steps(self) -> FloatArray:
        """Return (k − 1, 3) motions from each pose to the next."""
        if len(self.numbers) < 2:
            raise DataSetError(f'{self.path}: there is no edge from one pose to the next')
        missing = [number for number in self.numbers[:-1] if number not in self.motions]
        if missing:
            raise DataSetError(
                f'{self.path}: there is no edge from pose {missing[0]} to the next one'
            )
        return np.array([self.motions[number] for number in self.numbers[:-1]]).reshape(-1, 3)


def load_graph(file: Path | str, truth: Path | str | None = None) -> DataSet:
    """Read a graph whose poses are one after the other, and the true one, of the same format.

    Observations have the covariances that the file states; of a true graph, only positions count.
    Raises a DataSetError if a file is missing or malformed, or if there is no motion between two
    poses.
    """
    graph = _Graph(Path(file))
    stamps_ns = START_NS + NANOSECONDS_PER_SECOND * np.arange(len(graph.numbers))
    stamp_of = dict(zip(graph.numbers, stamps_ns.tolist(), strict=True))
    poses, landmarks = _true_graph(None if truth is None else Path(truth), graph.numbers)
    return DataSet(
        stamps_ns[:-1],
        _body_velocities(graph.steps()),
        [_seen_from(graph, number, stamp_of[number]) for number in sorted(graph.points)],
        stamps_ns[: len(poses)],
        poses,
        landmarks,
        graph.left_out,
    )


def _lines(path: Path) -> list[str]:
    try:
        return not_special(path).read_text(encoding='ascii').splitlines()
    except FileNotFoundError as error:
        raise DataSetError(f'{path}: no such file') from error
    except OSError as error:
        raise DataSetError(f'{path}: {error.strerror}') from error
    except UnicodeError as error:
        raise DataSetError(f'{path}: no graph, or damaged: it is no text') from error


def _edge(path: Path, place: int, line: str) -> tuple[str, int, int, FloatArray] | None:
    """Return what an edge is, between which two, and its numbers; None for another line."""
    kind, *words = line.split() or ['#']
    if kind in _ESTIMATES or kind.startswith('#'):
        return None
    where = f'{path}, line {place}'
    if kind not in _NUMBERS:
        raise DataSetError(f'{where}: {shown(kind)} is no line of a graph in the plane')
    if len(words) != 2 + _NUMBERS[kind]:
        raise DataSetError(f'{where}: {kind} has {2 + _NUMBERS[kind]} numbers, not {len(words)}')
    try:
        first, second = (int(word) for word in words[:2])
        numbers = np.array([float(word) for word in words[2:]])
    except ValueError as error:
        raise DataSetError(f'{where}: no number: {shown(str(error))}') from error
    if not (0 <= first <= MAX_ID and 0 <= second <= MAX_ID):
        raise DataSetError(f'{where}: {first} or {second} is no number of a pose or landmark')
    # Written so that NaN is refused too.
    if not np.abs(numbers).max() <= _MAX_ENTRY:
        raise DataSetError(f'{where}: it has a number beyond {_MAX_ENTRY:g}')
    return kind, first, second, numbers


def _body_velocities(motions: FloatArray) -> FloatArray:
    """Return the velocities (k, 6) that lead through motions x, y, θ (k, 3) in a second each."""
    x, y, angle = motions.T
    half = np.arctan2(np.sin(angle), np.cos(angle)) / 2.0
    # The inverse of the SE(2) exponential's matrix; half / tan(half), which at zero is one.
    along = np.cos(half) / np.sinc(half / np.pi)
    velocities = np.zeros((len(motions), 6))
    velocities[:, 2] = 2.0 * half
    velocities[:, 3] = along * x + half * y
    velocities[:, 4] = along * y - half * x
    return velocities


def _seen_from(graph: _Graph, number: int, stamp_ns: int) -> ObservationEvent:
    points = graph.points[number]
    ids = np.array(sorted(points), dtype=np.int64)
    return ObservationEvent(
        stamp_ns,
        ids,
        _on_ground(np.array([points[landmark_id] for landmark_id in ids.tolist()])),
        np.array([graph.covariances[number, landmark_id] for landmark_id in ids.tolist()]),
    )


def _true_graph(path: Path | None, numbers: Sequence[int]) -> tuple[FloatArray, LandmarkTruth]:
    """Return the true poses (k, 4, 4), and each landmark where it is first seen from one."""
    if path is None:
        return np.empty((0, 4, 4)), LandmarkTruth(np.empty(0, dtype=np.int64), np.empty((0, 3)))
    graph = _Graph(path)
    if graph.numbers != numbers:
        raise DataSetError(f"{path}: its poses differ from the graph's")
    poses = _poses_along(graph.steps())
    world_points: dict[int, FloatArray] = {}
    for number, pose in zip(graph.numbers, poses, strict=True):
        for landmark_id, point in graph.points.get(number, {}).items():
            world_points.setdefault(landmark_id, se3.transform(pose, _on_ground(point[None]))[0])
    ids: IntArray = np.array(sorted(world_points), dtype=np.int64)
    points = np.array([world_points[landmark_id] for landmark_id in ids.tolist()])
    return poses, LandmarkTruth(ids, points.reshape(-1, 3))


def _poses_along(motions: FloatArray) -> FloatArray:
    """Return the poses (k, 4, 4) that motions (k − 1, 3) lead through from the identity."""
    headings = np.append(0.0, np.cumsum(motions[:, 2]))
    R = so3.exp(headings[:, None] * np.array([0.0, 0.0, 1.0]))
    steps = (R[:-1] @ _on_ground(motions[:, :2])[:, :, None])[:, :, 0]
    return se3.pose(R, np.vstack((np.zeros(3), np.cumsum(steps, axis=0))))
