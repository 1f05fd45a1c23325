"""A landmark of another program's map, and the numbers in which it is written."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from slam_observer_ros.common.errors import MapError, shown
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry import so3
from slam_observer_ros.known_map.map_file import MAX_NUMBER

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
