"""Numbers as people read them."""

from __future__ import annotations

import math

_LEAST = 1e-4
"""Numbers below this have more zeros than anybody counts."""


def significant(value: float, digits: int = 3) -> str:
    """Return a number with so many significant digits, and all digits before the point."""
    if value == 0.0 or not math.isfinite(value):
        return f'{value:g}'
    if abs(value) < _LEAST:
        return f'{value:.{digits - 1}e}'
    decimals = digits - 1 - math.floor(math.log10(abs(value)))
    return f'{value:.{max(decimals, 0)}f}'
