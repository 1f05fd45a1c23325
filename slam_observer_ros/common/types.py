"""Arrays, and what never changes."""

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


class Immutable:
    """What never changes once it is made: copies of its owners share it."""

    def __deepcopy__(self, _memo: object) -> Immutable:
        """Return the thing itself."""
        return self
