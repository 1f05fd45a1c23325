"""Which mistakes of a set-up are named: recordings made wrongly on purpose, and as they are.

``python benchmark/studies/mistakes.py`` makes each mistake in the runs of MRCLAM 6, Starry Night
and simulated drives, and prints in how many of them it is named; then what is named in the runs as
they are, with outliers, and with noise that is stated wrongly. ``--map`` gives the surveyed map.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
import logging
import math
import sys
import time
from typing import Any

import _above  # noqa: F401 (finds the modules of the folder above)
import numpy as np
import outliers
import slips
from threadpoolctl import threadpool_limits
import worlds
from worlds import World

from slam_observer_ros.events import Event, ObservationEvent
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.runs.mistakes import Correction, mistakes, OPTICAL
from slam_observer_ros.settings.estimator_settings import Settings

MADE = {
    'points_in_optical_axes': Correction('', OPTICAL.T),
    'points_mirrored': Correction('', np.diag([1.0, -1.0, 1.0])),
    'points_backwards': Correction('', np.diag([-1.0, -1.0, 1.0])),
    'points_in_millimetres': Correction('', 1e3 * np.eye(3)),
    'tag_size': Correction('', 0.8 * np.eye(3)),
    'turning_in_degrees': Correction('', turn=math.degrees(1.0)),
    'speed_in_kmh': Correction('', drive=3.6),
    'turning_negated': Correction('', turn=-1.0),
    'driving_negated': Correction('', drive=-1.0),
    'no_turning': Correction('', turn=0.0),
}
"""What a recording is made wrong by."""

WRONG = {
    ' + '.join(kinds): kinds
    for kinds in (
        *((kind,) for kind in MADE),
        ('points_in_millimetres', 'points_in_optical_axes'),
        ('points_in_optical_axes', 'turning_in_degrees'),
        ('speed_in_kmh', 'turning_in_degrees'),
        ('speed_in_kmh', 'turning_negated'),
        ('tag_size', 'turning_negated'),
    )
}
"""Mistakes that are made, alone and together."""
DRIVES = 10
SURVEY_M = 0.01


def main() -> None:
    """Run everything and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--map', action='store_true', help='the robot is in the surveyed map')
    parser.add_argument('--only', default='', metavar='NAME', help='worlds whose name has NAME')
    args = parser.parse_args()
    names = [*(f'MRCLAM 6, robot {robot}' for robot in range(1, 6)), 'Starry Night']
    names += [f'drive {seed}' for seed in range(DRIVES)]
    names = [name for name in names if args.only in name]
    start_s = time.monotonic()
    with ProcessPoolExecutor(2) as pool:
        rows = list(pool.map(partial(judged, with_map=args.map), names))
    for name, kinds in WRONG.items():
        missed = [row[name] for row in rows if not set(kinds) <= set(row[name])]
        wrong = f', else {missed}' if missed else ''
        sys.stdout.write(f'{name:46} named in {len(rows) - len(missed)} of {len(rows)}{wrong}\n')
    for alarm in alarms(load(names[0])):
        named = [
            f'{name}: {", ".join(row[alarm])}'
            for name, row in zip(names, rows, strict=True)
            if row[alarm]
        ]
        sys.stdout.write(f'{alarm:46} {len(named)} false alarms of {len(rows)} {named}\n')
    sys.stdout.write(f'{time.monotonic() - start_s:.0f} s\n')


def load(name: str) -> World:
    """Return a world by its name, or one of the random drives."""
    if not name.startswith('drive'):
        return worlds.load(name)
    settings = worlds.simulated_settings('wheeled_bearing_range')
    return worlds.drive(worlds.WHEELED_LOOP, settings, int(name.split()[1]))


def judged(name: str, with_map: bool) -> dict[str, list[str]]:
    """Return the kinds that are named, for each mistake that is made, and for none."""
    threadpool_limits(1)
    logging.getLogger('slam_observer_ros').setLevel(logging.CRITICAL)
    world = load(name)
    known = surveyed(world) if with_map else None
    found: dict[str, list[str]] = {}
    for what, kinds in WRONG.items():
        wrong: list[Event] = list(world.events)
        for kind in kinds:
            wrong = list(MADE[kind].apply(wrong))
        found[what] = [each.kind for each in mistakes(world.settings, wrong, known)]
    for alarm, (settings, events) in alarms(world).items():
        found[alarm] = [each.kind for each in mistakes(settings, events, known)]
    return found


def alarms(world: World) -> dict[str, tuple[Settings, Sequence[Event]]]:
    """Return what is right, but not as stated."""
    settings = world.settings
    return {
        'as it is': (settings, world.events),
        '10 % outliers': (settings, outliers.with_outliers(world, seed=0).events),
        **{
            f'noise × {factor:.2g}': (with_noise(settings, factor), world.events)
            for factor in (3.0, 1.0 / 3.0)
        },
        'slips': (settings, slips.with_slips(world, seed=0).events),
        'carried': (settings, slips.carried(world, seed=0).events),
        'a third of the views': (settings, list(some(world.events, 3))),
    }


NOISE = ('angular_velocity_noise', 'linear_velocity_noise')


def with_noise(settings: Settings, factor: float) -> Settings:
    """Return settings that state the noise of the velocity so many times as large."""
    noise: dict[str, Any] = {name: getattr(settings, name) for name in NOISE}
    for name, values in noise.items():
        noise[name] = tuple(factor * value for value in values)
    return replace(settings, **noise)


def some(events: Sequence[Event], every: int) -> Iterator[Event]:
    """Yield the velocities and every so manieth observation."""
    count = 0
    for event in events:
        if isinstance(event, ObservationEvent):
            count += 1
            if count % every:
                continue
        yield event


def surveyed(world: World) -> LandmarkMap:
    """Return the map that a survey has made."""
    truth = world.landmarks
    covariances = np.tile(SURVEY_M**2 * np.eye(3), (len(truth.ids), 1, 1))
    return LandmarkMap(truth.ids, truth.world_points, covariances, np.zeros(len(truth.ids), int))


if __name__ == '__main__':
    main()
