"""Which points of an observation can be used, whatever the estimate is."""

from __future__ import annotations

from collections import Counter

import numpy as np

from slam_observer_ros.estimator.event_warnings import EventWarnings
from slam_observer_ros.events import flatten, is_automatic, ObservationEvent, UNKNOWN_ID
from slam_observer_ros.settings.estimator_settings import Settings


def usable_points(
    event: ObservationEvent,
    settings: Settings,
    needs_ids: bool,
    counts: Counter[str],
    warnings: EventWarnings,
) -> ObservationEvent:
    """Return an observation as the states use it; count its points, warn of those left out."""
    counts['observed_point'] += len(event.ids)
    event = flatten(event) if settings.two_d_mode else event
    reserved = is_automatic(event.ids)  # given here, to landmarks without an id
    if reserved.any():
        warnings.reserved_ids(event.ids[reserved].tolist())
        counts['reserved_id'] += int(np.sum(reserved))
        event = event.select(~reserved)
    if repeated_ids := event.repeated_ids():  # nobody knows which of the points is right
        warnings.repeated_ids(repeated_ids)
        repeated = np.isin(event.ids, repeated_ids)
        counts['repeated_id'] += int(np.sum(repeated))
        event = event.select(~repeated)
    if needs_ids and (unknown := event.ids == UNKNOWN_ID).any():
        warnings.unknown_ids(settings.gains)
        counts['unknown_id'] += int(np.sum(unknown))
        event = event.select(~unknown)
    return event
