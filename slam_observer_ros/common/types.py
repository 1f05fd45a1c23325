"""Arrays."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
"""Array of float64; each docstring states shape, unit and frame."""

IntArray: TypeAlias = NDArray[np.int64]
"""Array of int64: landmark ids, indices, stamps in nanoseconds."""

BoolArray: TypeAlias = NDArray[np.bool_]
"""Array of bool: masks over landmarks."""
