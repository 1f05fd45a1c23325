"""What came of an observation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a state made of an observation.

    Attributes
    ----------
    ids : IntArray
        (m,) ids of the landmarks seen that were known before.
    residuals : FloatArray
        (m, 3) their residuals before the correction, metres, reference frame.
    rejected : BoolArray
        (m,) which of them were too far off to be used.
    moved_ids : IntArray
        Landmarks that it showed to have moved.

    """

    ids: IntArray
    residuals: FloatArray
    rejected: BoolArray
    moved_ids: IntArray


def is_contradiction(rejected: BoolArray) -> bool:
    """Return whether most of the known landmarks (m,) seen are rejected: the pose may be wrong."""
    return bool(2 * np.count_nonzero(rejected) > len(rejected))
