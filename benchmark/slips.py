"""Robots that are not where odometry has them: wheels slip, or someone carries the robot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from odometry import Event
from worlds import World

from slam_observer_ros.common.types import BoolArray, FloatArray
from slam_observer_ros.events import VelocityEvent

PERIOD_S = 60.0
"""Mean time between two mishaps: the simulated loop has 6."""

SLIP_S = (1.0, 2.0)
SLIP_TURN_RAD = (0.3, 0.8)
SLIP_M = (0.5, 1.0)

UNSEEN_S = 4.0
"""Time from the beginning of a slip in which nothing is seen, if it is in the dark."""

CARRIED_S = (2.0, 6.0)
"""Time until a robot that was lifted drives on: its course is 1 to 3 m longer by then."""

TURNING_S = 1.5
"""Time, the last of that, in which it turns back to where it was heading."""


def with_slips(world: World, seed: int, unseen_s: float = 0.0) -> World:
    """Let wheels spin once a minute, for 1 to 2 s: half of the times on one side, else all.

    Odometry then reports a turn of 0.3 to 0.8 rad, either way, or of 0.5 to 1 m of way, that the
    robot has not made. Nothing is seen in the first ``unseen_s`` of it.
    """
    rng = np.random.default_rng(seed)
    extra, unseen = np.zeros((len(world.events), 6)), np.zeros(len(world.events), dtype=bool)
    for start_s in _starts_s(world, rng):
        duration_s = rng.uniform(*SLIP_S)
        extra[_within(world, start_s, start_s + duration_s)] = _slip(rng) / duration_s
        unseen |= _within(world, start_s, start_s + unseen_s)
    events: list[Event] = []
    for event, body_velocity, is_unseen in zip(world.events, extra, unseen, strict=True):
        if isinstance(event, VelocityEvent):
            events.append(replace(event, body_velocity=event.body_velocity + body_velocity))
        elif not is_unseen:
            events.append(event)
    return replace(world, events=events)


def carried(world: World, seed: int) -> World:
    """Let someone lift the robot once a minute and carry it along its course, for 1 to 3 m.

    Its wheels stand still until it is put down, turned by any angle; then it turns back on the
    spot, which odometry reports. It sees nothing in all that time.
    """
    rng = np.random.default_rng(seed)
    lifted = np.zeros(len(world.events), dtype=bool)
    reported = np.zeros((len(world.events), 6))
    for start_s in _starts_s(world, rng):
        end_s = start_s + rng.uniform(*CARRIED_S)
        lifted |= _within(world, start_s, end_s)
        turning = _within(world, end_s - TURNING_S, end_s)
        reported[turning, 2] = rng.uniform(-np.pi, np.pi) / TURNING_S
    events: list[Event] = []
    for event, body_velocity, is_lifted in zip(world.events, reported, lifted, strict=True):
        if not is_lifted:
            events.append(event)
        elif isinstance(event, VelocityEvent):
            events.append(replace(event, body_velocity=body_velocity))
    return replace(world, events=events)


def _slip(rng: np.random.Generator) -> FloatArray:
    """Return the motion (6,) that odometry reports and the robot has not made."""
    motion = np.zeros(6)
    if rng.random() < 0.5:
        motion[2] = rng.choice([-1.0, 1.0]) * rng.uniform(*SLIP_TURN_RAD)
    else:
        motion[3] = rng.uniform(*SLIP_M)
    return motion


def _starts_s(world: World, rng: np.random.Generator) -> FloatArray:
    """Return when mishaps begin, seconds since the start: one in each whole period."""
    periods = int(round(_seconds(world)[-1], 3) // PERIOD_S)
    return (np.arange(periods) + rng.uniform(0.25, 0.85, periods)) * PERIOD_S


def _within(world: World, from_s: float, to_s: float) -> BoolArray:
    """Return which events are between two times since the start of the run."""
    seconds = _seconds(world)
    return (seconds >= from_s) & (seconds < to_s)


def _seconds(world: World) -> FloatArray:
    stamps_ns = np.array([event.stamp_ns for event in world.events])
    seconds: FloatArray = (stamps_ns - stamps_ns[0]) * 1e-9
    return seconds
