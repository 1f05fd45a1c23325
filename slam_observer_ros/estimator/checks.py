"""Refuses events, points and poses that can't be used, before they reach the state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
import math

import numpy as np

from slam_observer_ros.common.errors import InvalidEventError, MapError, ParameterError
from slam_observer_ros.common.types import (
    BoolArray,
    FIRST_AUTOMATIC_ID,
    FloatArray,
    IntArray,
    is_automatic,
    LAST_AUTOMATIC_ID,
)
from slam_observer_ros.estimates import Outcomes, Reason
from slam_observer_ros.estimator.event_warnings import EventWarnings, listed
from slam_observer_ros.events import (
    AngularVelocityEvent,
    AZIMUTH_RANGE,
    Event,
    flatten,
    IMPOSSIBLE_ID,
    MAX_ID,
    ObservationEvent,
    POINT,
    UNKNOWN_ID,
    VelocityBlock,
    VelocityEvent,
)
from slam_observer_ros.filter.gains import Gains
from slam_observer_ros.filter.landmark_table import LandmarkTable
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.matrices import are_covariances, MAX_DEVIATION, transpose
from slam_observer_ros.mapping.landmark_map import check_joint, LandmarkMap, MAX_NUMBER
from slam_observer_ros.settings.estimator_settings import MAX_POSITION_M, Settings

ROTATION_TOLERANCE = 1e-3
"""How far RᵀR of a pose may be from identity: much further than single precision puts it."""

MAX_STAMP_NS = 2**63 - 1  # what fits into the integers of numpy

MAX_MEASURED = 1e6
"""Size of a coordinate or velocity beyond which it can only be a sensor's way to say 'none'."""

NEARLY = 1.0 - 1e-9
"""Share of a limit below which a value is below the limit, however it is rounded."""

SECTORS = 12
"""Directions about the vertical axis in each of which the nearest points are used first."""

HALVES = range(AZIMUTH_RANGE + 1)  # kinds of points, whole and half ones

_INTEGERS = (int, np.int64)
_FLOAT64 = np.dtype(np.float64)


def check_event(event: Event, settings: Settings) -> None:
    """Check an event's shapes and values; the settings limit velocities.

    Raises
    ------
    InvalidEventError
        With the reason ``'wrong_type'``, ``'negative_stamp'``, ``'wrong_shape'``,
        ``'not_finite'``, ``'too_large'``, ``'too_fast'``, ``'negative_id'``,
        ``'bad_covariance'`` or ``'bad_orientation'``.

    """
    if isinstance(event, VelocityEvent):
        if _is_usual(event, settings):
            return
        _check_velocity(event.body_velocity, event.covariance, 6)
        _check_speed(event.body_velocity, settings)
    elif isinstance(event, AngularVelocityEvent):
        _check_velocity(event.angular_velocity, event.covariance, 3)
        _check_speed(event.angular_velocity, settings)
    elif isinstance(event, ObservationEvent):
        _check_observation(event)
        if settings.use_tag_orientation:
            _check_orientations(event)
    else:
        raise InvalidEventError('wrong_type', f'a {type(event).__name__} is no event')
    stamp_ns, receive_ns = event.stamp_ns, event.receive_ns
    if not isinstance(stamp_ns, _INTEGERS):
        reason = f'stamp {stamp_ns!r} is no int or np.int64: stamps are in nanoseconds'
        raise InvalidEventError('wrong_type', reason)
    if stamp_ns < 0:
        raise InvalidEventError('negative_stamp', f'stamp {stamp_ns} ns is negative')
    if stamp_ns > MAX_STAMP_NS:
        raise InvalidEventError('too_large', f'stamp {stamp_ns} ns is beyond 64 bits')
    if receive_ns is not None and not isinstance(receive_ns, _INTEGERS):
        raise InvalidEventError('wrong_type', f'receive_ns {receive_ns!r} is no int or np.int64')


def are_finite(event: ObservationEvent) -> BoolArray | None:
    """Return of which points (m,) nothing is NaN or infinite; None where that is of no point.

    A covariance that one tag misses says nothing against the other tags of the message.
    """
    fit, m = np.ones(len(event.ids), dtype=np.bool_), len(event.ids)
    for array in event.of_points().values():
        if not _is_plain(array) or len(array) != m or array.dtype.kind not in 'fiu':
            return None
        fit &= np.isfinite(array).reshape(m, -1).all(axis=1)
    return fit if fit.any() else None


def check_velocities(velocities: VelocityBlock, settings: Settings) -> None:
    """Raise :exc:`InvalidEventError` if :func:`check_event` might refuse one of the velocities."""
    body_velocities, covariances = velocities.body_velocities, velocities.covariances
    _check_coordinates('velocities', body_velocities, (len(velocities), 6))
    squares = np.add.reduceat(body_velocities**2, [0, 3], axis=1).max(axis=0)
    most = np.array([settings.max_angular_velocity, settings.max_linear_velocity])
    if (squares > NEARLY * most**2).any():
        raise InvalidEventError('too_fast', 'a velocity is near the greatest that is believed')
    if covariances is not None:
        _check_array('velocity covariances', covariances, (len(velocities), 6, 6))
        _check_definite('velocity covariances', covariances)
    if velocities.stamps_ns[0] < 0:
        raise InvalidEventError('negative_stamp', 'a stamp is negative')


def rigid(pose: FloatArray, covariance: FloatArray | None = None) -> FloatArray:
    """Return ``pose`` (4, 4), whose rotation may be off by rounding, as a rigid motion.

    Raise :exc:`ParameterError` if it is none, or ``covariance`` (6, 6) no covariance.
    """
    try:
        _check_array('pose', pose, (4, 4))
        if covariance is not None:
            _check_array('pose covariance', covariance, (6, 6))
            _check_definite('pose covariance', covariance)
    except InvalidEventError as error:
        raise ParameterError(str(error)) from error
    R, x = pose[:3, :3], pose[:3, 3]
    if not _are_rotations(R) or (pose[3] != (0.0, 0.0, 0.0, 1.0)).any():
        raise ParameterError('pose: no matrix [[R, x], [0, 1]] with a rotation R')
    if np.abs(x).max() > MAX_POSITION_M:
        raise ParameterError(f'pose: its position has an entry beyond {MAX_POSITION_M:g} m')
    return se3.pose(so3.exact(R), x)


def usable_map(landmark_map: LandmarkMap) -> LandmarkMap:
    """Return a map, whose orientations may be off by rounding, with rotations.

    Raise :exc:`MapError` if an array does not fit, a value can't be right, or an id is repeated.
    """
    if not isinstance(landmark_map, LandmarkMap):
        kind = type(landmark_map).__name__
        raise MapError(f'a {kind} is no LandmarkMap; known_map.map_file.read_map reads one')
    try:
        ids, n = landmark_map.ids, len(landmark_map.ids)
        _check_array('map ids', ids, (n,))
        _check_array('map counts', landmark_map.counts, (n,))
        _check_numbers('map points', landmark_map.world_points, (n, 3))
        if landmark_map.covariances is not None:
            _check_numbers('map covariances', landmark_map.covariances, (n, 3, 3))
            _check_definite('map covariances', landmark_map.covariances)
        if landmark_map.joint_covariance is not None:
            size = 3 * (n + len(landmark_map.tags))
            _check_numbers('joint map covariance', landmark_map.joint_covariance, (size, size))
        if landmark_map.orientations is not None:
            _check_rotations('map orientations', landmark_map.orientations, n)
        if landmark_map.orientation_sigmas is not None:
            _check_numbers('map orientation sigmas', landmark_map.orientation_sigmas, (n,))
    except InvalidEventError as error:
        raise MapError(str(error)) from error
    _check_joint(landmark_map)
    if ids.dtype.kind not in 'iu' or np.any((ids < 0) | (ids > MAX_ID)):
        raise MapError(f'map ids: integers from 0 to {MAX_ID} are wanted')
    if np.any(landmark_map.counts < 0):
        raise MapError('map counts: one is negative')
    if len(np.unique(ids)) < n:
        raise MapError('an id is there more than once in the map')
    R, sigmas = landmark_map.orientations, landmark_map.orientation_sigmas
    if (R is None) != (sigmas is None):
        raise MapError('map orientations and their sigmas: there is only one of them')
    if sigmas is not None and np.any(sigmas < 0.0):
        raise MapError('map orientation sigmas: one is negative')
    return landmark_map if R is None else replace(landmark_map, orientations=so3.exact(R))


def usable_maps(landmark_map: LandmarkMap | Sequence[LandmarkMap]) -> list[LandmarkMap]:
    """Return one map or several, each as :func:`usable_map` does; several are in one frame."""
    maps = list(landmark_map) if isinstance(landmark_map, Sequence) else [landmark_map]
    maps = [usable_map(known) for known in maps]
    if not maps or (len(maps) > 1 and not all(len(known.ids) for known in maps)):
        raise MapError('a map of several is empty, or there is none')
    first, *others = sorted({known.frame_id for known in maps})
    if others:
        raise MapError(f"the maps are in frames '{first}' and '{others[0]}': make them the same")
    return maps


def _check_joint(landmark_map: LandmarkMap) -> None:
    joint, covariances = landmark_map.joint_covariance, landmark_map.covariances
    if joint is None or not len(landmark_map.ids):
        return
    if covariances is None:
        raise MapError('joint map covariance: it needs the covariances of its landmarks, too')
    try:
        check_joint(joint, covariances)
    except MapError as error:
        raise MapError(f'joint map covariance: {error}') from error


def _is_usual(event: VelocityEvent, settings: Settings) -> bool:
    """Return whether nothing is wrong with a velocity, at a tenth of what it costs to say what."""
    V, stamp_ns, receive_ns = event.body_velocity, event.stamp_ns, event.receive_ns
    if event.covariance is not None or type(V) is not np.ndarray:
        return False
    if V.dtype is not _FLOAT64 or V.shape != (6,):
        return False
    if type(stamp_ns) is not int or not 0 <= stamp_ns <= MAX_STAMP_NS:
        return False
    if receive_ns is not None and type(receive_ns) is not int:
        return False
    a, b, c, d, e, f = V.tolist()
    turns_slowly: bool = a * a + b * b + c * c <= settings.max_angular_velocity**2
    drives_slowly: bool = d * d + e * e + f * f <= settings.max_linear_velocity**2
    return turns_slowly and drives_slowly


def _check_velocity(velocity: FloatArray, covariance: FloatArray | None, size: int) -> None:
    _check_coordinates('velocity', velocity, (size,))
    if covariance is not None:
        _check_array('velocity covariance', covariance, (size, size))
        _check_definite('velocity covariance', covariance)


def _check_speed(velocity: FloatArray, settings: Settings) -> None:
    """Check a velocity (Ω, v), or Ω alone, against the greatest that a robot can have."""
    for part, unit, name in (
        (velocity[:3], 'rad/s', 'max_angular_velocity'),
        (velocity[3:], 'm/s', 'max_linear_velocity'),
    ):
        size, most = math.sqrt(part.dot(part)), getattr(settings, name)
        if size > most:
            text = f'a velocity of {size:.1f} {unit} is beyond {name} ({most:g} {unit})'
            raise InvalidEventError('too_fast', text)


def _check_observation(event: ObservationEvent) -> None:
    is_stack = isinstance(event.points, np.ndarray) and event.points.ndim > 0
    m = len(event.points) if is_stack else 0
    if not _is_plain(event.ids) or event.ids.dtype.kind not in 'iu':
        raise InvalidEventError('wrong_type', 'landmark ids are not an array of integers')
    if event.ids.dtype == np.uint64:  # which NumPy joins with int64 as float64
        raise InvalidEventError('wrong_type', 'landmark ids are uint64: make them int64')
    _check_coordinates('landmark points', event.points, (m, 3))
    if event.ids.shape != (m,):
        raise InvalidEventError('wrong_shape', f'ids {event.ids.shape} for {m} landmark points')
    for landmark_id in event.ids.tolist():
        if landmark_id < 0 and landmark_id not in (UNKNOWN_ID, IMPOSSIBLE_ID):
            raise InvalidEventError('negative_id', f'landmark id {landmark_id} is negative')
        if landmark_id > MAX_ID:
            raise InvalidEventError('too_large', f'landmark id {landmark_id} is beyond {MAX_ID}')
    if event.covariances is not None:
        _check_array('landmark covariances', event.covariances, (m, 3, 3))
        _check_definite('landmark covariances', event.covariances)
    if event.velocities is not None:
        _check_coordinates('landmark velocities', event.velocities, (m, 3))
    if event.sensor is not None:
        _check_coordinates("sensor's positions", event.sensor, (m, 3))
    if event.kinds is not None:
        _check_array('kinds of points', event.kinds, (m,))
        if event.kinds.dtype.kind != 'i' or not np.isin(event.kinds, HALVES).all():
            raise InvalidEventError('wrong_type', f'a kind of point is none of {list(HALVES)}')


def _check_orientations(event: ObservationEvent) -> None:
    """Check that orientations are rotations, or all zero where unknown."""
    m = len(event.ids)
    if event.orientations is not None:
        _check_rotations('landmark orientations', event.orientations, m)
    if event.orientation_covariances is not None:
        _check_array('orientation covariances', event.orientation_covariances, (m, 3, 3))
        _check_definite('orientation covariances', event.orientation_covariances)


def _check_rotations(name: str, orientations: FloatArray, m: int) -> None:
    _check_array(name, orientations, (m, 3, 3))
    if not _are_rotations(orientations[orientations.any(axis=(1, 2))]):
        raise InvalidEventError('bad_orientation', f'{name}: one is no rotation')


def _are_rotations(R: FloatArray) -> bool:
    skew = np.abs(transpose(R) @ R - np.eye(3)).max(initial=0.0)
    return bool(skew < ROTATION_TOLERANCE and np.all(np.linalg.det(R) > 0.0))


def _check_coordinates(name: str, array: FloatArray, shape: tuple[int, ...]) -> None:
    if type(array) is np.ndarray and array.shape == shape and array.dtype == np.float64:
        # Nothing wrong passes this one product, at a fifth of the cost of checking each entry.
        entries = array.ravel()
        with np.errstate(over='ignore'):
            if entries.dot(entries) <= MAX_MEASURED**2:
                return
    _check_array(name, array, shape)
    if np.abs(array).max(initial=0.0) > MAX_MEASURED:
        raise InvalidEventError('too_large', f'an entry of the {name} is beyond {MAX_MEASURED:g}')


def _check_array(name: str, array: FloatArray | IntArray, shape: tuple[int, ...]) -> None:
    if not _is_plain(array) or array.dtype not in (np.float64, np.float32, np.int64):
        text = f'{name}: no plain numpy array of float64, float32 or int64'
        raise InvalidEventError('wrong_type', text)
    if array.shape != shape:
        raise InvalidEventError('wrong_shape', f'{name}: shape {array.shape}, not {shape}')
    if not np.isfinite(array).all():
        raise InvalidEventError('not_finite', f'an entry of the {name} is NaN or infinite')


def _is_plain(array: object) -> bool:
    """Return whether something is an array on which all operations mean what they should."""
    return isinstance(array, np.ndarray) and not isinstance(array, np.ma.MaskedArray | np.matrix)


def _check_numbers(name: str, array: FloatArray, shape: tuple[int, ...]) -> None:
    """Check numbers of a map, which may not be larger than in a file."""
    _check_array(name, array, shape)
    if np.abs(array).max(initial=0.0) > MAX_NUMBER:
        raise InvalidEventError('too_large', f'an entry of the {name} is beyond {MAX_NUMBER:g}')


def _check_definite(name: str, covariances: FloatArray) -> None:
    """Check that covariances (…, d, d) are symmetric and have no negative eigenvalue.

    Zeros are exact: in one's row and column there must be nothing else.
    """
    if are_covariances(covariances).all():
        return
    exact = np.diagonal(covariances, axis1=-2, axis2=-1) == 0.0
    what = 'asymmetric, or with a negative eigenvalue'
    if (exact[..., None] & (covariances != 0.0)).any():
        what = 'a variance of zero, which says exact, has other entries in its row than zeros'
    raise InvalidEventError('bad_covariance', f'{name}: {what}')


def usable_points(
    event: ObservationEvent,
    settings: Settings,
    gains: Gains,
    landmarks: LandmarkTable,
    counts: Outcomes,
    warnings: EventWarnings,
) -> ObservationEvent:
    """Return an observation as the states use it; count its points, warn of those left out."""
    counts['observed_point'] += len(event.ids)
    if settings.two_d_mode and (event.velocities is not None or event.points[:, 2].any()):
        event = flatten(event)
    if event.orientations is not None:
        used = None if gains.tags is None else so3.exact(event.orientations)
        event = replace(event, orientations=used)
    if gains.observer.is_exact and event.velocities is not None:
        event = replace(event, velocities=None)  # its landmarks are at rest
    if event.covariances is not None:
        # Stated to be anywhere within MAX_DEVIATION.
        least = np.diagonal(event.covariances, axis1=1, axis2=2).min(axis=1)
        if vague := np.count_nonzero(least >= MAX_DEVIATION**2):
            counts['vague_point'] += vague
            warnings.warn('vague_point', count=vague, limit_m=MAX_DEVIATION)
    ids = event.ids.tolist()
    are_usual = 0 < len(set(ids)) == len(ids) <= settings.max_points
    if are_usual and min(ids) >= 0 and max(ids) < FIRST_AUTOMATIC_ID:
        return event
    if (impossible := event.ids == IMPOSSIBLE_ID).any():
        warnings.warn('impossible_id', count=int(np.sum(impossible)))
        counts.note(Reason.IMPOSSIBLE_ID, event.ids[impossible], event.stamp_ns)
        event = event.select(~impossible)
    reserved = is_automatic(event.ids)  # given here, to landmarks without an id
    if np.count_nonzero(reserved):
        named = listed(event.ids[reserved].tolist())
        warnings.warn('reserved_id', ids=named, first=FIRST_AUTOMATIC_ID, last=LAST_AUTOMATIC_ID)
        counts.note(Reason.RESERVED_ID, event.ids[reserved], event.stamp_ns)
        event = event.select(~reserved)
    if repeated_ids := event.repeated_ids():  # nobody knows which of the points is right
        warnings.warn('repeated_id', ids=listed(repeated_ids))
        repeated = np.isin(event.ids, repeated_ids)
        counts.note(Reason.REPEATED_ID, event.ids[repeated], event.stamp_ns)
        event = event.select(~repeated)
    unknown = event.ids == UNKNOWN_ID
    if event.kinds is not None and (halves := unknown & (event.kinds != POINT)).any():
        warnings.warn('half_point_without_id', count=int(np.sum(halves)))
        counts.note(Reason.NO_ID, event.ids[halves], event.stamp_ns)
        event, unknown = event.select(~halves), unknown[~halves]
    can_weigh = gains.errors is not None
    if not can_weigh and np.count_nonzero(unknown):
        warnings.warn('unknown_id', gains=settings.gains)
        counts.note(Reason.NO_ID, event.ids[unknown], event.stamp_ns)
        event = event.select(~unknown)
    elif can_weigh and len(event.ids) > settings.max_points:
        count, most = len(event.ids), settings.max_points
        source = event.sensor_frame or 'a sensor'
        warnings.warn('surplus_point', source=source, count=count, most=most)
        useful = _most_useful(event, landmarks.ids, most)
        counts.note(Reason.SURPLUS, event.ids[~useful], event.stamp_ns)
        event = event.select(useful)
    return event


def _most_useful(event: ObservationEvent, known_ids: IntArray, most: int) -> BoolArray:
    """Return which points (m,) are used, where there are more than can be in time.

    Known landmarks first, as they say where the robot is, then points without an id, which may be
    some, then new ones. Of each kind the nearest in each direction: directions that differ say
    more, and the nearest are measured best, and are the same in the next observation.
    """
    kind = np.where(event.ids == UNKNOWN_ID, 1, 2)
    kind[np.isin(event.ids, known_ids)] = 0
    lines = event.lines_of_sight
    ranges_m = np.linalg.norm(lines, axis=1)
    sector = np.floor(SECTORS * (np.arctan2(lines[:, 1], lines[:, 0]) / (2.0 * np.pi) + 0.5))
    order = np.lexsort((ranges_m, sector, kind))
    group = SECTORS * kind[order] + np.minimum(sector[order], SECTORS - 1)
    # How many of its kind and sector are nearer.
    place = np.arange(len(order)) - np.searchsorted(group, group)
    order = order[np.lexsort((ranges_m[order], place, kind[order]))]
    useful = np.zeros(len(order), dtype=np.bool_)
    useful[order[:most]] = True
    return useful
