"""Numbers as people read them, and as JSON has them."""

from __future__ import annotations

from collections.abc import Mapping
import json
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


def json_text(value: object, *, is_compact: bool = False) -> str:
    """Return a value as JSON on one line: null for what is not finite, which JSON can't say."""
    separators = (',', ':') if is_compact else None
    return json.dumps(_finite(value), allow_nan=False, separators=separators)


def _finite(value: object) -> object:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {name: _finite(entry) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(entry) for entry in value]
    return value
