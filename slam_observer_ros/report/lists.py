"""Arrays as JSON has them."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np

from slam_observer_ros.common.types import FloatArray

Json: TypeAlias = Any
"""What json.dumps takes without NaN."""


def rounded(values: FloatArray, digits: int) -> list[Any]:
    """Return nested lists, rounded, with None for what is not finite."""
    numbers = np.round(np.asarray(values, dtype=np.float64), digits)
    listed = numbers.astype(object)
    listed[~np.isfinite(numbers)] = None
    return list(listed.tolist())
