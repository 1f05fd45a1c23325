"""Starry Night: a stereo camera and gyroscopes moved by hand above 20 LEDs, full 3D.

Data set 3 of T. Barfoot's course and book *State Estimation for Robotics*, University of Toronto.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy.io

from slam_observer_ros.common.errors import DataSetError, message_of
from slam_observer_ros.common.files import not_special
from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.evaluation.run_record import LandmarkTruth
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.geometry import se3, so3
from slam_observer_ros.recording.writer import DataSet

EPOCH_NS = 1_256_566_448 * NANOSECONDS_PER_SECOND
"""Time zero of the recording, which states none: when its file was made, 2009-10-26."""

_SHAPES = {
    't': (1, -1),
    'v_vk_vk_i': (3, -1),
    'w_vk_vk_i': (3, -1),
    'y_k_j': (4, -1, 20),
    'r_i_vk_i': (3, -1),
    'theta_vk_i': (3, -1),
    'rho_i_pj_i': (3, 20),
    'C_c_v': (3, 3),
    'rho_v_c_v': (3, 1),
    **dict.fromkeys(('fu', 'fv', 'cu', 'cv', 'b'), (1, 1)),
}
"""Shape of each variable; -1 is the number of images."""

_MAX = 1e6
"""More than any time, pixel or distance of the file."""


def load_starry_night(file: Path | str) -> DataSet:
    """Read ``dataset3.mat``; raise a DataSetError if it is missing, damaged or another file.

    Landmark ids are the indices of the LEDs; the body frame is the data set's vehicle frame.
    """
    variables = _read(Path(file))
    stamps_ns = EPOCH_NS + np.rint(variables['t'][0] * NANOSECONDS_PER_SECOND).astype(np.int64)
    # The file's angular velocity has its sign flipped, as the stereo points and the truth show.
    body_velocities = np.hstack((-variables['w_vk_vk_i'].T, variables['v_vk_vk_i'].T))
    rotations = so3.exp(variables['theta_vk_i'].T)
    world_points = variables['rho_i_pj_i'].T
    return DataSet(
        stamps_ns,
        body_velocities,
        _observations(stamps_ns, variables),
        stamps_ns,
        se3.pose(rotations, variables['r_i_vk_i'].T),
        LandmarkTruth(np.arange(len(world_points)), world_points),
    )


def triangulate(pixels: FloatArray, variables: dict[str, FloatArray]) -> FloatArray:
    """Return points (..., 3) in the vehicle frame, metres, from where a stereo camera sees them.

    The pixels (4, ...) are columns and rows in the left and the right image: u_l, v_l, u_r, v_r.
    The variables are intrinsics ``fu fv cu cv``, baseline ``b`` in metres, and the camera's
    mounting: ``C_c_v`` takes vehicle axes to camera axes, ``rho_v_c_v`` is its position.
    """
    fu, fv, cu, cv, baseline = (variables[name].item() for name in ('fu', 'fv', 'cu', 'cv', 'b'))
    left_column, left_row, right_column, right_row = pixels
    depth = fu * baseline / (left_column - right_column)
    camera_points = np.stack(
        (
            (left_column - cu) * depth / fu,
            ((left_row + right_row) / 2.0 - cv) * depth / fv,
            depth,
        ),
        axis=-1,
    )
    # Row vectors: p C is Cᵀ p.
    vehicle_points: FloatArray = camera_points @ variables['C_c_v'] + variables['rho_v_c_v'][:, 0]
    return vehicle_points


def _read(file: Path) -> dict[str, FloatArray]:
    try:
        with not_special(file).open('rb') as stream:
            variables: dict[str, FloatArray] = scipy.io.loadmat(stream)
    except FileNotFoundError as error:
        raise DataSetError(f'{file}: no such file; give dataset3.mat of Starry Night') from error
    except Exception as error:  # SciPy's reader raises nearly anything where bytes are damaged
        if isinstance(error, OSError) and error.errno:
            raise DataSetError(message_of(error)) from error
        raise DataSetError(f'{file}: not a MATLAB file, or damaged: {error}') from error
    missing = [name for name in _SHAPES if name not in variables]
    if missing:
        raise DataSetError(f'{file}: not Starry Night: it has no {" ".join(missing)}')
    images = np.size(variables['t'])
    for name, shape in _SHAPES.items():
        expected = tuple(images if size == -1 else size for size in shape)
        if variables[name].shape != expected:
            raise DataSetError(f'{file}: {name} has shape {variables[name].shape}, not {expected}')
        if not _are_plausible(variables[name]):
            raise DataSetError(f'{file}: damaged: {name} has no numbers, or some beyond {_MAX:g}')
    return {name: variables[name].astype(np.float64) for name in _SHAPES}


def _are_plausible(values: FloatArray) -> bool:
    """Return whether they are real numbers, none of them NaN or larger than any of the file."""
    return values.dtype.kind in 'fiu' and bool((np.abs(values.astype(np.float64)) <= _MAX).all())


def _observations(stamps_ns: IntArray, variables: dict[str, FloatArray]) -> list[ObservationEvent]:
    pixels = variables['y_k_j']
    seen = pixels.min(axis=0) >= 0.0  # -1 where a landmark isn't seen.
    observations = []
    for image in np.flatnonzero(seen.any(axis=1)).tolist():
        ids = np.flatnonzero(seen[image])
        with np.errstate(divide='ignore', invalid='ignore'):
            points = triangulate(pixels[:, image, ids], variables)
        if not np.isfinite(points).all():
            raise DataSetError(f'image {image} sees a point at infinity: the file is damaged')
        observations.append(ObservationEvent(int(stamps_ns[image]), ids, points))
    return observations
