"""The last pose of a robot in a file, for the next start."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from slam_observer_ros.common.errors import MapError, YamlError
from slam_observer_ros.common.files import unfinished_file
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.common.yaml_files import load_yaml, plain_value
from slam_observer_ros.geometry import se3, so3
from slam_observer_ros.known_map.landmark_map import MAX_NUMBER

FORMAT = 'slam_observer_ros pose'
MAX_BYTES = 10_000
SIZES = {'position': 3, 'orientation': 4, 'covariance': 36}


@dataclass(frozen=True, slots=True, eq=False)
class StoredPose:
    """Where the robot was, and when, by the system's clock."""

    pose: FloatArray  # (4, 4) in frame_id
    covariance: FloatArray  # (6, 6) of rotation vector and position along the map's axes
    frame_id: str
    time_s: float  # since 1970


def write_pose(path: Path, stored: StoredPose) -> None:
    """Write the file whole, or not at all; MapError if it can't be written."""
    content = {
        'format': FORMAT,
        'frame': stored.frame_id,
        'time': stored.time_s,
        'position': stored.pose[:3, 3].tolist(),
        'orientation': so3.to_quaternion(stored.pose[:3, :3]).tolist(),
        'covariance': stored.covariance.ravel().tolist(),
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with unfinished_file(path) as file:
            yaml.safe_dump(content, file, sort_keys=False)
    except OSError as error:
        raise MapError(f"can't write the pose {path}: {error.strerror}") from error


def read_pose(path: Path) -> StoredPose:
    """Read the file; MapError if it can't be read, or is no such file."""
    try:
        content = load_yaml(path, MAX_BYTES, plain_value)
    except OSError as error:
        raise MapError(f"can't read the pose {path}: {error.strerror}") from error
    except YamlError as error:
        raise MapError(f'the pose {path} is not valid YAML: {error}') from error
    if not isinstance(content, dict) or content.get('format') != FORMAT:
        raise MapError(f"{path} has no line 'format: {FORMAT}'")
    values = {name: _numbers(path, content, name, size) for name, size in SIZES.items()}
    (time_s,) = _numbers(path, {'time': [content.get('time')]}, 'time', 1)
    quaternion = values['orientation']
    if not 0.99 < np.linalg.norm(quaternion) < 1.01:
        raise MapError(f"the pose {path}: 'orientation' is no unit quaternion")
    rotation = so3.from_quaternion(quaternion)
    return StoredPose(
        se3.pose(rotation, values['position']),
        values['covariance'].reshape(6, 6),
        str(content.get('frame')),
        float(time_s),
    )


def _numbers(path: Path, content: dict[str, Any], name: str, size: int) -> FloatArray:
    written = content.get(name)
    numbers = written if isinstance(written, list) else []
    # NaN is within no bounds, and an int may have more digits than any array takes.
    are_usable = all(type(each) in (int, float) and abs(each) <= MAX_NUMBER for each in numbers)
    if len(numbers) != size or not are_usable:
        raise MapError(
            f"the pose {path}: '{name}' is not {size} finite numbers, {MAX_NUMBER:g} at most"
        )
    return np.array(numbers, dtype=np.float64)
