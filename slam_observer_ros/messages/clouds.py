"""Landmark observations from the bytes of sensor_msgs/PointCloud and PointCloud2.

No Python object is made per point: a cloud of 1000 points costs microseconds, not milliseconds.
Which fields a cloud has is known without decoding it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.events import (
    BEARING,
    IMPOSSIBLE_ID,
    MAX_ID,
    ObservationEvent,
    POINT,
    RANGE,
    UNKNOWN_ID,
)
from slam_observer_ros.messages.cdr import Buffer, CdrReader
from slam_observer_ros.messages.registry import reads

ID_NAME = 'id'
POINT_NAMES = ('x', 'y', 'z')
COVARIANCE_NAMES = ('cov_xx', 'cov_xy', 'cov_xz', 'cov_yy', 'cov_yz', 'cov_zz')
VELOCITY_NAMES = ('vx', 'vy', 'vz')
RANGE_NAME, RANGE_VARIANCE_NAME = 'range', 'range_variance'
NO_RANGE_NAME = 'no_range'
UNKNOWN_UINT32_ID = MAX_ID + 1  # how uint32 writes an unknown id: the same bits as -1
FLOAT32_ID_LIMIT = 2**24  # from here on float32 can't distinguish neighbouring ids
POINT_FIELD_UINT32, POINT_FIELD_FLOAT32 = 6, 7  # constants of sensor_msgs/PointField


@dataclass(frozen=True, slots=True)
class CloudField:
    """One sensor_msgs/PointField; ``offset`` in bytes from the start of the point."""

    name: str
    offset: int
    datatype: int
    count: int = 1


class CloudFields(NamedTuple):
    """The names of a PointCloud2's fields, or of a PointCloud's channels, and how many points."""

    names: tuple[str, ...]
    points: int


def read_field(reader: CdrReader) -> CloudField:
    """Read the next sensor_msgs/PointField."""
    return CloudField(reader.string(), reader.uint32(), reader.uint8(), reader.uint32())


def read_fields(raw: Buffer, message_type: str) -> CloudFields:
    """Return what a sensor_msgs/msg/PointCloud or PointCloud2 has; MessageError if malformed."""
    reader = CdrReader(raw)
    reader.header()
    if message_type.endswith('PointCloud2'):
        points = reader.uint32() * reader.uint32()
        return CloudFields(tuple(read_field(reader).name for _ in range(reader.uint32())), points)
    points = reader.uint32()
    reader.float32(3 * points)
    names = []
    for _ in range(reader.uint32()):
        names.append(reader.string())
        reader.float32(reader.uint32())
    return CloudFields(tuple(names), points)


def skip_cloud(reader: CdrReader) -> None:
    """Pass over a sensor_msgs/PointCloud2 inside another message."""
    reader.header()
    reader.uint32()  # height
    reader.uint32()  # width
    for _ in range(reader.uint32()):
        read_field(reader)
    reader.uint8()  # is_bigendian
    reader.uint32()  # point_step
    reader.uint32()  # row_step
    reader.data(reader.uint32())
    reader.uint8()  # is_dense


def missing_ids(names: Sequence[str], message_type: str) -> str:
    """Describe what a cloud has instead of ids; empty if there are ids among its ``names``."""
    if ID_NAME in names:
        return ''
    kind = 'fields' if message_type.endswith('PointCloud2') else 'channels'
    return f'without ids; {kind} {" ".join(names) or "none"}'


# Types whose points may have no ids, or be true landmarks.
CLOUDS = ('sensor_msgs/msg/PointCloud2', 'sensor_msgs/msg/PointCloud')
MAX_UNKNOWN_POINTS = 500  # points without id in a message: associating costs their number cubed
_OF_HALF_POINTS = (RANGE_NAME, RANGE_VARIANCE_NAME, NO_RANGE_NAME)
_READ_NAMES = frozenset(
    (ID_NAME, *POINT_NAMES, *COVARIANCE_NAMES, *VELOCITY_NAMES, *_OF_HALF_POINTS)
)
_UPPER_TRIANGLE_TO_MATRIX = [0, 1, 2, 1, 3, 4, 2, 4, 5]
_NUMPY_TYPES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}
Records: TypeAlias = NDArray[np.void]  # (height, width), one record a point


@reads(CLOUDS[0], role='landmarks')
def decode_point_cloud2(reader: CdrReader) -> ObservationEvent:
    """Read a sensor_msgs/PointCloud2 with fields x, y, z and, if it has them, more.

    ``id`` gives the landmark ids, ``UNKNOWN_ID`` where it holds -1 (2³² - 1 if unsigned) or is
    missing; ``cov_xx cov_xy cov_xz cov_yy cov_yz cov_zz`` a covariance per point in the axes of
    the points, m²; ``vx vy vz`` the velocity of each landmark itself, m/s. A cloud without x, y, z
    but with ``range`` is of distances alone, m, with ``range_variance``, m², if it has that; where
    ``no_range`` is not zero x, y, z are a direction of any length. Points that weren't measured,
    which are NaN or infinite, are left out, whatever their id, and also of clouds called dense.
    """
    stamp_ns, frame_id = reader.header()
    height, width = reader.uint32(), reader.uint32()
    fields = tuple(read_field(reader) for _ in range(reader.uint32()))
    byte_order = '>' if reader.uint8() else '<'
    point_step, row_step = reader.uint32(), reader.uint32()
    data = reader.data(reader.uint32())
    reader.uint8()  # is_dense, which many publishers set for clouds that are not.
    if height * width == 0:
        no_ids = np.zeros(0, dtype=np.int64)
        return ObservationEvent(stamp_ns, no_ids, np.zeros((0, 3)), sensor_frame=frame_id)
    if height > 1 and row_step < width * point_step:  # rows overlap
        raise MessageError(f'row_step {row_step} is shorter than {width} points')
    needed = (height - 1) * row_step + width * point_step
    if len(data) < needed:
        raise MessageError(
            f'data too short: {height} x {width} points need {needed} bytes, not {len(data)}'
        )
    dtype = _record_type(fields, byte_order, point_step)
    strides = (row_step if height > 1 else len(data), point_step)
    records: Records = np.ndarray((height, width), dtype, data, strides=strides)
    return _observation(stamp_ns, frame_id, records)


@reads(CLOUDS[1], role='landmarks')
def decode_point_cloud(reader: CdrReader) -> ObservationEvent:
    """Read a sensor_msgs/PointCloud whose ids, if any, are in the channel ``id``.

    They are ``UNKNOWN_ID`` where the channel holds -1 or is missing, and ``IMPOSSIBLE_ID`` where
    it holds no whole number that float32 holds exactly; a MessageError is raised if none is one.
    """
    stamp_ns, frame_id = reader.header()
    points = reader.float32(3 * reader.uint32()).reshape(-1, 3)
    measured = is_measured(points)
    ids = np.full(len(points), UNKNOWN_ID, dtype=np.int64)
    for _ in range(reader.uint32()):
        name = reader.string()
        values = reader.float32(reader.uint32())
        if name == ID_NAME:
            if len(values) != len(points):
                raise MessageError(f'{len(values)} ids for {len(points)} points')
            ids[measured] = _ids_from_floats(values[measured], FLOAT32_ID_LIMIT)
    return ObservationEvent(stamp_ns, ids, points, sensor_frame=frame_id).select(measured)


def is_measured(points: FloatArray) -> BoolArray:
    """Return which points (n, 3) are neither NaN nor infinite: only those were measured."""
    measured: BoolArray = np.all(np.isfinite(points), axis=1)
    return measured


def scan_problem(event: ObservationEvent) -> str:
    """Return why a message's observation is a lidar's scan, not landmarks; empty if it isn't."""
    unknown = int(np.count_nonzero(event.ids == UNKNOWN_ID))
    if unknown <= MAX_UNKNOWN_POINTS:
        return ''
    return (
        f'{unknown} points without id in one message, more than {MAX_UNKNOWN_POINTS}: landmarks '
        'are wanted, a few to a few hundred a message, not scans'
    )


@lru_cache(maxsize=64)
def _record_type(
    fields: tuple[CloudField, ...], byte_order: str, point_step: int
) -> np.dtype[np.void]:
    """Build the numpy type of one point, with the fields that are read."""
    formats: dict[str, tuple[str, int]] = {}
    for field in fields:
        if field.name not in _READ_NAMES:
            continue
        if field.datatype not in _NUMPY_TYPES or field.count > 1:
            raise MessageError(
                f'field {field.name} is no single number: datatype {field.datatype}, '
                f'count {field.count}'
            )
        if field.name not in (ID_NAME, NO_RANGE_NAME) and field.datatype < POINT_FIELD_FLOAT32:
            raise MessageError(f'field {field.name} is not of type FLOAT32 or FLOAT64')
        numpy_type = byte_order + _NUMPY_TYPES[field.datatype]
        if field.offset + np.dtype(numpy_type).itemsize > point_step:
            raise MessageError(f'field {field.name} lies beyond point_step {point_step}')
        formats[field.name] = (numpy_type, field.offset)
    _require_whole_groups(set(formats))
    return np.dtype(
        {
            'names': list(formats),
            'formats': [numpy_type for numpy_type, _ in formats.values()],
            'offsets': [offset for _, offset in formats.values()],
            'itemsize': point_step,
        }
    )


def _require_whole_groups(names: set[str]) -> None:
    has_ranges = RANGE_NAME in names and not names.intersection(POINT_NAMES)
    if has_ranges and ID_NAME not in names:
        raise MessageError('missing field id: a distance alone is used of known transmitters only')
    for group, optional in (
        (POINT_NAMES, has_ranges),
        (COVARIANCE_NAMES, True),
        (VELOCITY_NAMES, True),
    ):
        missing = [name for name in group if name not in names]
        if missing and not (optional and len(missing) == len(group)):
            raise MessageError(f'missing field {" ".join(missing)}')


def _observation(stamp_ns: int, frame_id: str, records: Records) -> ObservationEvent:
    names = records.dtype.names or ()
    if POINT_NAMES[0] not in names:
        ranges, ids = _columns(records, (RANGE_NAME,))[:, 0], _ids(records)
        variances = None
        if RANGE_VARIANCE_NAME in names:
            variances = _columns(records, (RANGE_VARIANCE_NAME,))[:, 0]
        return observed_ranges(frame_id, stamp_ns, ids, ranges, variances)
    points = _columns(records, POINT_NAMES)
    measured = is_measured(points)
    if not measured.all():  # The other fields of such points may hold anything.
        records, points = records[measured.reshape(records.shape)], points[measured]
    covariances = velocities = None
    if COVARIANCE_NAMES[0] in names:
        upper_triangles = _columns(records, COVARIANCE_NAMES)
        if upper_triangles.any():  # All zeros is how ROS messages say 'unknown'.
            covariances = upper_triangles[:, _UPPER_TRIANGLE_TO_MATRIX].reshape(-1, 3, 3)
    if VELOCITY_NAMES[0] in names:
        velocities = _columns(records, VELOCITY_NAMES)
    event = ObservationEvent(
        stamp_ns, _ids(records), points, covariances, velocities, sensor_frame=frame_id
    )
    if NO_RANGE_NAME not in names:
        return event
    are_directions = records[NO_RANGE_NAME].ravel() != 0
    lengths = np.linalg.norm(points, axis=1)
    points[are_directions] /= np.maximum(lengths, np.finfo(np.float64).tiny)[are_directions, None]
    kinds = np.where(are_directions, BEARING, POINT)
    return replace(event, kinds=kinds).select(~are_directions | (lengths > 0.0))


def observed_ranges(
    frame_id: str,
    stamp_ns: int,
    ids: IntArray,
    ranges: FloatArray,
    variances: FloatArray | None = None,
) -> ObservationEvent:
    """Return distances alone (m,), in one frame; those that are none are left out.

    In which direction the event has them says nothing. Variances (m,), m², are unknown where zero.
    """
    points, covariances = np.zeros((len(ids), 3)), None
    points[:, 0] = ranges
    if variances is not None and variances.any():
        covariances = np.zeros((len(ids), 3, 3))
        covariances[:, 0, 0] = variances
    kinds = np.full(len(ids), RANGE)
    event = ObservationEvent(
        stamp_ns, ids, points, covariances, sensor_frame=frame_id, kinds=kinds
    )
    return event.select(is_measured(points) & (points[:, 0] > 0.0))


def _columns(records: Records, names: tuple[str, ...]) -> FloatArray:
    """Gather fields as (n, len(names)) float64."""
    columns = np.empty((records.size, len(names)))
    with np.errstate(invalid='ignore'):  # Any bits may be there, signalling NaNs, too.
        for index, name in enumerate(names):
            # A product makes them quiet, which a copy does not.
            np.multiply(records[name].ravel(), 1.0, out=columns[:, index])
    return columns


def _ids(records: Records) -> IntArray:
    if ID_NAME not in (records.dtype.names or ()):
        return np.full(records.size, UNKNOWN_ID, dtype=np.int64)
    values = records[ID_NAME].ravel()
    if values.dtype.kind == 'f':
        limit = FLOAT32_ID_LIMIT if values.itemsize == np.float32().itemsize else MAX_ID + 1
        with np.errstate(invalid='ignore'):
            return _ids_from_floats(values.astype(np.float64), limit)
    ids = values.astype(np.int64)
    ids[ids == UNKNOWN_UINT32_ID] = UNKNOWN_ID
    possible = ids >= UNKNOWN_ID
    if ids.size and not possible.any():
        raise MessageError(f'negative landmark id {ids.min()}; only -1 is allowed, for unknown')
    return np.where(possible, ids, IMPOSSIBLE_ID)


def _ids_from_floats(values: FloatArray, limit: int) -> IntArray:
    # The comparison is written so that NaN fails it too.
    exact = (values >= UNKNOWN_ID) & (values < limit) & (values == np.floor(values))
    if exact.all():
        return values.astype(np.int64)
    if not exact.any():  # it is no single mistake, but another quantity
        raise MessageError(
            f'landmark id {values[~exact][0]:.10g} in a float channel is not a whole number '
            f'from -1 to {limit - 1}'
        )
    return np.where(exact, np.where(exact, values, 0.0).astype(np.int64), IMPOSSIBLE_ID)
