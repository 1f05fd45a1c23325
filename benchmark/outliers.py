"""Worse data: outliers or false points added to observations, points or ids taken from them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from odometry import Event
from worlds import World

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID

GROSS_SHARE = 0.05
GROSS_M = (0.5, 20.0)
SWAPPED_SHARE = 0.01
FALSE_SHARE = 0.05


def with_outliers(world: World, seed: int) -> World:
    """Displace 5 % of the points by 0.5–20 m in any direction, and swap 1 % of the ids.

    An id is swapped for another landmark's, which was seen before, as when two markers look alike.
    """
    rng = np.random.default_rng(seed)
    seen: set[int] = set()
    events: list[Event] = []
    for event in world.events:
        if isinstance(event, ObservationEvent):
            seen.update(event.ids.tolist())
            points = _displaced(event.points, world.settings.two_d_mode, rng)
            event = replace(event, points=points, ids=_swapped(event.ids, sorted(seen), rng))
        events.append(event)
    return replace(world, events=events)


def without_outliers(world: World, seed: int) -> World:
    """Leave out the very points that :func:`with_outliers` makes outliers of.

    No estimator can be expected to do better with outliers than without these points.
    """
    worse = with_outliers(world, seed)
    pairs = zip(world.events, worse.events, strict=True)
    return replace(world, events=[_untouched(event, other) for event, other in pairs])


def without_ids(world: World) -> World:
    """Take the ids away."""
    return replace(world, events=[_anonymous(event) for event in world.events])


def with_false_points(world: World, seed: int, share: float | None = None) -> World:
    """Take the ids away and add points where nothing is, as reflections make them.

    By default 5 % more. They are seen where some landmark was at another time of the run, so the
    sensor can see there.
    """
    rng, share = np.random.default_rng(seed), FALSE_SHARE if share is None else share
    anonymous = without_ids(world)
    elsewhere = [event for event in anonymous.events if isinstance(event, ObservationEvent)]
    events = [_joined(event, elsewhere, share, rng) for event in anonymous.events]
    return replace(anonymous, events=events)


def _displaced(points: FloatArray, planar: bool, rng: np.random.Generator) -> FloatArray:
    m = len(points)
    directions = rng.standard_normal((m, 3))
    if planar:
        directions[:, 2] = 0.0
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distances = np.where(rng.random(m) < GROSS_SHARE, rng.uniform(*GROSS_M, m), 0.0)
    moved: FloatArray = points + distances[:, None] * directions
    return moved


def _swapped(ids: IntArray, seen: list[int], rng: np.random.Generator) -> IntArray:
    ids = ids.copy()
    for i in np.flatnonzero(rng.random(len(ids)) < SWAPPED_SHARE):
        other = rng.choice(seen)
        ids[ids == other] = ids[i]  # no id may occur twice in one observation
        ids[i] = other
    return ids


def _untouched(event: Event, other: Event) -> Event:
    """Return what the two have in common."""
    if not isinstance(event, ObservationEvent) or not isinstance(other, ObservationEvent):
        return event
    return event.select((event.ids == other.ids) & (event.points == other.points).all(axis=1))


def _joined(
    event: Event, elsewhere: list[ObservationEvent], share: float, rng: np.random.Generator
) -> Event:
    """Return an observation with single points of others in it, now and then."""
    if not isinstance(event, ObservationEvent):
        return event
    parts = [event]
    for _ in range(rng.binomial(len(event.ids), share)):
        other = elsewhere[rng.integers(len(elsewhere))]
        parts.append(other.select(np.arange(len(other.ids)) == rng.integers(len(other.ids))))
    covariances = [part.covariances for part in parts if part.covariances is not None]
    return replace(
        event,
        ids=np.concatenate([part.ids for part in parts]),
        points=np.concatenate([part.points for part in parts]),
        covariances=np.concatenate(covariances) if covariances else None,
    )


def _anonymous(event: Event) -> Event:
    if not isinstance(event, ObservationEvent):
        return event
    return replace(event, ids=np.full_like(event.ids, UNKNOWN_ID))
