"""Maps as YAML files: a head, then a line a landmark.

The same format serves saved maps and surveyed ones. A surveyor writes no more than this::

    format: slam_observer_ros map
    version: 1
    frame: map
    landmarks:
    - {id: 7, position: [1.5, -2.0, 0.3], sigma: 0.01}

``sigma`` is the standard deviation of each coordinate, metres; a saved map has the whole
``covariance`` (m²) instead, ``observations`` (how often each landmark was seen), and in its head
the ``package_version`` and ``settings`` with which it was made. A tag may have an ``orientation``,
a quaternion x y z w from its own axes, and its ``orientation_sigma``, rad, about each axis. Below
the landmarks of a saved map a line says how their errors are correlated::

    correlations: {checksum: 2596996162, data: "eJwBCA…"}

``data`` is the covariance of x y z of all landmarks together, m², in the order of the file, and
then of the rotation vectors, along the axes of the map, of those with an orientation, rad². Of its
rows it has the entries up to the diagonal as little-endian 64-bit floats, compressed by zlib, in
base64. ``checksum`` is the CRC-32 of what the lines of the landmarks say, as floats of the same
kind: of each its id, position, sigma or covariance, orientation and orientation_sigma. So nobody
changes a landmark, and leaves correlations that the new one has not.
"""

from __future__ import annotations

import base64
import binascii
from collections import Counter
from collections.abc import Mapping, Sequence
import dataclasses
import logging
from pathlib import Path
import re
import tempfile
from typing import Any
import zlib

import numpy as np
import yaml

from slam_observer_ros.common import __version__
from slam_observer_ros.common.errors import failing, MapError, shown, YamlError
from slam_observer_ros.common.files import (
    constructed,
    destination,
    FAST_LOADER,
    keep_copy,
    load_yaml,
    plain_value,
    read_text,
    unfinished_file,
)
from slam_observer_ros.common.findings import found
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import MAX_ID
from slam_observer_ros.lie import so3
from slam_observer_ros.lie.matrices import are_covariances
from slam_observer_ros.mapping.landmark_map import (
    check_joint,
    LandmarkMap,
    MAX_CORRELATED,
    MAX_NUMBER,
)
from slam_observer_ros.settings.estimator_settings import Settings

logger = logging.getLogger(__name__)

FORMAT = 'slam_observer_ros map'
FORMAT_VERSION = 1
_MAX_INT64 = 2**63 - 1
_ROUNDED_NORM = 1e-2  # by how much the norm of a quaternion written by hand may be off
_COUNTED = ('id', 'position', 'sigma', 'covariance', 'orientation', 'orientation_sigma')
_OPTIONAL = ('sigma', 'covariance', 'observations', 'orientation', 'orientation_sigma')
_Dumper = getattr(yaml, 'CSafeDumper', yaml.SafeDumper)
MAX_BYTES = 70_000_000  # the largest file: two hundred thousand landmarks with covariances

# Decimal numbers alone: by YAML 1.1, 010 is 8 and 1:30 is 90.
_INT = re.compile(r'[-+]?(?:0|[1-9][0-9]*)')
_FLOAT = re.compile(r'[-+]?(?:\.[0-9]+|[0-9]+\.[0-9]*|[0-9]+(?=[eE]))(?:[eE][-+]?[0-9]+)?')
_NUMBER_STARTS = frozenset('+-.0123456789')
_NOT_FINITE = re.compile(r'[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)')


def write_map(
    path: Path, landmark_map: LandmarkMap, settings: Settings | None, backup: Path | None = None
) -> None:
    """Write a map, and the settings it was made with, if any; whole, or a MapError is raised.

    Correlations between too many landmarks are left out, with a warning. ``backup`` becomes a copy
    of the file that is replaced, once the new one is written.
    """
    if not len(landmark_map.ids):
        raise MapError(f'the map is empty: nothing is written to {path}')
    head: dict[str, object] = {
        'format': FORMAT,
        'version': FORMAT_VERSION,
        'frame': landmark_map.frame_id,
        'package_version': __version__,
    }
    if settings is not None:
        head['settings'] = {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in dataclasses.asdict(settings).items()
        }
    landmarks = _as_mappings(landmark_map)
    on_one_line: Any = {'default_flow_style': True, 'sort_keys': False, 'width': 10**6}
    lines = [f'- {yaml.dump(each, Dumper=_Dumper, **on_one_line)}' for each in landmarks]
    lines += _correlation_lines(landmark_map.joint_covariance, landmarks)
    with failing(MapError, f"can't write map {path}"), unfinished_file(path) as file:
        yaml.safe_dump(head, file, sort_keys=False)
        file.write('landmarks:\n')
        file.writelines(lines)
        file.flush()  # and a full disk shows before anything is replaced
        if backup is not None:
            keep_copy(path, backup)


def check_writable(path: Path) -> None:
    """Raise a MapError if no map could be written there, before there is one."""
    with failing(MapError, f"can't write map {path}"):
        if path.is_dir():
            raise MapError(f"can't write map {path}: it is a directory")
        directory = destination(path).parent
    try:
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError as error:
        reason = f'the directory {directory} takes no file: {error.strerror}'
        raise MapError(f"can't write map {path}: {reason}") from error


class OtherFileError(MapError):
    """A file that is no map of landmarks, nor meant to be one."""


def read_map(path: Path) -> LandmarkMap:
    """Read a map, strictly.

    Raise :exc:`MapError` if the file can't be read, is no map of a known version, has a field too
    few or too many, or a value that can't be right; the message names the file, the landmark and
    the reason.
    """
    try:
        content = load_yaml(path, MAX_BYTES, _plain_value, FAST_LOADER)
    except OSError as error:
        raise MapError(f"can't read map {path}: {error.strerror}") from error
    except YamlError as error:
        kind = MapError if FORMAT in read_text(path) else OtherFileError
        raise kind(f'map {path} is not valid YAML: {error}') from error
    try:
        return dataclasses.replace(_parse(content), name=path.stem)
    except MapError as error:
        raise type(error)(f'map {path}: {error}') from error


def read_maps(path: Path) -> list[LandmarkMap]:
    """Read a map, or a folder's; of equal ones the first, others skipped with a warning."""
    files, maps = map_files(path), list[LandmarkMap]()
    if files == [path]:
        return [read_map(path)]
    stems = Counter(file.stem for file in files)
    for file in files:
        try:
            known = read_map(file)
        except OtherFileError as error:
            why = str(error).removeprefix(f'map {file}').removeprefix(': it').strip()
            logger.warning('%s', found('skipped_file', name=file.name, why=why))
            continue
        if stems[file.stem] > 1:
            known = dataclasses.replace(known, name=file.name)
        if twins := [each for each in maps if each.says_the_same(known)]:
            finding = found('equal_maps', name=known.name, other=twins[0].name)
            logger.warning('%s', finding)
            continue
        maps.append(known)
    if not maps:
        raise MapError(f'there is no map of landmarks in the folder {path}')
    return maps


def map_files(path: Path) -> list[Path]:
    """Return the file of a map, or a folder's files, by name; MapError if there are none."""
    with failing(MapError, f"can't read map {path}"):
        if not path.is_dir():
            return [path]
        files = sorted(
            file
            for file in path.iterdir()
            if file.suffix in ('.yaml', '.yml') and not file.is_dir()
        )
    if not files:
        raise MapError(f'there is no map, a file *.yaml, in the folder {path}')
    return files


def _plain_value(text: str) -> object:
    if text[:1] not in _NUMBER_STARTS:
        return plain_value(text)
    if _FLOAT.fullmatch(text):
        return float(text)
    if _INT.fullmatch(text):
        return int(text)
    return constructed('float', text) if _NOT_FINITE.fullmatch(text) else text


def _as_mappings(landmark_map: LandmarkMap) -> list[dict[str, Any]]:
    landmarks: list[dict[str, Any]] = [
        {'id': landmark_id, 'position': position, 'observations': count}
        for landmark_id, position, count in zip(
            landmark_map.ids.tolist(),
            landmark_map.world_points.tolist(),
            landmark_map.counts.tolist(),
            strict=True,
        )
    ]
    if landmark_map.covariances is not None:
        for landmark, covariance in zip(landmarks, landmark_map.covariances, strict=True):
            landmark['covariance'] = covariance.tolist()
    R, sigmas = landmark_map.orientations, landmark_map.orientation_sigmas
    if R is not None and sigmas is not None:
        for i in np.flatnonzero(R.any(axis=(1, 2))).tolist():
            landmarks[i]['orientation'] = so3.to_quaternion(R[i]).tolist()
            landmarks[i]['orientation_sigma'] = float(sigmas[i])
    return landmarks


def _parse(content: Any) -> LandmarkMap:
    if isinstance(content, dict) and {'image', 'resolution'} <= content.keys():
        raise OtherFileError("it is an occupancy grid, as map_server's, and no map of landmarks")
    if not isinstance(content, dict) or content.get('format') != FORMAT:
        reason = f"it has no line 'format: {FORMAT}'; slam-observer map convert makes maps"
        raise OtherFileError(reason)
    version = content.get('version')
    if version != FORMAT_VERSION:
        raise MapError(f'it has version {shown(version)}; this program reads {FORMAT_VERSION}')
    required = ('format', 'version', 'frame', 'landmarks')
    _check_names('it', content, required, ('package_version', 'settings', 'correlations'))
    frame_id, rows = content['frame'], content['landmarks']
    _expect(
        isinstance(frame_id, str) and frame_id != '', f"'frame' is {shown(frame_id)}, not a name"
    )
    _expect(isinstance(rows, list), "'landmarks' is not a list")
    _expect(len(rows) > 0, 'it has no landmarks')
    ids = []
    for index, row in enumerate(rows):
        who = f'entry {index} of landmarks'
        _expect(isinstance(row, dict), f'{who} is not of the form {{id: …, position: …}}')
        _check_names(who, row, ('id', 'position'), _OPTIONAL)
        landmark_id = _natural(row['id'], f"{who}: 'id'")
        _expect(landmark_id <= MAX_ID, f"{who}: 'id' is {landmark_id}, beyond {MAX_ID}")
        ids.append(landmark_id)
    for landmark_id, times in Counter(ids).items():
        _expect(times == 1, f'landmark {landmark_id} is there {times} times')
    points, counts = [], []
    for row in rows:
        who = f'landmark {row["id"]}'
        points.append(_numbers(row['position'], 3, f"{who}: 'position'"))
        counts.append(_natural(row.get('observations', 0), f"{who}: 'observations'"))
    landmark_map = LandmarkMap(
        np.array(ids, dtype=np.int64),
        np.array(points),
        _covariances(rows),
        np.array(counts, dtype=np.int64),
        frame_id,
        *_orientations(rows),
    )
    if 'correlations' not in content:
        return landmark_map
    joint = _correlations(content['correlations'], rows, landmark_map.covariances)
    return dataclasses.replace(landmark_map, joint_covariance=joint)


def _orientations(
    rows: Sequence[Mapping[str, Any]],
) -> tuple[FloatArray | None, FloatArray | None]:
    """Return orientations (n, 3, 3), zero for points, and sigmas (n,), rad; None without any."""
    if not any('orientation' in row for row in rows):
        return None, None
    R, sigmas = np.zeros((len(rows), 3, 3)), np.zeros(len(rows))
    for i, row in enumerate(rows):
        who = f'landmark {row["id"]}'
        given = [name for name in ('orientation', 'orientation_sigma') if name in row]
        _expect(len(given) != 1, f"{who} needs both 'orientation' and 'orientation_sigma'")
        if given:
            quaternion = np.array(_numbers(row['orientation'], 4, f"{who}: 'orientation'"))
            is_turn = abs(np.linalg.norm(quaternion) - 1.0) < _ROUNDED_NORM
            _expect(is_turn, f"{who}: 'orientation' is no quaternion x y z w of norm 1")
            R[i] = so3.from_quaternion(quaternion)
            (sigmas[i],) = _numbers([row['orientation_sigma']], 1, f"{who}: 'orientation_sigma'")
            _expect(sigmas[i] >= 0.0, f"{who}: 'orientation_sigma' is negative")
    return R, sigmas


def _covariances(rows: Sequence[Mapping[str, Any]]) -> FloatArray | None:
    """Return (n, 3, 3) covariances, m²; None where no landmark has one."""
    if not any('sigma' in row or 'covariance' in row for row in rows):
        return None
    read: list[list[list[float]]] = []
    for row in rows:
        who = f'landmark {row["id"]}'
        given = [name for name in ('sigma', 'covariance') if name in row]
        _expect(len(given) < 2, f"{who} has both 'sigma' and 'covariance': leave one")
        _expect(bool(given), f"{who} has no 'sigma' or 'covariance', as others have: give all one")
        if 'sigma' in row:
            (sigma_m,) = _numbers([row['sigma']], 1, f"{who}: 'sigma'")
            _expect(sigma_m >= 0.0, f"{who}: 'sigma' is negative")
            v = sigma_m**2
            read.append([[v, 0.0, 0.0], [0.0, v, 0.0], [0.0, 0.0, v]])
            continue
        lines = row['covariance']
        _expect(isinstance(lines, list) and len(lines) == 3, f"{who}: 'covariance' is not 3 × 3")
        read.append([_numbers(line, 3, f"{who}: a row of 'covariance'") for line in lines])
    covariances = np.array(read)
    is_wrong = ~are_covariances(covariances)
    if is_wrong.any():
        who = f'landmark {rows[int(is_wrong.argmax())]["id"]}'
        what = 'is not symmetric, or negative in some direction'
        raise MapError(f"{who}: 'covariance' {what}")
    return covariances


def _check_names(
    who: str, mapping: Mapping[Any, Any], required: Sequence[str], optional: Sequence[str]
) -> None:
    for name in required:
        _expect(name in mapping, f"{who} has no '{name}'")
    for name in mapping:
        if name not in required and name not in optional:
            raise MapError(f'{who} has {shown(name)}, which is not known here')


def _natural(value: Any, what: str) -> int:
    if type(value) is int and 0 <= value <= _MAX_INT64:
        return value
    raise MapError(f'{what} is {shown(value)}, not a whole number ≥ 0')


def _numbers(value: Any, count: int, what: str) -> list[float]:
    if not isinstance(value, list) or len(value) != count:
        raise MapError(f'{what} is {shown(value)}, not a list of {count} numbers')
    for entry in value:
        # Written so that NaN is refused too.
        if type(entry) not in (int, float) or not abs(entry) <= MAX_NUMBER:
            raise MapError(f'{what} has {shown(entry)}, no finite number')
    return [float(entry) for entry in value]


def _expect(holds: bool, message: str) -> None:
    if not holds:
        raise MapError(message)


def _correlation_lines(
    joint: FloatArray | None, landmarks: Sequence[Mapping[str, Any]]
) -> list[str]:
    """Return the line for a joint covariance of ``landmarks``, if there is one, not too large."""
    if joint is None:
        return []
    if len(landmarks) > MAX_CORRELATED:
        logger.warning('%s', found('left_out_correlations', count=len(landmarks)))
        return []
    triangle = joint[np.tril_indices(len(joint))].astype('<f8')
    # There are only runs to find, of zeros in planar maps: at a third of the time.
    packing = zlib.compressobj(level=1, strategy=zlib.Z_RLE)
    packed = packing.compress(triangle.tobytes()) + packing.flush()
    data = base64.b64encode(packed).decode('ascii')
    return [f'correlations: {{checksum: {_checksum(landmarks)}, data: "{data}"}}\n']


def _correlations(
    content: Any, landmarks: Sequence[Mapping[str, Any]], covariances: FloatArray | None
) -> FloatArray:
    """Return the joint covariance of ``landmarks``; MapError if it does not fit them."""
    try:
        is_whole = isinstance(content, dict) and set(content) == {'checksum', 'data'}
        _expect(is_whole, 'they are not of the form {checksum: …, data: …}')
        is_of_these = content['checksum'] == _checksum(landmarks)
        _expect(is_of_these, 'a landmark was added, removed, moved or changed since')
        _expect(covariances is not None, 'the landmarks have no covariances')
        tags = sum('orientation' in row for row in landmarks)
        joint = _decoded(content['data'], 3 * (len(landmarks) + tags))
        check_joint(joint, np.asarray(covariances))
    except MapError as error:
        raise MapError(
            f"its 'correlations' can't be used, {error}: delete the line that begins with "
            "'correlations:', and errors count as independent"
        ) from error
    return joint


def _decoded(data: Any, size: int) -> FloatArray:
    """Return the symmetric matrix (size, size)."""
    if not isinstance(data, str):
        raise MapError(f"'data' is {shown(data)}, no text")
    rows, columns = np.tril_indices(size)
    expected = 8 * len(rows)
    try:
        unpacking = zlib.decompressobj()
        # No more than is expected, whatever is packed there.
        raw = unpacking.decompress(base64.b64decode(data, validate=True), expected + 1)
    except (binascii.Error, ValueError, zlib.error) as error:
        raise MapError(f"'data' is damaged ({error})") from error
    if len(raw) != expected or not unpacking.eof or unpacking.unused_data:
        vectors = f'{size // 3} positions and orientations'
        raise MapError(f"'data' does not have {expected} bytes, as of {vectors}")
    values = np.frombuffer(raw, '<f8').astype(np.float64)
    if not np.isfinite(values).all():
        raise MapError('an entry is NaN or infinite')
    matrix = np.empty((size, size))
    matrix[rows, columns] = matrix[columns, rows] = values
    return matrix


def _checksum(landmarks: Sequence[Mapping[str, Any]]) -> int:
    """Return the CRC-32 of what the landmarks' lines say, in one order."""
    numbers = [np.ravel(row[name]) for row in landmarks for name in _COUNTED if name in row]
    return zlib.crc32(np.concatenate(numbers, dtype='<f8').tobytes())
