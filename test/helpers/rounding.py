"""How far numbers are from a reference's, by the size of these."""

from __future__ import annotations

import numpy as np


def off_by(value, expected, least):
    """Return the largest difference, over the largest number expected or ``least``."""
    size = max(float(np.abs(expected).max(initial=0.0)), least)
    return float(np.abs(value - expected).max(initial=0.0)) / size
