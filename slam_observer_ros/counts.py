"""Names under which the estimator counts what it does not use, and what they add up to."""

from __future__ import annotations

from collections import Counter

UNUSED_POINTS = {
    'rejected_landmark': 'rejected',
    'unknown_id': 'without id',
    'repeated_id': 'of a repeated id',
    'reserved_id': 'of a reserved id',
    'unmapped_landmark': 'not mapped',
}
"""Names under which points are counted that were observed and are not used, and what they are."""


def used_points(counts: Counter[str]) -> int:
    """Return how many points were used, from :attr:`.Estimator.counts`."""
    return counts['observed_point'] - sum(counts[name] for name in UNUSED_POINTS)


MAX_REJECTED = 0.1
"""Share of the points beyond which they are more than a sensor's outliers."""


def point_share(counts: Counter[str], name: str) -> float:
    """Return the share of the points that ``name`` counts, from :attr:`.Estimator.counts`."""
    return counts[name] / max(counts['observed_point'], 1)
