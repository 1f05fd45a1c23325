"""Graphs of a robot in the plane, in the text formats of iSAM and g2o, as recordings.

A pose is a second of time, and an edge from one to the next a constant velocity for that second.

iSAM: ``ODOMETRY`` or ``EDGE2 i j x y θ`` is pose j in pose i, ``LANDMARK i id x y`` a point in
pose i, each followed by the upper triangle of the square root of its information matrix.
g2o: ``EDGE_SE2`` and ``EDGE_SE2_XY`` are the same with the information matrix itself.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slam_observer_ros.common.errors import DataSetError, shown
from slam_observer_ros.common.files import not_special
from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.events import MAX_ID, ObservationEvent
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.recordings.trajectory import LandmarkTruth
from slam_observer_ros.recordings.writer import DataSet

START_NS = NANOSECONDS_PER_SECOND
"""Stamp of the first pose; zero stands for an unknown time."""

LOOP_CLOSURE = 'edge between poses that do not follow each other'
REPEATED = 'second edge between the same two'

_MAX_NUMBER = 1e6
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
            else:
                self._add_motion(first, second, following.get(first), numbers[:3])

    def _add_motion(self, first: int, second: int, after: int | None, motion: FloatArray) -> None:
        if second != after:
            self.left_out[LOOP_CLOSURE] += 1
        elif first in self.motions:
            self.left_out[REPEATED] += 1
        else:
            self.motions[first] = motion

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
    poses, landmarks = _truth(None if truth is None else Path(truth), graph.numbers)
    return DataSet(
        stamps_ns[:-1],
        _body_velocities(graph.steps()),
        [_observation(graph, number, stamp_of[number]) for number in sorted(graph.points)],
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
    if not np.abs(numbers).max() <= _MAX_NUMBER:
        raise DataSetError(f'{where}: it has a number beyond {_MAX_NUMBER:g}')
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


def _observation(graph: _Graph, number: int, stamp_ns: int) -> ObservationEvent:
    points = graph.points[number]
    ids = np.array(sorted(points), dtype=np.int64)
    return ObservationEvent(
        stamp_ns,
        ids,
        _on_ground([points[landmark_id] for landmark_id in ids.tolist()]),
        np.array([graph.covariances[number, landmark_id] for landmark_id in ids.tolist()]),
    )


def _on_ground(points: Sequence[FloatArray]) -> FloatArray:
    """Put (x, y) on the plane z = 0."""
    return np.pad(np.reshape(points, (-1, 2)), ((0, 0), (0, 1)))


def _truth(path: Path | None, numbers: Sequence[int]) -> tuple[FloatArray, LandmarkTruth]:
    """Return the true poses (k, 4, 4), and each landmark where it is first seen from one."""
    if path is None:
        return np.empty((0, 4, 4)), LandmarkTruth(np.empty(0, dtype=np.int64), np.empty((0, 3)))
    graph = _Graph(path)
    if graph.numbers != numbers:
        raise DataSetError(f'{path}: its poses are not those of the graph')
    poses = _poses(graph.steps())
    world_points: dict[int, FloatArray] = {}
    for number, pose in zip(graph.numbers, poses, strict=True):
        for landmark_id, point in graph.points.get(number, {}).items():
            world_points.setdefault(landmark_id, se3.transform(pose, _on_ground([point]))[0])
    ids: IntArray = np.array(sorted(world_points), dtype=np.int64)
    points = np.array([world_points[landmark_id] for landmark_id in ids.tolist()])
    return poses, LandmarkTruth(ids, points.reshape(-1, 3))


def _poses(motions: FloatArray) -> FloatArray:
    """Return the poses (k, 4, 4) that motions (k − 1, 3) lead through from the identity."""
    headings = np.append(0.0, np.cumsum(motions[:, 2]))
    R = so3.exp(headings[:, None] * np.array([0.0, 0.0, 1.0]))
    steps = (R[:-1] @ _on_ground(list(motions[:, :2]))[:, :, None])[:, :, 0]
    return se3.pose(R, np.vstack((np.zeros(3), np.cumsum(steps, axis=0))))
