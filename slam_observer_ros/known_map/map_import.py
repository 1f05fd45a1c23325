"""Maps of other programs: tables as CSV, TagSLAM's bodies, bundles of apriltag_ros."""

from __future__ import annotations

from collections.abc import Mapping
import csv
from pathlib import Path
from typing import Any

import numpy as np

from slam_observer_ros.common.errors import MapError, shown, YamlError
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.common.yaml_files import load_yaml, plain_value
from slam_observer_ros.events import MAX_ID
from slam_observer_ros.geometry import se3, so3
from slam_observer_ros.known_map.landmark_map import LandmarkMap

MAX_BYTES = 20_000_000

LAYOUTS = "TagSLAM's files, with 'bodies', or apriltag_ros's, with 'tag_bundles'"

COLUMNS = ('id', 'x', 'y', 'z', 'sigma')
"""Of a CSV file, in the order of one without a header; z and sigma may be left out."""

UNKNOWN_M = 10.0
"""Standard deviation of a height that a table does not have."""

Row = tuple[Any, FloatArray, FloatArray]
"""Id, position (3,) in the map and its standard deviations (3,), metres; NaN is the default."""

DEFAULT_SIGMAS_M = np.full(3, np.nan)


def import_map(path: Path, frame_id: str, sigma_m: float) -> LandmarkMap:
    """Read a map in one of the formats; ``sigma_m`` is for landmarks that have none.

    Raise :exc:`MapError` if it can't be read, is in none of them, or has a value that can't be
    right; the message names the file and the reason.
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
    return _as_map(path, rows, frame_id, sigma_m)


def _reason(error: Exception) -> str:
    return f'{shown(error.args[0])} is missing' if isinstance(error, KeyError) else str(error)


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
    return [_csv_row(number, dict(zip(names, line, strict=False))) for number, line in lines]


def _csv_row(number: int, cells: Mapping[str, str]) -> Row:
    x, y, z, sigma_m = (_number(number, cells, name) for name in ('x', 'y', 'z', 'sigma'))
    if x is None or y is None:
        raise MapError(f'line {number}: it needs id, x and y, with commas between them')
    try:
        landmark_id = int(cells['id'])
    except ValueError as error:
        raise MapError(f"line {number}: the id '{cells['id']}' is no whole number") from error
    sigma_m = np.nan if sigma_m is None else sigma_m
    sigmas_m = np.array([sigma_m, sigma_m, UNKNOWN_M if z is None else sigma_m])
    return landmark_id, np.array([x, y, z or 0.0]), sigmas_m


def _number(line: int, cells: Mapping[str, str], name: str) -> float | None:
    """Return the number in a column; None if there is nothing."""
    text = cells.get(name)
    if not text:
        return None
    if not _is_number(text) or not np.isfinite(float(text)):
        raise MapError(f"line {line}: {name} is '{text}', which is not a finite number")
    return float(text)


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
        return [row for bundle in content['tag_bundles'] for row in _bundle_rows(bundle)]
    raise MapError(f'it is not laid out as {LAYOUTS}; tables are named .csv')


def _tagslam_rows(named: Mapping[str, Any]) -> list[Row]:
    """Return the tags of a body that stands still; its pose, if it has one, is in the map."""
    ((_, body),) = named.items()
    if not body.get('is_static', False):
        return []
    in_map = _tagslam_pose(body['pose']) if 'pose' in body else np.eye(4)
    return [
        (tag['id'], (in_map @ _tagslam_pose(tag['pose']))[:3, 3], DEFAULT_SIGMAS_M)
        for tag in body.get('tags') or ()
        if 'pose' in tag
    ]


def _tagslam_pose(written: Mapping[str, Any]) -> FloatArray:
    """Return a pose (4, 4) of position and rotation vector."""
    position, rotation = (
        np.array([float(written[name][axis]) for axis in 'xyz'])
        for name in ('position', 'rotation')
    )
    return se3.pose(so3.exp(rotation), position)


def _bundle_rows(bundle: Mapping[str, Any]) -> list[Row]:
    return [
        (tag['id'], np.array([float(tag.get(axis, 0.0)) for axis in 'xyz']), DEFAULT_SIGMAS_M)
        for tag in bundle['layout']
    ]


def _as_map(path: Path, rows: list[Row], frame_id: str, sigma_m: float) -> LandmarkMap:
    """Return the map, if ids and numbers can be right."""
    ids = [landmark_id for landmark_id, _, _ in rows]
    for landmark_id in ids:
        if type(landmark_id) is not int or not 0 <= landmark_id <= MAX_ID:
            raise MapError(f'{path}: the id {shown(landmark_id)} is not one from 0 to {MAX_ID}')
        if ids.count(landmark_id) > 1:
            raise MapError(f'{path}: landmark {landmark_id} is there more than once')
    points = np.array([position for _, position, _ in rows])
    sigmas_m = np.array([sigmas for _, _, sigmas in rows])
    sigmas_m[np.isnan(sigmas_m)] = sigma_m
    if not np.isfinite(points).all() or not (sigmas_m >= 0.0).all():
        raise MapError(f'{path}: a position is not finite, or sigma is negative')
    covariances = sigmas_m[:, :, None] ** 2 * np.eye(3)
    counts = np.zeros(len(ids), dtype=np.int64)
    return LandmarkMap(np.array(ids, dtype=np.int64), points, covariances, counts, frame_id)
