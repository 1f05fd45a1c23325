"""Which points of an observation can be used, whatever the estimate is."""

from __future__ import annotations

from collections import Counter

import numpy as np

from slam_observer_ros.event_warnings import EventWarnings
from slam_observer_ros.events import flatten, is_automatic, ObservationEvent, UNKNOWN_ID
from slam_observer_ros.settings import Settings


def usable_points(
    event: ObservationEvent, settings: Settings, counts: Counter[str], warnings: EventWarnings
) -> ObservationEvent:
    """Return an observation as the states use it; count its points and tell of those left out."""
    counts['observed_point'] += len(event.ids)
    event = flatten(event) if settings.two_d_mode else event
    event = _without_reserved(event, counts, warnings)
    event = _without_repeated(event, counts, warnings)
    if settings.gains != 'riccati' and (event.ids == UNKNOWN_ID).any():
        warnings.unknown_ids(settings.gains)
    return event


def _without_reserved(
    event: ObservationEvent, counts: Counter[str], warnings: EventWarnings
) -> ObservationEvent:
    """Leave out points with ids that are given here, to landmarks without one."""
    reserved = is_automatic(event.ids)
    if not reserved.any():
        return event
    counts['reserved_id'] += int(np.sum(reserved))
    warnings.reserved_ids(event.ids[reserved].tolist())
    return event.select(~reserved)


def _without_repeated(
    event: ObservationEvent, counts: Counter[str], warnings: EventWarnings
) -> ObservationEvent:
    """Leave out points with one id: nobody knows which of them is right."""
    repeated = event.repeated_ids()
    if not repeated:
        return event
    left = event.select(~np.isin(event.ids, repeated))
    counts['repeated_id'] += len(event.ids) - len(left.ids)
    warnings.repeated_ids(repeated)
    return left
