"""Which mistakes of a set-up are named: recordings made wrongly on purpose, and as they are.

``python benchmark/studies/mistakes.py`` makes each mistake in the runs of MRCLAM 6, Starry Night,
the sample and simulated drives, and says in how many of them it is named; then what is named in
the runs as they are, with outliers, slips, and with noise that is stated wrongly. ``--map`` gives
the surveyed map. Each recording is printed as it is judged; with ``--results FILE`` it is kept
there, and is not judged again: so parts (``--only``) that run by themselves make one table.
``--live`` gives the events to what a node looks with, as fast as they came, and says after how
much driving it names what, in the first two minutes of driving.
"""

from __future__ import annotations

import argparse
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import replace
import json
import logging
import math
from pathlib import Path
import sys
import time
from typing import Any, TypeAlias
from unittest.mock import Mock, patch

import _above  # noqa: F401 (finds the modules of the folder above)
import numpy as np
import outliers
import slips
from threadpoolctl import threadpool_limits
import worlds
from worlds import World

from slam_observer_ros.common.findings import explained
from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import Event, ObservationEvent, VelocityEvent
from slam_observer_ros.lie import so3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.recordings.trajectory import LandmarkTruth
from slam_observer_ros.runs.health import NoiseFit, of_all_learnt, of_node, Progress
from slam_observer_ros.runs.mistakes import ALIKE, Correction, Drive, mistakes, OPTICAL, Search
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
    'mount_off': Correction('', so3.exp(np.array([0.0, 0.0, math.radians(5.0)]))),
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
SAMPLE = 'sample.mcap'
DRIVES = 20
"""Simulated ones. Who works on thresholds looks at the first half of them alone."""

SURVEY_M = 0.01
LIVE_S = 120.0
"""Driving after which no more is looked for live."""

Key: TypeAlias = tuple[str, str]  # a world, and what is made of it


def main() -> None:
    """Judge what is not judged yet, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--map', action='store_true', help='the robot is in the surveyed map')
    parser.add_argument('--only', default='', metavar='NAME', help='worlds whose name has NAME')
    parser.add_argument('--results', type=Path, metavar='FILE', help='where to keep each row')
    parser.add_argument('--live', action='store_true', help='look as a node does')
    parser.add_argument('--table', action='store_true', help='judge nothing: only print')
    args = parser.parse_args()
    threadpool_limits(1)
    logging.getLogger('slam_observer_ros').setLevel(logging.CRITICAL)
    found: dict[Key, list[str]] = {}
    seconds: dict[Key, float] = {}

    def note(row: Mapping[str, Any]) -> None:
        if row['map'] == args.map:
            key = (row['world'], row['made'])
            found[key], seconds[key] = row['named'], row['seconds']

    if args.results is not None and args.results.exists():
        for line in args.results.read_text().splitlines():
            note(json.loads(line))
    names = [*(f'MRCLAM 6, robot {robot}' for robot in range(1, 6)), 'Starry Night', SAMPLE]
    names += [f'drive {seed}' for seed in range(DRIVES)]
    for name in [] if args.table else [name for name in names if args.only in name]:
        world = load(name)
        known = surveyed(world) if args.map else None
        for made, (settings, events) in recordings(world).items():
            if (name, made) in found:
                continue
            if args.live:
                named, taken_s = named_live(settings, events, known)
            else:
                start_s = time.process_time()
                named = [each.kind for each in mistakes(settings, events, known)]
                taken_s = time.process_time() - start_s
            row = {'world': name, 'map': args.map, 'made': made, 'named': named}
            row['seconds'] = round(taken_s, 2)
            note(row)
            if args.results is not None:
                with args.results.open('a') as file:
                    file.write(json.dumps(row) + '\n')
            sys.stdout.write(f'{name:20} {made:46} {taken_s:5.1f} s: {", ".join(named) or "-"}\n')
            sys.stdout.flush()
    print_table(found, seconds, 's of driving' if args.live else 's of CPU')


def named_live(
    settings: Settings, events: Iterable[Event], known: LandmarkMap | None
) -> tuple[list[str], float]:
    """Return what a node names first, and after how much driving, in seconds."""
    from slam_observer_ros.nodes import diagnostics  # which needs ROS

    noise, drive, node = NoiseFit(), Drive(), Mock()
    estimator = Estimator(settings, on_update=noise.add, judges_innovations=True)
    if known is not None:
        estimator.load_map(known)
    lately: deque[Counter[str]] = deque(maxlen=diagnostics.RECENT)
    before: Counter[str] = Counter()
    with patch.object(diagnostics, 'time') as clock:
        clock.monotonic.return_value = now_s = 0.0
        watch = diagnostics.MistakeWatch(node, estimator, Search)
        advance, timer = node.create_steady_timer.call_args.args[1], node.create_steady_timer()
        first_ns = None
        for event in events:
            first_ns = event.stamp_ns if first_ns is None else first_ns
            while now_s < to_s(event.stamp_ns - first_ns):
                last_s, now_s = now_s, now_s + diagnostics.PERIOD_S
                clock.monotonic.return_value = now_s
                if timer.reset.call_count >= timer.cancel.call_count:  # as it begins cancelled
                    advance()
                if int(now_s) == int(last_s):
                    continue
                new = estimator.counts - before
                before = estimator.counts.copy()
                lately.append(new)
                counted = sum(lately, Counter[str]())
                progress = Progress(Counter(), new, Counter(), counted, False, has_seen=True)
                symptoms = explained([*of_node(estimator, [], progress), *noise.findings])
                watch.look([*symptoms, *of_all_learnt(estimator)], has_slipped=new['slip'] > 0)
            if watch.findings or drive.driven_s > LIVE_S:
                break
            watch.note(event)
            estimator.add(event)
            drive.add(event)
    return [each.kind for each in watch.findings], drive.driven_s


def print_table(
    found: Mapping[Key, Sequence[str]], seconds: Mapping[Key, float], unit: str
) -> None:
    """Print how often each mistake is named, with none beside it that was not made."""
    for made in dict.fromkeys(made for _, made in found):
        named = {world: set(kinds) for (world, what), kinds in found.items() if what == made}
        taken_s = [value for (_, what), value in seconds.items() if what == made]
        longest = f'{np.median(taken_s):4.1f} {unit}, at most {max(taken_s):4.1f}'
        wrong = {
            world: ' + '.join(sorted(kinds)) or 'nothing'
            for world, kinds in named.items()
            if not is_right(kinds, WRONG.get(made, ()))
        }
        right = f'right in {len(named) - len(wrong)} of {len(named)}'
        others = ''.join(f'\n    {world}: {kinds}' for world, kinds in wrong.items())
        sys.stdout.write(f'{made:46} {right}, {longest}{others}\n')


def is_right(named: Set[str], kinds: Sequence[str]) -> bool:
    """Return whether just what was made is named, or a mirror image of it, too."""
    alike = set(kinds).union(*(pair for pair in ALIKE if pair & set(kinds)))
    return set(kinds) <= named <= alike


def recordings(world: World) -> dict[str, tuple[Settings, Iterable[Event]]]:
    """Return a recording with each mistake, and those that are right."""
    made: dict[str, tuple[Settings, Iterable[Event]]] = {}
    for what, kinds in WRONG.items():
        wrong: Iterable[Event] = world.events
        for kind in kinds:
            wrong = MADE[kind].apply(wrong)
        made[what] = with_open_mount(world) if 'mount_off' in kinds else world.settings, wrong
    return made | alarms(world)


def load(name: str) -> World:
    """Return a world by its name, the sample, or one of the random drives."""
    if name == SAMPLE:
        settings = replace(Settings(), reorder_window=0.0)
        with Recording(worlds.CHECKOUT / 'samples' / name) as recording:
            selected = recording.find_topics()
            used = (VelocityEvent, ObservationEvent)
            events = [each for each in recording.events(selected) if isinstance(each, used)]
            truth = recording.truth(selected)
        landmarks = truth.landmarks or LandmarkTruth(np.empty(0, dtype=int), np.empty((0, 3)))
        return World(settings, events, truth.trajectory, landmarks)
    if not name.startswith('drive'):
        return worlds.load(name)
    settings = worlds.simulated_settings('wheeled_bearing_range')
    return worlds.drive(worlds.WHEELED_LOOP, settings, int(name.split()[1]))


def alarms(world: World) -> dict[str, tuple[Settings, Iterable[Event]]]:
    """Return what is right, but not as stated."""
    settings = world.settings
    return {
        'as it is': (settings, world.events),
        'as it is, its mount open': (with_open_mount(world), world.events),
        '10 % outliers': (settings, outliers.with_outliers(world, seed=0).events),
        **{
            f'noise × {factor:.2g}': (with_noise(settings, factor), world.events)
            for factor in (3.0, 1.0 / 3.0)
        },
        'slips': (settings, slips.with_slips(world, seed=0).events),
        'carried': (settings, slips.carried(world, seed=0).events),
        'a third of the views': (settings, some(world.events, 3)),
    }


def with_open_mount(world: World) -> Settings:
    """Return settings that leave open how a sensor is turned, which is estimated else."""
    return replace(world.settings, sensor_rotation_stddev=(0.0, 0.0, 0.0))


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
