"""A robot that is switched on anywhere, or carried, in a map that it knows.

``python benchmark/studies/found_anywhere.py lost`` starts MRCLAM 6 at random times without ids, in
the surveyed map, and says when it is localised, and whether that is right. ``carried`` lets the
recording jump after a minute; ``tag`` starts in view of one tag at a time, with orientation.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
import logging
import sys
import time

import _above  # noqa: F401 (finds the modules of the folder above)
import numpy as np
from odometry import Event
import outliers
import tags
import worlds

from slam_observer_ros.common.process import use_one_thread
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.recordings.trajectory import interpolate

ROBOTS = 5
LIMIT_S = 240.0
AFTER_CARRY_S, BEFORE_CARRY_S, CARRIED_M = 140.0, 60.0, 2.0
RIGHT_M, RIGHT_RAD = 1.0, 0.5
SURVEY_SIGMA_M = 0.01
TAG_STARTS_S = (5.0, 25.0, 45.0)


def main() -> None:
    """Run the part that was asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('part', choices=('lost', 'carried', 'tag', 'alarms'))
    parser.add_argument('--runs', type=int, default=10, help='for each robot, or seeds')
    parser.add_argument('--false', type=float, default=0.0, help='share of false points')
    parser.add_argument('--mode', default='uncertain', help='localization_mode')
    args = parser.parse_args()
    use_one_thread()
    logging.getLogger('slam_observer_ros').setLevel(logging.CRITICAL)
    outliers.FALSE_SHARE = args.false
    parts = {'lost': lost, 'carried': carried, 'tag': tag, 'alarms': alarms}
    for line in parts[args.part](args):
        sys.stdout.write(line + '\n')
        sys.stdout.flush()


@dataclass(frozen=True, slots=True)
class Robot:
    """A robot of MRCLAM 6 without ids, and the map in which it is."""

    number: int
    world: worlds.World
    known: LandmarkMap

    @property
    def start_s(self) -> float:
        """When its recording begins."""
        return self.world.events[0].stamp_ns * 1e-9

    @property
    def duration_s(self) -> float:
        """How long its recording is."""
        return (self.world.events[-1].stamp_ns - self.world.events[0].stamp_ns) * 1e-9

    def pose(self, stamp_ns: int) -> FloatArray | None:
        """Return where it truly is (4, 4); None where that is not known."""
        poses, are_known = interpolate(self.world.truth, np.array([stamp_ns]))
        return poses[0] if are_known[0] else None

    def start(self, estimator: Estimator, stamp_ns: int) -> None:
        """Give an estimator the true pose at a time when that is known."""
        pose = self.pose(stamp_ns)
        if pose is None:
            raise ValueError('the true pose is not known then')
        estimator.set_pose(pose, np.diag([1e-4] * 3 + [1e-2] * 3))

    def is_right(self, estimator: Estimator, stamp_ns: int) -> bool:
        """Return whether the estimated pose is right, as it is said of an unknown one."""
        true = self.pose(stamp_ns)
        if true is None:
            return True
        off = se3.inverse(true) @ estimator.pose
        turn_rad = np.linalg.norm(so3.log(off[:3, :3]))
        return bool(np.linalg.norm(off[:3, 3]) < RIGHT_M and turn_rad < RIGHT_RAD)

    def estimator(self, mode: str) -> Estimator:
        """Return one that does not know where the robot is."""
        estimator = Estimator(replace(self.world.settings, localization_mode=mode))
        estimator.load_map(self.known)
        return estimator


def robots(false_share: float) -> Iterator[Robot]:
    """Return the robots of MRCLAM 6, each with its recording without ids."""
    for number in range(1, ROBOTS + 1):
        world = worlds.load(f'MRCLAM 6, robot {number}')
        survey = world.landmarks
        n = len(survey.ids)
        covariances = np.tile(np.diag([SURVEY_SIGMA_M**2] * 2 + [0.0]), (n, 1, 1))
        known = LandmarkMap(survey.ids, survey.world_points, covariances, np.zeros(n, dtype=int))
        if false_share:
            world = outliers.with_false_points(world, number)
        yield Robot(number, outliers.without_ids(world), known)


def lost(args: argparse.Namespace) -> Iterator[str]:
    """Start at random times; when is the robot found, and rightly so."""
    rng = np.random.default_rng(0)
    times_s, wrong, starts, cpu_s = [], 0, 0, 0.0
    for robot in robots(args.false):
        for start_s in rng.uniform(0.0, robot.duration_s - LIMIT_S - 30.0, args.runs):
            part = robot.world.part(float(start_s), float(start_s) + LIMIT_S)
            estimator, begin_s = robot.estimator(args.mode), time.process_time()
            starts += 1
            found_s = None
            for event in part.events:
                estimator.add(event)
                if isinstance(event, ObservationEvent) and estimator.is_localised:
                    found_s = (event.stamp_ns - part.events[0].stamp_ns) * 1e-9
                    times_s.append(found_s)
                    is_wrong = not robot.is_right(estimator, event.stamp_ns)
                    wrong += is_wrong
                    break
            cpu_s += time.process_time() - begin_s
            word = 'never' if found_s is None else f'{found_s:.0f} s' + ' WRONG' * is_wrong
            yield f'robot {robot.number} from {start_s:.0f} s: {word}'
    yield (
        f'found {len(times_s)} of {starts}, {wrong} wrong, after {np.median(times_s):.0f} s '
        f'(median), {np.percentile(times_s, 90):.0f} s (nine of ten), '
        f'{cpu_s / starts:.2f} s of CPU'
    )


def carried(args: argparse.Namespace) -> Iterator[str]:
    """Carry the robot after a minute; when is it noticed, and when is the pose right again."""
    rng = np.random.default_rng(5)
    noticed_s, recovered_s, wrong_s, count = [], [], [], 0
    for robot in robots(args.false):
        for _ in range(args.runs):
            before, after = _places(robot, rng)
            count += 1
            noticed, recovered, longest = _carry(robot, before, after, args.mode)
            noticed_s += [] if noticed is None else [noticed]
            recovered_s += [] if recovered is None else [recovered]
            wrong_s.append(longest)
            yield (
                f'robot {robot.number}, {before:.0f} s to {after:.0f} s: noticed {noticed}, '
                f'recovered {recovered}, wrong for {longest:.1f} s'
            )
    yield (
        f'{count} carries: {len(noticed_s)} noticed after {np.median(noticed_s):.1f} s (median), '
        f'{max(noticed_s):.1f} s (at most); {len(recovered_s)} recovered after '
        f'{np.median(recovered_s):.0f} s; wrong once found: {max(wrong_s):.1f} s at most'
    )


def _places(robot: Robot, rng: np.random.Generator) -> tuple[float, float]:
    """Return from when and to when the recording jumps, to a place some way off."""
    while True:
        before, after = rng.uniform(0.0, robot.duration_s - BEFORE_CARRY_S - AFTER_CARRY_S, 2)
        stamps_s = robot.start_s + np.array([before, before + BEFORE_CARRY_S, after])
        start, at, to = (robot.pose(round(stamp_s * 1e9)) for stamp_s in stamps_s)
        if start is None or at is None or to is None:
            continue
        if np.linalg.norm(at[:3, 3] - to[:3, 3]) > CARRIED_M:
            return float(before), float(after)


def _carry(
    robot: Robot, before: float, after: float, mode: str
) -> tuple[float | None, float | None, float]:
    """Return when it was noticed since landmarks were seen, when the pose was right for good.

    And for how long at most it was wrong after it had been found again, seconds each.
    """
    first = robot.world.part(before, before + BEFORE_CARRY_S).events
    second = robot.world.part(after, after + AFTER_CARRY_S).events
    shift_ns = first[-1].stamp_ns + 50_000_000 - second[0].stamp_ns
    estimator = robot.estimator(mode)
    robot.start(estimator, first[0].stamp_ns)
    for event in first:
        estimator.add(event)
    seen_s = noticed = recovered = wrong_since = None
    longest, lost_before = 0.0, estimator.counts['lost']
    for event in second:
        estimator.add(replace(event, stamp_ns=event.stamp_ns + shift_ns))
        if not isinstance(event, ObservationEvent) or not len(event.ids):
            continue
        now_s = (event.stamp_ns - second[0].stamp_ns) * 1e-9
        seen_s = now_s if seen_s is None else seen_s
        if noticed is None and estimator.counts['lost'] > lost_before:
            noticed = now_s - seen_s
        is_right = estimator.is_localised and robot.is_right(estimator, event.stamp_ns)
        recovered = (now_s if recovered is None else recovered) if is_right else None
        if estimator.is_localised and not is_right and noticed is not None:
            wrong_since = now_s if wrong_since is None else wrong_since
            longest = max(longest, now_s - wrong_since)
        else:
            wrong_since = None
    return noticed, recovered, longest


def alarms(args: argparse.Namespace) -> Iterator[str]:
    """Let robots that know where they are drive on; how often are they taken for lost."""
    count, hours = 0, 0.0
    for robot in robots(args.false):
        estimator = robot.estimator(args.mode)
        begin_ns = next(
            event.stamp_ns
            for event in robot.world.events
            if robot.pose(event.stamp_ns) is not None
        )
        robot.start(estimator, begin_ns)
        for event in robot.world.events:
            if event.stamp_ns >= begin_ns:
                estimator.add(event)
        hours += robot.duration_s / 3600.0
        count += estimator.counts['lost']
        yield f'robot {robot.number}: lost {estimator.counts["lost"]}'
    yield f'{count} false alarms in {hours:.1f} hours'


def tag(args: argparse.Namespace) -> Iterator[str]:
    """Start in view of one tag at a time; in how many sightings is the robot found."""
    for flipped_share in (0.0, 0.1, 0.3):
        sightings, errors_m, wrong = [], [], 0
        for seed in range(args.runs):
            case = tags.Case('', 0.05, flipped_share)
            world, events = tags.drive_past_tags(case, 1, seed)
            for start_s in TAG_STARTS_S:
                found = _by_tag(world, events, case, seed, start_s)
                sightings.append(np.inf if found is None else found[0])
                if found is not None:
                    errors_m.append(found[1])
                    wrong += found[2]
        yield (
            f'{flipped_share:.0%} flipped: {len(sightings)} starts, found at sighting '
            f'{np.median(sightings):.0f} (median), {np.percentile(sightings, 90):.0f} (nine of '
            f'ten), never {int(np.sum(np.isinf(sightings)))}; position error '
            f'{np.median(errors_m):.2f} m (median), {wrong} wrong ones 20 s later'
        )


def _by_tag(
    world: worlds.World, events: list[Event], case: tags.Case, seed: int, start_s: float
) -> tuple[int, float, bool] | None:
    """Return at which sighting it was found, how far off, and whether it was wrong 20 s later."""
    R, n = tags.tilted_tags(20, tags.orientation_rng(seed)), 20
    known = LandmarkMap(
        world.landmarks.ids,
        world.landmarks.world_points,
        np.tile(1e-4 * np.eye(3), (n, 1, 1)),
        np.zeros(n, dtype=int),
        orientations=R,
        orientation_sigmas=np.full(n, 0.02),
    )
    estimator = Estimator(replace(tags.settings_of(case, world), localization_mode='uncertain'))
    estimator.load_map(known)
    seen, found, end_ns = 0, None, 0
    for event in events:
        if event.stamp_ns < start_s * 1e9:
            continue
        estimator.add(event)
        if not isinstance(event, ObservationEvent) or not len(event.ids):
            continue
        seen += 1
        end_ns = end_ns or event.stamp_ns + round(20e9)
        off = se3.inverse(tags.true_pose(world, event.stamp_ns)) @ estimator.pose
        error_m = float(np.linalg.norm(off[:3, 3]))
        if estimator.is_localised and found is None:
            found = seen, error_m
        if event.stamp_ns > end_ns:
            break
    return None if found is None else (*found, error_m > RIGHT_M)


if __name__ == '__main__':
    main()
