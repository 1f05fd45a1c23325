"""Maps of other programs: a landmark as they write it, and tables of these.

Tables are of people and spreadsheets, fiducial_slam's map.txt, and navigation scanners'.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
import csv
from pathlib import Path
import re
from typing import Any, NamedTuple

import numpy as np

from slam_observer_ros.common.errors import MapError, shown
from slam_observer_ros.common.files import read_text
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.mapping.landmark_map import MAX_NUMBER

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


COLUMNS = ('id', 'x', 'y', 'z', 'sigma')
"""Of a table without a header, in this order; z and sigma may be left out."""

QUATERNION = ('qx', 'qy', 'qz', 'qw')

SIGMAS = ('sigma_x', 'sigma_y', 'sigma_z')

USED = (*COLUMNS, *SIGMAS, 'yaw', *QUATERNION, 'orientation_sigma')

_KINDS = ('tag', 'marker', 'fiducial', 'landmark')

OTHER_NAMES = {
    **{name: 'id' for kind in _KINDS for name in (kind, f'{kind}_id')},
    **{f'{before}{axis}': axis for before in ('t', 'pos_', 'position_') for axis in 'xyz'},
}

IGNORED = ('size', 'tag_size', 'observations')
"""Columns of numbers that a map does without; others may be of a kind that changes it."""

UNITS = {'': 1.0, 'm': 1.0, 'rad': 1.0, 'mm': 1e-3, 'cm': 1e-2, 'deg': np.pi / 180.0}
UNITS['°'] = UNITS['deg']

UNKNOWN_M = 10.0
"""Standard deviation of a height that a table does not have."""

MAX_YAW_RAD = 6.3
"""A larger one is taken to be in degrees."""

_UNIT = re.compile(r'(.*?)\s*[\[(](.*)[\])]|(.+)_(m|mm|cm|rad|deg)')
_COMMA_OF_DECIMALS = re.compile(r'[-+]?\d*,\d+(?:[eE][-+]?\d+)?')
_WORDS = re.compile(r'(?:[^\s,]+|[-+]?\d*,\d+)(?:\s+(?:[^\s,]+|[-+]?\d*,\d+))+')
"""What spaces separate; a comma inside is one of decimals."""

_FIDUCIAL_SLAM = ('id', 'x', 'y', 'z', 'roll', 'pitch', 'yaw', 'variance', 'observations')


def table_rows(path: Path, left_out: list[str]) -> list[Row]:
    """Read a table; names of columns that are left out are added to ``left_out``.

    Cells are separated by commas, semicolons, tabs or spaces. Raises a MapError that names the
    line if it can't be right.
    """
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
        lines = [_uncommented(line) for line in lines]
    delimiter = next((sign for sign in ';\t' if sign in first), ',')
    is_spaced = delimiter == ',' and _WORDS.fullmatch(first.strip()) is not None
    reader = csv.reader(lines, delimiter=delimiter)
    found = (
        enumerate(map(str.split, lines), 1)
        if is_spaced
        else ((reader.line_num, cells) for cells in reader)
    )
    stripped = [(number, [_decimal(cell.strip()) for cell in cells]) for number, cells in found]
    return [
        (number, cells)
        for number, cells in stripped
        if any(cells) and not cells[0].startswith('#') and not cells[0].lower().startswith('sep=')
    ]


def _uncommented(line: str) -> str:
    """Return a line as it is, or without its #, if it names the columns."""
    bare = line.lstrip().lstrip('#').strip()
    return bare if {'id', 'x', 'y'} <= set(re.split(r'[\s,;]+', bare.lower())) else line


def _decimal(cell: str) -> str:
    return cell.replace(',', '.') if _COMMA_OF_DECIMALS.fullmatch(cell) else cell


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
            turn = ' (a tag that is not upright takes a quaternion)' if name in _TILTS else ''
            raise MapError(
                f"line {number}: column '{name}' is {cell}, and is not known here{turn}; "
                f'leave it out, or name it as one of {known}'
            )
        unused.append(f"column '{name}'")
    return unused


_TILTS = ('roll', 'pitch')


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
        covariance = np.diag([variance] * 3)
        return Row(int(cells[0]), pose[:3, 3], pose[:3, :3], covariance)


def scanner_rows(path: Path) -> list[Row]:
    """Read the landmark file of a navigation scanner: id, x and y in mm, and what it is.

    Type, subtype, size and layer, which may follow, say nothing of the place. Raises a MapError
    that names the line if it can't be right.
    """
    rows = []
    for number, cells in _cells(read_text(path)):
        with naming(f'line {number}'):
            if len(cells) < 3 or not all(map(_is_number, cells)):
                raise MapError('it is not laid out as: globID x/mm y/mm type subtype size layerID')
            mm = UNITS['mm']
            rows.append(_row({'id': (cells[0], 1.0), 'x': (cells[1], mm), 'y': (cells[2], mm)}))
    return rows
