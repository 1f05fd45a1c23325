"""Units that time is kept in."""

from __future__ import annotations

NANOSECONDS_PER_SECOND = 1_000_000_000
