"""Maps of other programs: tables, TagSLAM's bodies, bundles, FRC's fields, scanners' landmarks.

In all of them but FRC's the axes of a tag are, seen from before the upright tag: x to the
right, y up, z out of it. So TagSLAM and apriltag_ros have them, and AprilTags are upright as their
makers print them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
import csv
import json
import logging
from pathlib import Path
from typing import Any

import numpy as np

from slam_observer_ros.common.errors import MapError, shown, YamlError
from slam_observer_ros.common.files import load_yaml, plain_value, read_text
from slam_observer_ros.common.findings import found
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import MAX_ID
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.mapping.map_tables import (
    facing,
    finite,
    naming,
    QUATERNION,
    reason,
    Row,
    scanner_rows,
    table_rows,
    turned,
    UNITS,
    UNKNOWN_NOISE,
)

MAX_BYTES = 20_000_000

LAYOUTS = "TagSLAM's files, with 'bodies', or apriltag_ros's, with 'tag_bundles'"

TAG_AXES: Mapping[str, Sequence[float]] = {
    'right-up-out': (1.0, 1.0, 1.0),
    'right-down-in': (1.0, -1.0, -1.0),
    'left-down-out': (-1.0, -1.0, 1.0),
    'none': (0.0, 0.0, 0.0),
}
"""The axes x, y, z that detectors give a tag, along those in the files; ``none`` for points."""

LENGTHS = ('m', 'cm', 'mm')
"""Units of coordinates."""

WIDE_M, SPARSE_M = 1000.0, 100.0
"""Extent of a map, and distance of half of its landmarks to the nearest other, from which on both
its coordinates are hardly in metres: no sensor sees two of them at once."""

MAX_NAMED = 12
"""Of what is left out, as many are named in one line."""

logger = logging.getLogger(__name__)


def import_map(
    path: Path,
    frame_id: str,
    sigma_m: float,
    orientation_sigma_rad: float,
    tag_axes: str = 'right-up-out',
    unit: str | None = None,
) -> LandmarkMap:
    """Read a map in one of the formats; the sigmas are for landmarks that have none.

    Coordinates and their sigmas are in ``unit``, one of :data:`LENGTHS`, where the file does not
    say; by default metres, unless these look like millimetres. Orientations are from ``tag_axes``,
    one of :data:`TAG_AXES`. What is left out is logged. Raise :exc:`MapError` if it can't be read,
    is in none of the formats, or has a value that can't be right; the message names the file, the
    line or tag, and the reason.
    """
    left_out: list[str] = []
    try:
        rows = _rows(path, left_out)
    except OSError as error:
        raise MapError(f"can't read {path}: {error.strerror}") from error
    except (YamlError, UnicodeDecodeError, csv.Error) as error:
        raise MapError(f'{path} is not valid: {error}') from error
    except (MapError, KeyError, ValueError) as error:
        raise MapError(f'{path}: {reason(error)}') from error
    except (TypeError, AttributeError) as error:  # a value in place of a list or mapping
        raise MapError(f'{path}: it is not laid out as {LAYOUTS}') from error
    if left_out:
        more = ', …' if len(left_out) > MAX_NAMED else ''
        columns = ', '.join(left_out[:MAX_NAMED]) + more
        logger.warning('%s', found('left_out_of_table', path=path, columns=columns))
    if not rows:
        raise MapError(f'{path}: there are no landmarks in it')
    _check_ids(path, rows)
    if unit is None:
        _check_unit(path, rows)
    elif UNITS[unit] != 1.0:
        rows = [_scaled(row, UNITS[unit]) for row in rows]
    return _as_map(rows, frame_id, sigma_m, orientation_sigma_rad, np.array(TAG_AXES[tag_axes]))


def _rows(path: Path, left_out: list[str]) -> list[Row]:
    if path.stat().st_size > MAX_BYTES:
        raise MapError(f'it has more than {MAX_BYTES // 10**6} MB')
    suffix = path.suffix.lower()
    if suffix in ('.csv', '.txt', '.tsv'):
        return table_rows(path, left_out)
    if suffix in ('.imk', '.lmk'):
        return scanner_rows(path)
    if suffix == '.json':
        return _field_rows(json.loads(read_text(path)))
    return _yaml_rows(path, left_out)


def _check_unit(path: Path, rows: Sequence[Row]) -> None:
    """Ask what unit coordinates are in that look like millimetres."""
    points = np.array([row.position for row in rows])
    extent_m = float(np.ptp(points, axis=0).max())
    if extent_m < WIDE_M or len(rows) < 2:
        return
    off_m = np.linalg.norm(points[:, None] - points, axis=2) + np.diag(np.full(len(rows), np.inf))
    if np.median(off_m.min(axis=1)) > SPARSE_M:
        raise MapError(
            f'{path}: the landmarks are {extent_m / 1000.0:.1f} km apart: are these millimetres? '
            "Give --unit mm, or --unit m if they are right; a table's columns may say it: 'x [mm]'"
        )


def _scaled(row: Row, scale: float) -> Row:
    return row._replace(position=scale * row.position, covariance=scale**2 * row.covariance)


def _yaml_rows(path: Path, left_out: list[str]) -> list[Row]:
    content = load_yaml(path, MAX_BYTES, plain_value)
    if isinstance(content, Mapping) and 'bodies' in content:
        return _tagslam_rows(content['bodies'], content.get('body_defaults') or {}, left_out)
    if isinstance(content, list):  # TagSLAM's output
        return _tagslam_rows(content, {}, left_out)
    if isinstance(content, Mapping) and 'tag_bundles' in content:
        if content.get('standalone_tags'):
            left_out.append('standalone_tags, which have no place')
        return _bundle_rows(content['tag_bundles'])
    raise MapError(f'it is not laid out as {LAYOUTS}; tables are named .csv, fields of FRC .json')


def _tagslam_rows(
    entries: Sequence[Mapping[str, Any]], defaults: Mapping[str, Any], left_out: list[str]
) -> list[Row]:
    """Return the tags of bodies that stand still, and have a place in the map."""
    bodies = [_tagslam_body(entry) for entry in entries]
    static = [(name, body) for name, body in bodies if body.get('is_static', False)]
    left_out += [
        f'body {shown(name)}, which moves' for name, body in bodies if (name, body) not in static
    ]
    rows = []
    for name, body in static:
        if body.get('type') == 'staggered_board':
            left_out.append(f'body {shown(name)}, a staggered board')
            continue
        if 'pose' not in body and len(static) > 1:
            left_out.append(f'body {shown(name)}, which has no pose')
            continue
        with naming(f'body {shown(name)}'):
            # The frame of one that is alone becomes that of the map.
            in_map = _tagslam_pose(body.get('pose'))
            noise = _tagslam_noise(body.get('pose') or {}, {})
            for tag in [*(body.get('tags') or ()), *_board_tags(body.get('board'))]:
                if 'pose' in tag:
                    rows.append(_tagslam_row(in_map, noise, tag, defaults))
                else:
                    left_out.append(f'tag {shown(tag["id"])}, which has no pose')
    return rows


def _tagslam_body(entry: Mapping[str, Any]) -> tuple[Any, Mapping[str, Any]]:
    if len(entry) != 1:
        names = ', '.join(shown(name) for name in entry)
        raise MapError(f'each body is an entry of its own in the list: {names}')
    ((name, body),) = entry.items()
    return name, body


def _board_tags(board: Mapping[str, Any] | None) -> Iterator[Mapping[str, Any]]:
    """Yield the tags of a board of TagSLAM, which are in rows and columns from its corner on."""
    if board is None:
        return
    step_m = finite(board['tag_size'], 'tag_size') * (
        1.0 + finite(board['tag_spacing'], 'tag_spacing')
    )
    in_board = se3.inverse(_tagslam_pose(board.get('pose')))
    for number in range(board['tag_rows'] * board['tag_columns']):
        row, column = divmod(number, board['tag_columns'])
        pose = in_board @ se3.pose(np.eye(3), np.array([column * step_m, row * step_m, 0.0]))
        noise = {
            f'{kind}_noise': dict.fromkeys('xyz', board[f'tag_{kind}_noise'])
            for kind in ('position', 'rotation')
            if f'tag_{kind}_noise' in board
        }
        rotation = so3.log(pose[:3, :3])
        written = {
            'position': dict(zip('xyz', pose[:3, 3].tolist(), strict=True)),
            'rotation': dict(zip('xyz', rotation.tolist(), strict=True)),
        }
        yield {'id': board['tag_start_id'] + number, 'pose': written | noise}


def _tagslam_row(
    in_map: FloatArray,
    body_noise: FloatArray | None,
    tag: Mapping[str, Any],
    defaults: Mapping[str, Any],
) -> Row:
    """Return a tag of a body, with its noise in the body and the body's own."""
    with naming(f'tag {shown(tag["id"])}'):
        pose = in_map @ _tagslam_pose(tag['pose'])
        noise = _tagslam_noise(tag['pose'], defaults)
        if noise is None:
            return Row(tag['id'], pose[:3, 3], pose[:3, :3], UNKNOWN_NOISE)
        turn, shift = _in_axes(pose[:3, :3], noise)
        if body_noise is not None:
            body_turn, body_shift = _in_axes(in_map[:3, :3], body_noise)
            arm = so3.hat(pose[:3, 3] - in_map[:3, 3])
            turn, shift = turn + body_turn, shift + body_shift + arm @ body_turn @ arm.T
        return Row(
            tag['id'], pose[:3, 3], pose[:3, :3], shift, float(np.sqrt(np.trace(turn) / 3.0))
        )


def _in_axes(R: FloatArray, sigmas: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return covariances (3, 3) of turn and shift from deviations (6,) along a pose's own axes."""
    turn, shift = (R @ np.diag(part**2) @ R.T for part in (sigmas[:3], sigmas[3:]))
    return turn, shift


def _tagslam_pose(written: Mapping[str, Any] | None) -> FloatArray:
    """Return a pose (4, 4) of position and rotation vector; None is the frame itself."""
    if written is None:
        return np.eye(4)
    position, rotation = (_axes(written[name], name) for name in ('position', 'rotation'))
    return se3.pose(so3.exp(rotation), position)


def _tagslam_noise(written: Mapping[str, Any], defaults: Mapping[str, Any]) -> FloatArray | None:
    """Return standard deviations (6,) of rotation and position; None if they are not stated."""
    sigmas = []
    for name in ('rotation_noise', 'position_noise'):
        if name in written:
            sigmas.append(_axes(written[name], name))
        elif name in defaults:
            sigmas.append(np.full(3, finite(defaults[name], name)))
    if len(sigmas) < 2:
        return None
    if (np.concatenate(sigmas) < 0.0).any():
        raise MapError('a noise is negative')
    return np.concatenate(sigmas)


def _axes(written: Mapping[str, Any], name: str) -> FloatArray:
    return np.array([finite(written[axis], f'{name} {axis}') for axis in 'xyz'])


def _bundle_rows(bundles: Sequence[Mapping[str, Any]] | Mapping[str, Any]) -> list[Row]:
    """Return the tags of the one bundle in a file; what is left out of a pose is none."""
    if isinstance(bundles, Mapping):  # of ROS 2
        bundles = [bundles[name] for name in bundles['bundle_names']]
    if len(bundles) > 1:
        raise MapError(f'it has {len(bundles)} bundles, each in a frame of its own: leave one')
    return [row for bundle in bundles for row in _rows_of_bundle(bundle)]


def _rows_of_bundle(bundle: Mapping[Any, Any]) -> list[Row]:
    if 'layout' in bundle:
        return [_bundle_row(tag) for tag in bundle['layout']]
    rows = []
    for tag_id in bundle['ids']:
        with naming(f'tag {shown(tag_id)}'):
            tag = bundle[tag_id] if tag_id in bundle else bundle[str(tag_id)]
            names = ('x', 'y', 'z', 'qw', 'qx', 'qy', 'qz')
            rows.append(
                _bundle_row({'id': tag_id} | dict(zip(names, tag['transform'], strict=True)))
            )
    return rows


def _bundle_row(tag: Mapping[str, Any]) -> Row:
    with naming(f'tag {shown(tag["id"])}'):
        position = np.array([finite(tag.get(axis, 0.0), axis) for axis in 'xyz'])
        quaternion = [finite(tag.get(name, float(name == 'qw')), name) for name in QUATERNION]
        return Row(tag['id'], position, turned(quaternion))


def _field_rows(content: Any) -> list[Row]:
    """Return the tags of an AprilTag field layout of FRC, whose x axis is out of the tag, z up."""
    if not isinstance(content, Mapping) or 'tags' not in content:
        raise MapError("it is no AprilTag field layout of FRC, which has 'tags'")
    rows = []
    for tag in content['tags']:
        with naming(f'tag {shown(tag["ID"])}'):
            pose = tag['pose']
            position = _axes(pose['translation'], 'translation')
            written = pose['rotation']['quaternion']
            R = turned([finite(written[axis], axis) for axis in 'XYZW'])
            rows.append(Row(tag['ID'], position, R @ facing(0.0)))
    return rows


def _check_ids(path: Path, rows: Sequence[Row]) -> None:
    for row in rows:
        if type(row.landmark_id) is not int or not 0 <= row.landmark_id <= MAX_ID:
            raise MapError(
                f'{path}: the id {shown(row.landmark_id)} is not one from 0 to {MAX_ID}'
            )
    landmark_id, count = Counter(row.landmark_id for row in rows).most_common(1)[0]
    if count > 1:
        raise MapError(f'{path}: landmark {landmark_id} is there more than once')


def _as_map(
    rows: Sequence[Row], frame_id: str, sigma_m: float, sigma_rad: float, axes: FloatArray
) -> LandmarkMap:
    """Return the map with orientations from a detector's ``axes`` (3,), signs of the files'."""
    covariances = np.array([row.covariance for row in rows])
    covariances[np.isnan(covariances)] = sigma_m**2
    orientations = np.array([row.orientation for row in rows]) * axes
    are_tags = orientations.any(axis=(1, 2))
    sigmas_rad = np.array([row.orientation_sigma_rad for row in rows])
    sigmas_rad[np.isnan(sigmas_rad)] = sigma_rad
    return LandmarkMap(
        np.array([row.landmark_id for row in rows], dtype=np.int64),
        np.array([row.position for row in rows]),
        covariances,
        np.zeros(len(rows), dtype=np.int64),
        frame_id,
        orientations if are_tags.any() else None,
        sigmas_rad * are_tags if are_tags.any() else None,
    )
