"""Maps as files: landmark ids, positions and what is known of their accuracy."""

from __future__ import annotations

import os
from pathlib import Path

import yaml

from slam_observer_ros.errors import RecordingError
from slam_observer_ros.types import FloatArray, IntArray

FORMAT_VERSION = 1


def write_map(
    path: Path,
    ids: IntArray,
    world_points: FloatArray,
    counts: IntArray,
    covariances: FloatArray | None = None,
    frame_id: str = 'map',
) -> None:
    """Write a map as YAML, a line a landmark; the file appears whole or not at all.

    Parameters
    ----------
    path : Path
        File to create or replace.
    ids : IntArray
        (n,) landmark ids.
    world_points : FloatArray
        (n, 3) positions, metres, in ``frame_id``.
    counts : IntArray
        (n,) in how many observations each was seen.
    covariances : FloatArray, optional
        (n, 3, 3) covariances of the positions, m².
    frame_id : str
        Frame of the positions.

    Raises
    ------
    RecordingError
        If the file can't be written.

    """
    head = {'format': 'slam_observer_ros map', 'version': FORMAT_VERSION, 'frame': frame_id}
    landmarks: list[dict[str, object]] = [
        {'id': landmark_id, 'position': position, 'observations': count}
        for landmark_id, position, count in zip(
            ids.tolist(), world_points.tolist(), counts.tolist(), strict=True
        )
    ]
    if covariances is not None:
        for landmark, covariance in zip(landmarks, covariances.tolist(), strict=True):
            landmark['covariance'] = covariance
    unfinished = path.with_name(f'.{path.name}.{os.getpid()}')
    try:
        with unfinished.open('w', encoding='utf-8') as file:
            yaml.safe_dump(head, file, sort_keys=False)
            file.write('landmarks:\n' if landmarks else 'landmarks: []\n')
            for landmark in landmarks:
                file.write(f'- {_on_one_line(landmark)}')
        unfinished.replace(path)
    except OSError as error:
        raise RecordingError(f"can't write {path}: {error.strerror}") from error
    finally:
        unfinished.unlink(missing_ok=True)


def _on_one_line(landmark: dict[str, object]) -> str:
    return yaml.safe_dump(landmark, default_flow_style=True, sort_keys=False, width=10**6)
