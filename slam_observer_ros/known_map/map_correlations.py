"""How the errors of a map's landmarks are correlated, as one line of its file.

The line stands below the landmarks::

    correlations: {checksum: 2596996162, data: "eJwBCA…"}

``data`` is the covariance of x y z of all landmarks together, m², in the order of the file, and
then of the rotation vectors, along the axes of the map, of those with an orientation, rad². Of its
rows it has the entries up to the diagonal as little-endian 64-bit floats, compressed by zlib, in
base64. ``checksum`` is the CRC-32 of what the lines of the landmarks say, as floats of the same
kind: of each its id, position, sigma or covariance, orientation and orientation_sigma. So nobody
changes a landmark, and leaves correlations that are not those of the new one.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Iterator, Mapping, Sequence
import logging
from typing import Any
import zlib

import numpy as np

from slam_observer_ros.common.errors import MapError, shown
from slam_observer_ros.common.findings import found
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry.matrices import (
    COVARIANCE_ROUNDING,
    diagonal_blocks,
    in_own_deviations,
    LEAST_DEVIATION,
)

logger = logging.getLogger(__name__)

MAX_CORRELATED = 1000
"""Landmarks of a map up to which correlations are saved, in 46 MB then."""

FIELDS = ('checksum', 'data')

_COUNTED = ('id', 'position', 'sigma', 'covariance', 'orientation', 'orientation_sigma')


def as_lines(joint: FloatArray | None, landmarks: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the line for a joint covariance of ``landmarks`` as they are written.

    And no line where there is none, or with a warning where it is too large.
    """
    if joint is None:
        return []
    if len(landmarks) > MAX_CORRELATED:
        logger.warning('%s', found('left_out_correlations', count=len(landmarks)))
        return []
    triangle = joint[np.tril_indices(len(joint))].astype('<f8')
    # Runs are what there is to find, those of zeros in planar maps: at a third of the time.
    packing = zlib.compressobj(level=1, strategy=zlib.Z_RLE)
    packed = packing.compress(triangle.tobytes()) + packing.flush()
    data = base64.b64encode(packed).decode('ascii')
    return [f'correlations: {{checksum: {_checksum(landmarks)}, data: "{data}"}}\n']


def parse(
    content: Any, landmarks: Sequence[Mapping[str, Any]], covariances: FloatArray | None
) -> FloatArray:
    """Return the joint covariance of ``landmarks`` as they were read.

    Raise :exc:`MapError` if it can't be right, or is not that of these landmarks, whose
    own ``covariances`` (n, 3, 3), m², are known.
    """
    try:
        return _parsed(content, landmarks, covariances)
    except MapError as error:
        raise MapError(
            f"its 'correlations' can't be used, {error}: delete the line that begins with "
            "'correlations:', and errors count as independent"
        ) from error


def _parsed(
    content: Any, landmarks: Sequence[Mapping[str, Any]], covariances: FloatArray | None
) -> FloatArray:
    if not isinstance(content, dict) or set(content) != set(FIELDS):
        raise MapError(f'they are not of the form {{{FIELDS[0]}: …, {FIELDS[1]}: …}}')
    if content['checksum'] != _checksum(landmarks):
        raise MapError('a landmark was added, removed, moved or changed since')
    if covariances is None:
        raise MapError('the landmarks have no covariances')
    tags = sum('orientation' in row for row in landmarks)
    joint = _decoded(content['data'], 3 * (len(landmarks) + tags))
    check_joint(joint, covariances)
    return joint


def check_joint(joint: FloatArray, covariances: FloatArray) -> None:
    """Check a joint covariance of n or more vectors against those of the landmarks (n, 3, 3).

    Raise :exc:`MapError` if there are others on its diagonal, or it is none.
    """
    joint = np.asarray(joint, dtype=np.float64)
    blocks, scaled = diagonal_blocks(joint, 3)[: len(covariances)], in_own_deviations(joint)
    deviations = np.sqrt(np.maximum(np.diagonal(blocks, axis1=1, axis2=2), LEAST_DEVIATION**2))
    differences = np.abs(blocks - covariances) / (deviations[:, :, None] * deviations[:, None, :])
    if differences.max(initial=0.0) > COVARIANCE_ROUNDING:
        raise MapError('a landmark has another covariance there')
    if np.abs(scaled - scaled.T).max() > COVARIANCE_ROUNDING:
        raise MapError('they are not symmetric')
    scaled[np.diag_indices(len(scaled))] += COVARIANCE_ROUNDING
    try:
        np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError as error:
        raise MapError('they are negative in some direction') from error


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
    numbers = [number for row in landmarks for number in _numbers(row)]
    return zlib.crc32(np.array(numbers, dtype='<f8').tobytes())


def _numbers(row: Mapping[str, Any]) -> Iterator[float]:
    """Yield what a landmark's line says, in one order."""
    for name in _COUNTED:
        if name in row:
            yield from np.ravel(row[name]).tolist()
