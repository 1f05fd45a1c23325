"""Maps of other programs: tables, TagSLAM's bodies, bundles, FRC's fields, scanners' landmarks.

Tables are of people and spreadsheets, fiducial_slam's map.txt, and navigation scanners'. In all
but FRC's fields the axes of a tag are, seen from before the upright tag: x to the right, y up, z
out of it. So TagSLAM and apriltag_ros have them, and AprilTags are upright as they are printed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
import csv
import json
import logging
from pathlib import Path
import re
from typing import Any, NamedTuple

import numpy as np

from slam_observer_ros.common.errors import MapError, shown, YamlError
from slam_observer_ros.common.files import load_yaml, plain_value, read_text
from slam_observer_ros.common.findings import found
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import MAX_ID
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.mapping.landmark_map import LandmarkMap, MAX_NUMBER

logger = logging.getLogger(__name__)

NO_ORIENTATION = np.zeros((3, 3))
UNKNOWN_NOISE = np.diag(np.full(3, np.nan))


class Row(NamedTuple):
    """A landmark as a file has it; NaN stands for the default."""

    landmark_id: Any
    position: FloatArray  # (3,) in the map, metres
    orientation: FloatArray = NO_ORIENTATION  # (3, 3) from the tag's own axes; zero of a point
    covariance: FloatArray = UNKNOWN_NOISE  # (3, 3) along the map's axes, m²
    orientation_sigma_rad: float = np.nan


def reason(error: Exception) -> str:
    """Return what is wrong, also if it is a key that is missing."""
    return f'{shown(error.args[0])} is missing' if isinstance(error, KeyError) else str(error)


@contextmanager
def naming(what: str) -> Iterator[None]:
    """Name what it is of that can't be right."""
    try:
        yield
    except (MapError, KeyError, ValueError) as error:
        raise MapError(f'{what}: {reason(error)}') from error


def finite(written: Any, name: str) -> float:
    """Return a number; raise a MapError that names it if it is none that a map can have."""
    try:
        number = float(written)
    except (TypeError, ValueError, OverflowError):
        number = np.nan
    if not abs(number) <= MAX_NUMBER:  # nor NaN
        raise MapError(f'{name} is {shown(written)}, which is not a finite number')
    return number


def turned(quaternion: Sequence[float]) -> FloatArray:
    """Return the orientation (3, 3) of a quaternion x y z w."""
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1.0) > so3.QUATERNION_NORM_TOLERANCE:
        raise MapError(f'the quaternion has norm {norm:.3g}, not 1')
    return so3.from_quaternion(np.array(quaternion))


def facing(yaw_rad: float) -> FloatArray:
    """Return the orientation (3, 3) of an upright tag that looks in a direction."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[-s, 0.0, c], [c, 0.0, s], [0.0, 1.0, 0.0]])


MAX_BYTES = 20_000_000
LAYOUTS = "TagSLAM's files, with 'bodies', or apriltag_ros's, with 'tag_bundles'"

# The axes x, y, z that detectors give a tag, along those in the files; ``none`` for points.
TAG_AXES: Mapping[str, Sequence[float]] = {
    'right-up-out': (1.0, 1.0, 1.0),
    'right-down-in': (1.0, -1.0, -1.0),
    'left-down-out': (-1.0, -1.0, 1.0),
    'none': (0.0, 0.0, 0.0),
}

LENGTHS = ('m', 'cm', 'mm')  # units of coordinates

# Extent of a map, and distance of half of its landmarks to the nearest other, from which on both
# its coordinates are hardly in metres: no sensor sees two of them at once.
WIDE_M, SPARSE_M = 1000.0, 100.0
MAX_NAMED = 12  # of what is left out, as many are named in one line


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
    is in none of the formats, or has a wrong value; it names the file, the line or tag and why.
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
    for row in rows:
        if type(row.landmark_id) is not int or not 0 <= row.landmark_id <= MAX_ID:
            raise MapError(
                f'{path}: the id {shown(row.landmark_id)} is not one from 0 to {MAX_ID}'
            )
    landmark_id, count = Counter(row.landmark_id for row in rows).most_common(1)[0]
    if count > 1:
        raise MapError(f'{path}: landmark {landmark_id} is there more than once')
    positions = np.array([row.position for row in rows])
    covariances = np.array([row.covariance for row in rows])
    if unit is None:
        _check_unit(path, positions)
    else:
        positions, covariances = UNITS[unit] * positions, UNITS[unit] ** 2 * covariances
    covariances[np.isnan(covariances)] = sigma_m**2
    orientations = np.array([row.orientation for row in rows]) * np.array(TAG_AXES[tag_axes])
    are_tags = orientations.any(axis=(1, 2))
    sigmas_rad = np.array([row.orientation_sigma_rad for row in rows])
    sigmas_rad[np.isnan(sigmas_rad)] = orientation_sigma_rad
    return LandmarkMap(
        np.array([row.landmark_id for row in rows], dtype=np.int64),
        positions,
        covariances,
        np.zeros(len(rows), dtype=np.int64),
        frame_id,
        orientations if are_tags.any() else None,
        sigmas_rad * are_tags if are_tags.any() else None,
    )


def _check_unit(path: Path, positions: FloatArray) -> None:
    """Ask what unit coordinates (n, 3) are in that look like millimetres."""
    extent_m = float(np.ptp(positions, axis=0).max())
    if extent_m < WIDE_M or len(positions) < 2:
        return
    off_m = np.linalg.norm(positions[:, None] - positions, axis=2)
    np.fill_diagonal(off_m, np.inf)
    if np.median(off_m.min(axis=1)) > SPARSE_M:
        raise MapError(
            f'{path}: the landmarks are {extent_m / 1000.0:.1f} km apart: are these millimetres? '
            "Give --unit mm, or --unit m if they are right; a table's columns may say it: 'x [mm]'"
        )


def _rows(path: Path, left_out: list[str]) -> list[Row]:
    if path.stat().st_size > MAX_BYTES:
        raise MapError(f'it has more than {MAX_BYTES // 10**6} MB')
    suffix = path.suffix.lower()
    if suffix in ('.csv', '.txt', '.tsv'):
        return _table_rows(path, left_out)
    if suffix in ('.imk', '.lmk'):
        return _scanner_rows(path)
    if suffix == '.json':
        return _field_rows(json.loads(read_text(path)))
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
    for entry in entries:
        if len(entry) != 1:
            names = ', '.join(shown(name) for name in entry)
            raise MapError(f'each body is an entry of its own in the list: {names}')
    bodies = [body for entry in entries for body in entry.items()]
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
            # The frame of a body that is alone is the map's.
            in_map = _tagslam_pose(body.get('pose'))
            noise = _tagslam_noise(body.get('pose') or {}, {})
            for tag in [*(body.get('tags') or ()), *_board_tags(body.get('board'))]:
                if 'pose' in tag:
                    rows.append(_tagslam_row(in_map, noise, tag, defaults))
                else:
                    left_out.append(f'tag {shown(tag["id"])}, which has no pose')
    return rows


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
        R, position = pose[:3, :3], pose[:3, 3]
        turn, shift = _turned(R, noise)
        if body_noise is not None:
            arm = so3.hat(position - in_map[:3, 3])
            body_turn, body_shift = _turned(in_map[:3, :3], body_noise)
            turn, shift = turn + body_turn, shift + body_shift + arm @ body_turn @ arm.T
        return Row(tag['id'], position, R, shift, float(np.sqrt(np.trace(turn) / 3.0)))


def _turned(R: FloatArray, sigmas: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return covariances (3, 3) of turn and shift, of deviations (6,) along axes turned by R."""
    turn, shift = (R @ np.diag(part**2) @ R.T for part in np.split(sigmas, 2))
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
    both = np.concatenate(sigmas)
    if (both < 0.0).any():
        raise MapError('a noise is negative')
    return both


def _axes(written: Mapping[str, Any], name: str) -> FloatArray:
    return np.array([finite(written[axis], f'{name} {axis}') for axis in 'xyz'])


def _bundle_rows(bundles: Sequence[Mapping[Any, Any]] | Mapping[str, Any]) -> list[Row]:
    """Return the tags of the one bundle in a file; what is left out of a pose is none."""
    if isinstance(bundles, Mapping):  # of ROS 2
        bundles = [bundles[name] for name in bundles['bundle_names']]
    if len(bundles) > 1:
        raise MapError(f'it has {len(bundles)} bundles, each in a frame of its own: leave one')
    rows = []
    for bundle in bundles:
        rows += [_bundle_row(tag) for tag in bundle.get('layout', ())]
        for tag_id in bundle['ids'] if 'layout' not in bundle else ():
            with naming(f'tag {shown(tag_id)}'):
                tag = bundle[tag_id] if tag_id in bundle else bundle[str(tag_id)]
                pose = zip(('x', 'y', 'z', 'qw', 'qx', 'qy', 'qz'), tag['transform'], strict=True)
                rows.append(_bundle_row({'id': tag_id} | dict(pose)))
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


COLUMNS = ('id', 'x', 'y', 'z', 'sigma')  # without a header; z and sigma may be left out
QUATERNION = ('qx', 'qy', 'qz', 'qw')
SIGMAS = ('sigma_x', 'sigma_y', 'sigma_z')
USED = (*COLUMNS, *SIGMAS, 'yaw', *QUATERNION, 'orientation_sigma')
_KINDS = ('tag', 'marker', 'fiducial', 'landmark')

OTHER_NAMES = {
    **{name: 'id' for kind in _KINDS for name in (kind, f'{kind}_id')},
    **{f'{before}{axis}': axis for before in ('t', 'pos_', 'position_') for axis in 'xyz'},
}

IGNORED = ('size', 'tag_size', 'observations')  # columns of numbers that change no map
UNITS = {'': 1.0, 'm': 1.0, 'rad': 1.0, 'mm': 1e-3, 'cm': 1e-2, 'deg': np.pi / 180.0}
UNITS['°'] = UNITS['deg']
UNKNOWN_M = 10.0  # standard deviation of a height that a table does not have
MAX_YAW_RAD = 6.3  # a larger one is taken to be in degrees
_UNIT = re.compile(r'(.*?)\s*[\[(](.*)[\])]|(.+)_(m|mm|cm|rad|deg)')
_COMMA_OF_DECIMALS = re.compile(r'[-+]?\d*,\d+(?:[eE][-+]?\d+)?')
# What spaces separate; a comma inside is one of decimals.
_WORDS = re.compile(r'(?:[^\s,]+|[-+]?\d*,\d+)(?:\s+(?:[^\s,]+|[-+]?\d*,\d+))+')
_FIDUCIAL_SLAM = ('id', 'x', 'y', 'z', 'roll', 'pitch', 'yaw', 'variance', 'observations')


def _table_rows(path: Path, left_out: list[str]) -> list[Row]:
    """Read a table of cells between commas, semicolons, tabs or spaces; note ``left_out``."""
    text = read_text(path)
    lines = _cells(text)
    if not lines:
        return []
    if ',' not in text and _is_of_fiducial_slam(lines[0][1]):
        return [_fiducial_slam_row(number, cells) for number, cells in lines]
    names, scales, least = list(COLUMNS), [1.0] * len(COLUMNS), 0
    if not _is_number(lines[0][1][0]):
        names, scales = _columns(lines.pop(0)[1])
        least = 1 + names.index('z') if 'z' in names else 0
    left_out += _unused(names, lines)
    rows = []
    for number, cells in lines:
        with naming(f'line {number}'):
            if any(cells[len(names) :]):
                raise MapError(f'it has more values than columns, which are {", ".join(names)}')
            if len(cells) < least:  # as where a file was cut: z would pass for 0
                raise MapError(f'it has fewer values than columns, which are {", ".join(names)}')
            scaled = dict(zip(names, zip(cells, scales, strict=False), strict=False))
            rows.append(_row({name: cell for name, cell in scaled.items() if cell[0]}))
    return rows


def _cells(text: str) -> list[tuple[int, list[str]]]:
    """Return number and cells of each line that has any; comments are left out."""
    lines = text.splitlines()
    written = [line for line in lines if line.strip() and not line.lstrip().startswith('#')]
    if written and written[0].lower().startswith('sep='):  # for Excel
        written.pop(0)
    if not written:
        return []
    first = written[0]
    if _is_number(first.split(',')[0].split(';')[0].split()[0]):
        # The names of columns may stand behind a #.
        bare = [line.lstrip().lstrip('#').strip() for line in lines]
        named = [{'id', 'x', 'y'} <= set(re.split(r'[\s,;]+', line.lower())) for line in bare]
        lines = [b if is_named else a for a, b, is_named in zip(lines, bare, named, strict=True)]
    delimiter = next((sign for sign in ';\t' if sign in first), ',')
    is_spaced = delimiter == ',' and _WORDS.fullmatch(first.strip()) is not None
    reader = csv.reader(lines, delimiter=delimiter)
    found = (
        enumerate(map(str.split, lines), 1)
        if is_spaced
        else ((reader.line_num, cells) for cells in reader)
    )
    stripped = []
    for number, raw in found:
        cells = [cell.strip() for cell in raw]
        cells = [c.replace(',', '.') if _COMMA_OF_DECIMALS.fullmatch(c) else c for c in cells]
        if any(cells) and not cells[0].startswith('#') and not cells[0].lower().startswith('sep='):
            stripped.append((number, cells))
    return stripped


def _columns(header: Sequence[str]) -> tuple[list[str], list[float]]:
    """Return the names of columns, and by what their values are multiplied."""
    names, scales = [], []
    for written in header:
        name, unit = written.lower(), ''
        if match := _UNIT.fullmatch(name):
            name, unit = (part for part in match.groups() if part is not None)
        name = name.replace(' ', '_')
        if unit not in UNITS and name in USED:
            raise MapError(f"column '{written}' is of a unit that is not known here")
        names.append(OTHER_NAMES.get(name, name))
        scales.append(UNITS.get(unit, 1.0))
    repeated = [name for name, count in Counter(names).items() if count > 1 and name]
    if repeated:
        raise MapError(f"column '{repeated[0]}' is there twice")
    if missing := {'id', 'x', 'y'} - set(names):
        raise MapError(f"there is no column '{min(missing)}'; it needs id, x and y")
    return names, scales


def _unused(names: Sequence[str], lines: Sequence[tuple[int, Sequence[str]]]) -> list[str]:
    """Return the columns that are left out; refuse those whose numbers may change the map."""
    unused = []
    for column, name in enumerate(names):
        numbers = [
            (number, cells[column])
            for number, cells in lines
            if column < len(cells) and _is_number(cells[column])
        ]
        if name in USED or not name:
            continue
        if name in ('roll', 'pitch'):
            numbers = [(number, cell) for number, cell in numbers if float(cell) != 0.0]
        if numbers and name not in IGNORED:
            number, cell = numbers[0]
            known = ', '.join(USED)
            is_tilt = name in ('roll', 'pitch')
            turn = ' (a tag that is not upright takes a quaternion)' if is_tilt else ''
            raise MapError(
                f"line {number}: column '{name}' is {cell}, and is not known here{turn}; "
                f'leave it out, or name it as one of {known}'
            )
        unused.append(f"column '{name}'")
    return unused


def _row(cells: Mapping[str, tuple[str, float]]) -> Row:
    x, y, z = (_cell(cells, name) for name in 'xyz')
    if 'id' not in cells or x is None or y is None:
        raise MapError('it needs id, x and y')
    written, _ = cells['id']
    if not _is_number(written) or float(written) % 1.0 != 0.0:
        raise MapError(f"the id '{written}' is no whole number")
    sigma_m, sigma_rad = (_sigma(cells, name) for name in ('sigma', 'orientation_sigma'))
    own = [_sigma(cells, name) for name in SIGMAS]
    sigmas_m = np.where(np.isnan(own), sigma_m, own)
    if z is None:
        sigmas_m[2] = UNKNOWN_M
    position = np.array([x, y, z or 0.0])
    landmark_id = int(written) if written.lstrip('+-').isdigit() else int(float(written))
    return Row(landmark_id, position, _orientation(cells), np.diag(sigmas_m**2), sigma_rad)


def _sigma(cells: Mapping[str, tuple[str, float]], name: str) -> float:
    """Return the standard deviation in a column; NaN if there is nothing."""
    sigma = _cell(cells, name)
    if sigma is not None and sigma < 0.0:
        raise MapError(f'{name} is negative')
    return np.nan if sigma is None else sigma


def _orientation(cells: Mapping[str, tuple[str, float]]) -> FloatArray:
    """Return the orientation (3, 3) in a table, zero if there is none."""
    yaw_rad, values = _cell(cells, 'yaw'), [_cell(cells, name) for name in QUATERNION]
    quaternion = [value for value in values if value is not None]
    if yaw_rad is not None and quaternion:
        raise MapError('it has a yaw and a quaternion: leave one')
    if yaw_rad is not None:
        if abs(yaw_rad) > MAX_YAW_RAD:
            raise MapError(
                f'yaw is {yaw_rad:g}, more than a turn: it must be in radians, '
                "or its column named 'yaw [deg]'"
            )
        return facing(yaw_rad)
    if not quaternion:
        return NO_ORIENTATION
    if len(quaternion) < len(QUATERNION):
        raise MapError('a quaternion needs qx, qy, qz and qw')
    return turned(quaternion)


def _cell(cells: Mapping[str, tuple[str, float]], name: str) -> float | None:
    """Return the number in a column; None if there is nothing."""
    if name not in cells:
        return None
    written, scale = cells[name]
    return finite(written, name) * scale


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _is_of_fiducial_slam(cells: Sequence[str]) -> bool:
    """Return whether these are id, pose, variance, count and neighbours, all without names."""
    count = len(_FIDUCIAL_SLAM)
    whole = [cells[0], *cells[count - 1 :]]
    return len(cells) >= count and all(map(_is_number, cells)) and all(map(str.isdigit, whole))


def _fiducial_slam_row(number: int, cells: Sequence[str]) -> Row:
    """Return a line of fiducial_slam's map: angles are in degrees, the variance is in m²."""
    with naming(f'line {number}'):
        if not _is_of_fiducial_slam(cells):
            raise MapError(f'it is not laid out as the others: {" ".join(_FIDUCIAL_SLAM)}')
        values = [finite(cell, name) for name, cell in zip(_FIDUCIAL_SLAM, cells, strict=False)]
        x, y, z, *angles = values[1:7]
        pose = se3.from_rpy((x, y, z, *np.radians(angles).tolist()))
        variance = values[7] or np.nan  # zero of the one that the others are measured from
        if variance < 0.0:
            raise MapError('the variance is negative')
        return Row(int(cells[0]), pose[:3, 3], pose[:3, :3], np.diag([variance] * 3))


def _scanner_rows(path: Path) -> list[Row]:
    """Read a navigation scanner's file: id, x and y in mm, and more that is not used."""
    rows = []
    for number, cells in _cells(read_text(path)):
        with naming(f'line {number}'):
            if len(cells) < 3 or not all(map(_is_number, cells)):
                raise MapError('it is not laid out as: globID x/mm y/mm type subtype size layerID')
            mm = UNITS['mm']
            rows.append(_row({'id': (cells[0], 1.0), 'x': (cells[1], mm), 'y': (cells[2], mm)}))
    return rows
