"""What only a whole run shows: its inputs, where errors grew, and which noise is too small.

With true poses each axis of the motion is judged by itself; without, the time since landmarks were
last used shows whether motion or points are at fault.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
import math
from pathlib import Path
from typing import Any

import numpy as np

from slam_observer_ros.common.errors import significant
from slam_observer_ros.common.findings import explained, Finding, found, Level, SUSPICIOUS
from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND, to_ns, to_s
from slam_observer_ros.common.types import BoolArray, FloatArray
from slam_observer_ros.estimates import DELAY_NAME, Innovations, point_share, Reason
from slam_observer_ros.estimator.event_warnings import UNEXPECTED_POSES
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.recordings.event_builder import NO_TRANSFORM
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.recordings.topics import input_decoders, SelectedTopics
from slam_observer_ros.recordings.trajectory import interpolate
from slam_observer_ros.runs.health import (
    MAX_UNMAPPED,
    of_all_learnt,
    of_estimate,
    of_fit,
    of_left_out,
    of_map_without_ids,
    of_ranges,
    of_rejections,
    of_stamps,
    rule,
)
from slam_observer_ros.runs.metrics import TrajectoryErrors
from slam_observer_ros.runs.result import list_dropped, MALFORMED, Replay, Result
from slam_observer_ros.settings.node_settings import (
    InputSettings,
    ObserverNodeSettings,
    POSE_DIFFERENCES,
)


def judged(
    result: Result,
    recording: Recording,
    inputs: InputSettings,
    unused: Sequence[Finding],
    map_path: Path | None,
    look_for_mistakes: Callable[[bool], Sequence[Finding]],
) -> list[Finding]:
    """Return what is wrong; ``unused`` is of inputs of which nothing was used."""
    run, selected = result.run, result.selected
    findings = [*unused]
    if not run.estimator.is_localised and run.localised_ns is not None:
        end_s = run.seconds_until(run.localised_ns[1])
        findings.append(found('lost_pose', path=map_path, seconds=end_s))
    findings += of_recording(recording, selected, inputs, run)
    findings += _of_run(result)
    findings += of_timing(recording, selected)
    if result.instants:
        findings += of_errors(result)
    reasons = [*findings, *of_all_learnt(run.estimator)]
    is_suspicious = any(each.kind in SUSPICIOUS for each in reasons)
    of_mount_only = not run.estimator.counts['slip'] and not is_suspicious
    findings = [*look_for_mistakes(of_mount_only), *findings]
    return sorted(explained(findings), key=lambda finding: -finding.level)


def _of_run(result: Result) -> Iterator[Finding]:
    """Judge the estimate as /diagnostics does, and what only a whole run shows."""
    run = result.run
    estimator, counts = run.estimator, run.estimator.counts
    yield from of_rejections(counts)
    # What ranges are taken for comes first: where that is wrong, noise makes up for it.
    yield from of_ranges(run.range_power, estimator.settings.range_is_depth)
    yield from of_estimate(estimator)
    ambiguity, times_s = estimator.longest_ambiguity, dict[str, Any]()
    if ambiguity is not None:
        bounds_ns = {'start_s': ambiguity.since_ns, 'end_s': ambiguity.until_ns}
        times_s = {name: run.seconds_until(stamp_ns) for name, stamp_ns in bounds_ns.items()}
    for finding in of_map_without_ids(estimator, ambiguity):
        yield replace(finding, **(times_s if finding.kind == 'ambiguous_map' else {}))
    yield from of_fit(None if result.nis is None else math.sqrt(result.nis))
    # Whether a map that does not grow is the place's.
    share, settings = point_share(counts, 'unmapped_landmark'), estimator.settings
    is_other = share > MAX_UNMAPPED and run.in_known_map and settings.localization_mode != 'off'
    start = ', and did the robot start where it was said to' if settings.set_initial_pose else ''
    yield from rule(is_other, 'unmapped_points', percent=100.0 * share, start=start)
    # These were logged when they happened.
    yield from of_left_out(counts, Level.NOTE)
    for name in UNEXPECTED_POSES:
        yield from rule(counts[name] > 0, name, Level.NOTE)


PLACE_THE_SENSOR = (
    '--set sensor_pose=[X,Y,Z,ROLL,PITCH,YAW] places a sensor that is not on /tf, '
    '--base-frame names another frame of the robot'
)
"""What to do where /tf does not connect sensor and robot."""

MAX_CLOCK_OFFSET_S = ObserverNodeSettings.max_clock_offset

MAX_AHEAD_S = 0.05  # a message can be late, but not early
MAX_SILENCE = 0.1  # share of the time beyond which missing velocities are no mere pause
MAX_END_SILENCE = 1.0 / 3.0  # share of the time after which landmarks are not just out of view
FEWEST = 10  # messages that a topic of landmarks has at least if it can be said to have ended


def unused_messages(recording: Recording, selected: SelectedTopics) -> Counter[str]:
    """Count the messages that did not become events, by reason."""
    malformed = sum(recording.malformed[topic.name] for topic in selected.inputs)
    return recording.dropped + Counter({MALFORMED: malformed})


def of_use(
    recording: Recording, selected: SelectedTopics, inputs: InputSettings, run: Replay
) -> Iterator[Finding]:
    """Judge whether velocities and observations, and an Imu's angular ones, were of use."""
    counts = run.estimator.counts
    dropped = run.estimator.dropped + unused_messages(recording, selected)
    # In a loaded map there may be none as its pose was not found, which is refused by itself.
    is_lost = counts['observed_point'] > 0 and not run.estimator.is_localised
    if not (run.observations > 0 or is_lost):
        unused = Counter({'without a point that is used': counts['observation']}) + Counter(
            {f'points {reason.words}': counts[reason.value] for reason in Reason}
        )
        finding = found(
            'no_observation' if counts['velocity'] else 'nothing_used',
            dropped=list_dropped(unused + dropped),
        )
        is_unplaced, remedy = recording.dropped[NO_TRANSFORM] > 0, ''
        if clocks := next(of_clocks(recording, selected), None):
            remedy = f'{clocks.what}: {clocks.remedy}'
        elif is_unplaced or not unused + dropped:
            missing = recording.contents.missing_tags(selected, inputs.tag_frame_prefix)
            remedy = missing or (PLACE_THE_SENSOR if is_unplaced else '')
        yield replace(finding, remedy=remedy or finding.remedy)
    elif not counts['velocity']:
        yield found('no_velocity', dropped=list_dropped(dropped))
    if selected.imu is not None and not run.angular_velocities:
        yield found(
            'no_angular_velocity',
            topic=selected.imu.name,
            dropped=list_dropped(dropped),
            instead=selected.velocity.name,
        )


def of_recording(
    recording: Recording, selected: SelectedTopics, inputs: InputSettings, run: Replay
) -> Iterator[Finding]:
    """Judge what was read, to its end: damage, stamps, and an odometry's poses."""
    if run.estimator.jumps and run.estimator.settings.on_time_jump == 'reset':
        seconds = run.seconds_until(run.estimator.stamp_ns or 0)
        yield found('clock_jumped', seconds=seconds, count=run.estimator.jumps)
    if recording.loss and not recording.warning:
        yield found('damaged', path=recording.path, loss=recording.loss)
    yield from of_stamps(recording.unstamped)
    yield from of_publishers(recording, selected, inputs)
    if inputs.velocity_source == POSE_DIFFERENCES:
        return
    # Where the motion is, if an odometry's velocities are not how its poses move.
    poses, velocity = run.dead_reckoning.poses, selected.velocity
    stands_still = len(poses) > 1 and bool((poses == poses[0]).all())
    if stands_still and recording.contents.poses_move(velocity):
        yield found('zero_twist', topic=velocity.name)
    elif not stands_still:
        problem = recording.contents.twist_problem(velocity, selected.imu is None)
        if problem:
            yield found('wrong_twist', topic=velocity.name, problem=problem)


def of_publishers(
    recording: Recording, selected: SelectedTopics, inputs: InputSettings = InputSettings()
) -> Iterator[Finding]:
    """Say on which of the topics of velocities more than one publishes, by what is on them."""
    decoders = input_decoders(selected, replace(inputs, velocity_source='twist'))
    for topic in (selected.velocity, selected.imu):
        if topic is not None:
            signs = recording.contents.signs_of_rivals(topic, decoders[topic])
            if signs:
                yield found('several_publishers', count=2, names=signs, topic=topic.name)


def of_timing(recording: Recording, selected: SelectedTopics) -> Iterator[Finding]:
    """Say which inputs of a recording, read to its end, were silent or are of another clock."""
    names = [topic.name for topic in selected.inputs]
    known = recording.arrivals
    inputs = {name: known[name] for name in names if name in known and len(known[name])}
    if not inputs:
        return
    start_s, end_s = min(each.first_s for each in inputs.values()), recording.end_s
    duration_s = end_s - start_s
    velocity, landmarks = selected.velocity.name, selected.landmarks.name
    held = [('velocity', velocity, 'the pose was held, but for what landmarks say')]
    if selected.imu is not None:
        held.append(('angular velocity', selected.imu.name, f'the one of {velocity} was taken'))
    for input_name, topic, consequence in held:
        if topic not in inputs:
            continue
        silence_s = inputs[topic].silence_s(start_s, end_s)
        yield from rule(
            silence_s > MAX_SILENCE * duration_s,
            'silence',
            input=input_name,
            topic=topic,
            silence_s=silence_s,
            duration_s=duration_s,
            consequence=consequence,
        )
    if landmarks in inputs and len(inputs[landmarks]) >= FEWEST:
        last_s = inputs[landmarks].last_s
        silence_s = end_s - last_s
        if silence_s > MAX_END_SILENCE * duration_s:
            finding = found(
                'landmarks_end', topic=landmarks, silence_s=silence_s, duration_s=duration_s
            )
            yield replace(finding, start_s=last_s - start_s, end_s=duration_s)
    yield from of_clocks(recording, selected)


def of_clocks(recording: Recording, selected: SelectedTopics) -> Iterator[Finding]:
    """Say which inputs have stamps of the future, of 1970, or far from the velocity's."""
    read = recording.arrivals
    inputs = {t.name: read[t.name] for t in selected.inputs if len(read.get(t.name, ()))}
    of_1970 = [name for name, arrivals in inputs.items() if arrivals.counts_from_start]
    if 0 < len(of_1970) < len(inputs):  # else all are of a simulation
        yield found('stamps_of_1970', topics=' and '.join(of_1970))
        return
    names = list(inputs)
    for name in names:
        other, ahead_s = names[0], inputs[name].ahead_s
        if name == other:
            yield from rule(ahead_s > MAX_AHEAD_S, 'early_stamps', topic=name, ahead_s=ahead_s)
            continue
        behind_s = inputs[name].behind_s(inputs[other])
        is_off = min(ahead_s, -behind_s) > MAX_AHEAD_S or abs(behind_s) > MAX_CLOCK_OFFSET_S
        side, off_s = 'behind' if behind_s > 0.0 else 'ahead of', abs(behind_s)
        yield from rule(is_off, 'other_clock', topic=name, offset_s=off_s, side=side, other=other)


MAX_GROWTHS = 3
GROWTH_SHARE = 0.25  # part of the largest error that a growth must reach to be named
NOTABLE_GAP_S = 0.5  # time without a used landmark that is named where the error grew
MAX_ANEES = 1.5  # ANEES beyond which the noise that is stated does not fit
WINDOW_NS = 5 * NANOSECONDS_PER_SECOND  # of motions beside which the truth's noise is small

MIN_WINDOWS = 20

TOO_LITTLE = 1.5  # errors over what is stated, beyond which a noise figure is named
LONG_S = 1.0  # time without landmarks after which an innovation is mostly due to the motion
MIN_DEGREES = 60  # degrees of freedom of innovations whose mean says something


def of_errors(result: Result) -> Iterator[Finding]:
    """Judge where the error grew, and which noise explains less than what is seen."""
    if result.errors is not None:
        yield from _of_growth(result, result.errors)
    anees = result.anees or 0.0
    is_overconfident = anees > MAX_ANEES
    yield from rule(is_overconfident, 'overconfident_pose', factor=np.sqrt(anees), anees=anees)
    if result.errors is not None:
        yield from _of_axes(result)
    # Innovations after a time without landmarks, and the others
    innovations = result.innovations
    since_s = np.diff(to_s(innovations.update_stamps_ns), prepend=np.nan)
    of_points = _ratio(innovations, since_s <= LONG_S)
    of_motion = _ratio(innovations, since_s > LONG_S)
    ratios = significant(of_points, 2), significant(of_motion, 2)
    yield from rule(of_points > TOO_LITTLE, 'point_noise', ratio=ratios[0])
    # What points explain is part of all innovations.
    is_motion = of_motion > TOO_LITTLE * max(of_points, 1.0)
    yield from rule(is_motion, 'motion_noise', gap_s=LONG_S, ratio=ratios[1])


def growth_windows(seconds: FloatArray, errors_m: FloatArray) -> list[tuple[int, int]]:
    """Return rows (first, last) between which the error rose the most, without overlaps."""
    if len(seconds) < 2:
        return []
    window_s = max(10.0, (seconds[-1] - seconds[0]) / 40.0)
    ends = np.minimum(np.searchsorted(seconds, seconds + window_s), len(seconds) - 1)
    rises = errors_m[ends] - errors_m
    found: list[tuple[int, int]] = []
    for start in np.argsort(-rises).tolist():
        end = int(ends[start])
        if rises[start] < GROWTH_SHARE * errors_m.max() or len(found) == MAX_GROWTHS:
            break
        if all(end <= other_start or start >= other_end for other_start, other_end in found):
            found.append((start, end))
    # In each from the least error on to the largest one
    tops = [start + int(np.argmax(errors_m[start : end + 1])) for start, end in found]
    return [
        (start + int(np.argmin(errors_m[start : top + 1])), top)
        for (start, _), top in zip(found, tops, strict=True)
    ]


def _of_growth(result: Result, errors: TrajectoryErrors) -> Iterator[Finding]:
    stamps_ns, seen = errors.estimate.stamps_ns, result.innovations
    seconds, errors_m, is_used = result.seconds(stamps_ns), errors.distances_m, seen.weights > 0.0
    for start, end in growth_windows(seconds, errors_m):
        times_s: dict[str, Any] = {'start_s': float(seconds[start]), 'end_s': float(seconds[end])}
        bounds_m = {'before_m': errors_m[start], 'after_m': errors_m[end]}
        # What was seen, and how the robot moved, meanwhile
        poses, (first_ns, last_ns) = errors.truth.poses[start : end + 1], stamps_ns[[start, end]]
        during = (seen.stamps_ns >= first_ns) & (seen.stamps_ns <= last_ns)
        used, gated = (int(np.count_nonzero(during & is_so)) for is_so in (is_used, ~is_used))
        driven_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()
        turns = so3.log(poses[1:, :3, :3] @ poses[:-1, :3, :3].swapaxes(-1, -2))
        turned_deg = np.degrees(np.linalg.norm(turns, axis=1).sum())
        what = f'{used} observations of landmarks were used' if used else 'no landmark was used'
        circumstances = (
            f'{what}{_blind(result, *times_s.values())}{f", {gated} rejected" if gated else ""}, '
            f'while the robot drove {driven_m:.1f} m and turned by {turned_deg:.0f}°'
        )
        finding = found('error_growth', circumstances=circumstances, **bounds_m, **times_s)
        yield replace(finding, **times_s)


def _blind(result: Result, start_s: float, end_s: float) -> str:
    """Say how long nothing was used at a time, between two times; '' if that is usual."""
    if len(result.gaps_s):
        overlaps_s = np.ptp(np.clip(result.gaps_s, start_s, end_s), axis=1)
        first_s, last_s = result.gaps_s[int(np.argmax(overlaps_s))]
        if overlaps_s.max() >= 0.5 * (end_s - start_s):
            return f' (none for {last_s - first_s:.0f} s, from {first_s:.0f} to {last_s:.0f} s)'
    used_s = result.used_s[(result.used_s > start_s) & (result.used_s < end_s)]
    longest_s = float(np.diff(np.concatenate([[start_s], used_s, [end_s]])).max())
    return f' (none for up to {longest_s:.1f} s)' if longest_s >= NOTABLE_GAP_S else ''


def _of_axes(result: Result) -> Iterator[Finding]:
    """Judge the noise of each axis of the motion by the true motion.

    Motions are compared over windows, less what a constant scale and a bias explain.
    """
    reckoned, delay_ns = result.run.dead_reckoning, 0
    for part in result.calibration:
        if part.name == DELAY_NAME:
            delay_ns = to_ns(part.value)
    first_ns, last_ns = reckoned.stamps_ns[[0, -1]].tolist()
    edges_ns = np.arange(first_ns, last_ns, WINDOW_NS, dtype=np.int64)
    true, is_true = interpolate(result.truth.trajectory, edges_ns)
    measured, is_measured = interpolate(reckoned, edges_ns - delay_ns)
    both = is_true & is_measured
    usable = both[1:] & both[:-1]
    if np.count_nonzero(usable) < MIN_WINDOWS:
        return
    true, measured = ((se3.inverse(poses[:-1]) @ poses[1:])[usable] for poses in (true, measured))
    window_s, motions = to_s(WINDOW_NS), se3.log(true)
    errors = se3.log(se3.inverse(true) @ measured)
    s = result.settings
    density = np.array([*s.angular_velocity_noise, *s.linear_velocity_noise])
    scale = np.array([*s.angular_scale_noise, *s.linear_scale_noise])
    stated = density**2 * window_s + (scale * motions) ** 2 / window_s
    # A turn within a window moves its end sideways: half-way on average.
    way_squared = np.sum(motions[:, 3:] ** 2, axis=1, keepdims=True)
    stated[:, 3:] += way_squared / 3.0 * stated[:, :3].sum(axis=1, keepdims=True)
    for axis in (2, 3, 4) if s.two_d_mode else range(6):
        design = np.column_stack([motions[:, axis], np.ones(len(motions))])
        fit, *_ = np.linalg.lstsq(design, errors[:, axis], rcond=None)
        left, mean = errors[:, axis] - design @ fit, stated[:, axis].mean()
        ratio = math.sqrt(np.mean(left**2) / mean) if mean > 0.0 else 0.0
        turn_or_way, motion = ('angular', 'turns') if axis < 3 else ('linear', 'ways')
        words: dict[str, Any] = {'turn_or_way': turn_or_way, 'motion': motion}
        words |= {'ratio': significant(ratio, 2)}
        yield from rule(ratio > TOO_LITTLE, 'axis_noise', axis='xyz'[axis % 3], **words)


def _ratio(innovations: Innovations, is_chosen: BoolArray) -> float:
    """Return how large innovations are for what is stated; 1 where they are too few."""
    known = is_chosen & (innovations.degrees_of_freedom > 0)
    total = int(innovations.degrees_of_freedom[known].sum())
    if total < MIN_DEGREES:
        return 1.0
    return float(np.sqrt(np.nansum(innovations.nis[known]) / total))
