"""Maps of other programs: tables as CSV, TagSLAM's bodies, bundles of apriltag_ros.

In all of them the axes of a tag are, seen from before the upright tag: x to the right, y up, z out
of it. So TagSLAM and apriltag_ros have them, and AprilTags are upright as their makers print them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
import csv
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from slam_observer_ros.common.errors import MapError, shown, YamlError
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.common.yaml_files import load_yaml, plain_value
from slam_observer_ros.events import MAX_ID
from slam_observer_ros.geometry import se3, so3
from slam_observer_ros.known_map.landmark_map import LandmarkMap
from slam_observer_ros.known_map.map_file import MAX_NUMBER

MAX_BYTES = 20_000_000

LAYOUTS = "TagSLAM's files, with 'bodies', or apriltag_ros's, with 'tag_bundles'"

COLUMNS = ('id', 'x', 'y', 'z', 'sigma')
"""Of a CSV file, in the order of one without a header; z and sigma may be left out."""

QUATERNION = ('qx', 'qy', 'qz', 'qw')

TAG_AXES: Mapping[str, Sequence[float]] = {
    'right-up-out': (1.0, 1.0, 1.0),
    'right-down-in': (1.0, -1.0, -1.0),
    'left-down-out': (-1.0, -1.0, 1.0),
    'none': (0.0, 0.0, 0.0),
}
"""The axes x, y, z that detectors give a tag, along those in the files; ``none`` for points."""

UNKNOWN_M = 10.0
"""Standard deviation of a height that a table does not have."""

MAX_YAW_RAD = 6.3
"""A larger one is taken to be in degrees."""


class Row(NamedTuple):
    """A landmark as a file has it; NaN stands for the default."""

    landmark_id: Any
    position: FloatArray  # (3,) in the map, metres
    orientation: FloatArray  # (3, 3) from the tag's own axes; zero of a point
    sigmas_m: FloatArray = np.full(3, np.nan)  # (3,)
    orientation_sigma_rad: float = np.nan


def import_map(
    path: Path,
    frame_id: str,
    sigma_m: float,
    orientation_sigma_rad: float,
    tag_axes: str = 'right-up-out',
) -> LandmarkMap:
    """Read a map in one of the formats; the sigmas are for landmarks that have none.

    Orientations are from ``tag_axes``, one of :data:`TAG_AXES`. Raise :exc:`MapError` if it can't
    be read, is in none of the formats, or has a value that can't be right; the message names the
    file, the line or tag, and the reason.
    """
    try:
        rows = _csv_rows(path) if path.suffix.lower() in ('.csv', '.txt') else _yaml_rows(path)
    except OSError as error:
        raise MapError(f"can't read {path}: {error.strerror}") from error
    except (YamlError, UnicodeDecodeError, csv.Error) as error:
        raise MapError(f'{path} is not valid: {error}') from error
    except (MapError, KeyError, ValueError) as error:
        raise MapError(f'{path}: {_reason(error)}') from error
    except (TypeError, AttributeError) as error:  # a value in place of a list or mapping
        raise MapError(f'{path}: it is not laid out as {LAYOUTS}') from error
    if not rows:
        raise MapError(f'{path}: there are no landmarks in it')
    _check_ids(path, rows)
    return _as_map(rows, frame_id, sigma_m, orientation_sigma_rad, np.array(TAG_AXES[tag_axes]))


def _reason(error: Exception) -> str:
    return f'{shown(error.args[0])} is missing' if isinstance(error, KeyError) else str(error)


@contextmanager
def _naming(what: str) -> Iterator[None]:
    """Name what it is of that can't be right."""
    try:
        yield
    except (MapError, KeyError, ValueError) as error:
        raise MapError(f'{what}: {_reason(error)}') from error


def _csv_rows(path: Path) -> list[Row]:
    with path.open(encoding='utf-8-sig', newline='') as file:  # with a mark, as Excel writes it
        reader = csv.reader(file)
        lines = [(reader.line_num, [cell.strip() for cell in line]) for line in reader if line]
    lines = [(number, line) for number, line in lines if not line[0].startswith('#')]
    names = list(COLUMNS)
    if lines and not _is_number(lines[0][1][0]):
        names = [cell.lower() for cell in lines.pop(0)[1]]
    if missing := {'id', 'x', 'y'} - set(names):
        raise MapError(f"there is no column '{min(missing)}'; it needs id, x and y, with commas")
    rows = []
    for number, line in lines:
        with _naming(f'line {number}'):
            if any(line[len(names) :]):
                raise MapError(f'it has more values than columns, which are {", ".join(names)}')
            rows.append(_csv_row(dict(zip(names, line, strict=False))))
    return rows


def _csv_row(cells: Mapping[str, str]) -> Row:
    x, y, z = (_cell(cells, name) for name in 'xyz')
    if x is None or y is None:
        raise MapError('it needs id, x and y, with commas between them')
    try:
        landmark_id = int(cells['id'])
    except ValueError as error:
        raise MapError(f"the id '{cells['id']}' is no whole number") from error
    sigma_m, sigma_rad = (_sigma(cells, name) for name in ('sigma', 'orientation_sigma'))
    sigmas_m = np.array([sigma_m, sigma_m, UNKNOWN_M if z is None else sigma_m])
    position = np.array([x, y, z or 0.0])
    return Row(landmark_id, position, _orientation(cells), sigmas_m, sigma_rad)


def _sigma(cells: Mapping[str, str], name: str) -> float:
    """Return the standard deviation in a column; NaN if there is nothing."""
    sigma = _cell(cells, name)
    if sigma is not None and sigma < 0.0:
        raise MapError(f'{name} is negative')
    return np.nan if sigma is None else sigma


def _orientation(cells: Mapping[str, str]) -> FloatArray:
    """Return the orientation (3, 3) in a table, zero if there is none."""
    yaw_rad, values = _cell(cells, 'yaw'), [_cell(cells, name) for name in QUATERNION]
    quaternion = [value for value in values if value is not None]
    if yaw_rad is not None and quaternion:
        raise MapError('it has a yaw and a quaternion: leave one')
    if yaw_rad is not None:
        return _facing(yaw_rad)
    if not quaternion:
        return np.zeros((3, 3))
    if len(quaternion) < len(QUATERNION):
        raise MapError('a quaternion needs qx, qy, qz and qw')
    return _turned(quaternion)


def _facing(yaw_rad: float) -> FloatArray:
    """Return the orientation (3, 3) of an upright tag that looks in a direction."""
    if abs(yaw_rad) > MAX_YAW_RAD:
        raise MapError(f'yaw is {yaw_rad:g}, more than a turn: it must be in radians')
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[-s, 0.0, c], [c, 0.0, s], [0.0, 1.0, 0.0]])


def _turned(quaternion: Sequence[float]) -> FloatArray:
    """Return the orientation (3, 3) of a quaternion x y z w."""
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1.0) > so3.QUATERNION_NORM_TOLERANCE:
        raise MapError(f'the quaternion has norm {norm:.3g}, not 1')
    return so3.from_quaternion(np.array(quaternion))


def _cell(cells: Mapping[str, str], name: str) -> float | None:
    """Return the number in a column; None if there is nothing."""
    return _finite(cells[name], name) if cells.get(name) else None


def _finite(written: Any, name: str) -> float:
    try:
        number = float(written)
    except (TypeError, ValueError, OverflowError):
        number = np.nan
    if not abs(number) <= MAX_NUMBER:  # nor NaN
        raise MapError(f'{name} is {shown(written)}, which is not a finite number')
    return number


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _yaml_rows(path: Path) -> list[Row]:
    content = load_yaml(path, MAX_BYTES, plain_value)
    if isinstance(content, Mapping) and 'bodies' in content:
        return [row for body in content['bodies'] for row in _tagslam_rows(body)]
    if isinstance(content, list):  # TagSLAM's output
        return [row for body in content for row in _tagslam_rows(body)]
    if isinstance(content, Mapping) and 'tag_bundles' in content:
        return _bundle_rows(content['tag_bundles'])
    raise MapError(f'it is not laid out as {LAYOUTS}; tables are named .csv')


def _tagslam_rows(named: Mapping[str, Any]) -> list[Row]:
    """Return the tags of a body that stands still; its pose, if it has one, is in the map."""
    if len(named) != 1:
        names = ', '.join(shown(name) for name in named)
        raise MapError(f'each body is an entry of its own in the list: {names}')
    ((name, body),) = named.items()
    if not body.get('is_static', False):
        return []
    with _naming(f'body {shown(name)}'):
        in_map = _tagslam_pose(body['pose']) if 'pose' in body else np.eye(4)
        tags = [tag for tag in body.get('tags') or () if 'pose' in tag]
        return [_tagslam_row(in_map, tag['id'], tag['pose']) for tag in tags]


def _tagslam_row(in_map: FloatArray, tag_id: Any, written: Mapping[str, Any]) -> Row:
    with _naming(f'tag {shown(tag_id)}'):
        pose = in_map @ _tagslam_pose(written)
        return Row(tag_id, pose[:3, 3], pose[:3, :3])


def _tagslam_pose(written: Mapping[str, Any]) -> FloatArray:
    """Return a pose (4, 4) of position and rotation vector."""
    position, rotation = (
        np.array([_finite(written[name][axis], f'{name} {axis}') for axis in 'xyz'])
        for name in ('position', 'rotation')
    )
    return se3.pose(so3.exp(rotation), position)


def _bundle_rows(bundles: Sequence[Mapping[str, Any]]) -> list[Row]:
    """Return the tags of the one bundle in a file; what is left out of a pose is none."""
    if len(bundles) > 1:
        raise MapError(f'it has {len(bundles)} bundles, each in a frame of its own: leave one')
    return [_bundle_row(tag) for bundle in bundles for tag in bundle['layout']]


def _bundle_row(tag: Mapping[str, Any]) -> Row:
    with _naming(f'tag {shown(tag["id"])}'):
        position = np.array([_finite(tag.get(axis, 0.0), axis) for axis in 'xyz'])
        quaternion = [_finite(tag.get(name, float(name == 'qw')), name) for name in QUATERNION]
        return Row(tag['id'], position, _turned(quaternion))


def _check_ids(path: Path, rows: Sequence[Row]) -> None:
    ids = [row.landmark_id for row in rows]
    for landmark_id in ids:
        if type(landmark_id) is not int or not 0 <= landmark_id <= MAX_ID:
            raise MapError(f'{path}: the id {shown(landmark_id)} is not one from 0 to {MAX_ID}')
        if ids.count(landmark_id) > 1:
            raise MapError(f'{path}: landmark {landmark_id} is there more than once')


def _as_map(
    rows: Sequence[Row], frame_id: str, sigma_m: float, sigma_rad: float, axes: FloatArray
) -> LandmarkMap:
    """Return the map with orientations from a detector's ``axes`` (3,), signs of the files'."""
    sigmas_m = np.array([row.sigmas_m for row in rows])
    sigmas_m[np.isnan(sigmas_m)] = sigma_m
    orientations = np.array([row.orientation for row in rows]) * axes
    are_tags = orientations.any(axis=(1, 2))
    sigmas_rad = np.array([row.orientation_sigma_rad for row in rows])
    sigmas_rad[np.isnan(sigmas_rad)] = sigma_rad
    return LandmarkMap(
        np.array([row.landmark_id for row in rows], dtype=np.int64),
        np.array([row.position for row in rows]),
        sigmas_m[:, :, None] ** 2 * np.eye(3),
        np.zeros(len(rows), dtype=np.int64),
        frame_id,
        orientations if are_tags.any() else None,
        sigmas_rad * are_tags if are_tags.any() else None,
    )
