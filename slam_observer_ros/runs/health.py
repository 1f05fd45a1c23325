"""The judge of health: what is wrong with an estimate, live and in a replay alike.

What it finds are data (``common/findings.py``), which table, JSON, report, log and /diagnostics
show. ``run_health.py`` judges what only a whole run shows.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
import math
from typing import Any

from slam_observer_ros.common.findings import Finding, found, in_brief, Level, worst_first
from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import is_automatic
from slam_observer_ros.estimates import (
    Ambiguity,
    CalibrationEstimate,
    DELAY_NAME,
    most_frequent,
    MotionFactor,
    point_share,
    RangePower,
    Reason,
)
from slam_observer_ros.estimator.estimate import Estimate
from slam_observer_ros.lie.matrices import MAX_DEVIATION
from slam_observer_ros.messages.outgoing import OutgoingMessages

MAX_REJECTED = 0.1
"""Share of the points beyond which they are more than a sensor's outliers."""

MAX_REJECTED_ORIENTATIONS = 0.5
"""Share of the points beyond which they are more than the flips of small or frontal tags."""

MAX_UNMAPPED = 0.5
"""Share of the points beyond which they are more than what a map has not got yet."""

MAX_VAGUE = 0.5
"""Share of the points, stated to be anywhere, beyond which they are what the sensor states."""

LEFT_OUT = (
    Reason.REJECTED,
    Reason.NO_ID,
    Reason.REPEATED_ID,
    Reason.RESERVED_ID,
    Reason.IMPOSSIBLE_ID,
    Reason.SURPLUS,
    Reason.BAD,
)
"""Points not used for something that is wrong, as one that a known map has not may be right."""

WRONG_IDS = (Reason.REPEATED_ID, Reason.RESERVED_ID, Reason.IMPOSSIBLE_ID)
"""Of those, what a sensor should never give: one is enough to say so."""

NOTABLE_DELAY_S, CERTAIN = 0.1, 3.0
"""Least delay of velocities that is worth a finding, and by how many of its deviations."""

SHOWN, SURE = 0.25, 4.0
"""Power of the cosine in ranges, beyond the power of what they are taken for, that is worth a
finding, and by how many of its deviations."""

HARDLY_ANY = 0.25
"""Landmarks in a map, over those seen too seldom for it, below which there is hardly a map."""

IMPLAUSIBLE = 4.0
"""Stated standard deviations by which no calibration is off: something else is wrong."""

NOTABLY_NOISIER = 1.5
"""Factor of the noise of the odometry from which it is named as a problem."""

NOTABLY_WRONG, TOO_WRONG = math.sqrt(1.5), 2.0
"""Factors of the stated noise: what is worth a note, and what neither chance nor a sensor's usual
correlation explains."""

NOISELESS = 0.01
"""Share of the stated noise below which there is none at all."""

MOUNTED = {
    'sensor_rotation': (
        ('further rolled to the right/further rolled to the left', 'roll'),
        ('further down/further up', 'pitch'),
        ('further to the left/further to the right', 'yaw'),
    ),
    'sensor_translation': (
        ('further forward/further back', 'x'),
        ('further to the left/further to the right', 'y'),
        ('higher/lower', 'z'),
    ),
}
"""In words, by axis, how a sensor is mounted whose turn or shift is positive/negative."""


def estimator_values(
    estimator: Estimate, dropped: Counter[str], findings: Iterable[Finding]
) -> dict[str, str]:
    """Return what was used and dropped and why, map, calibration and noise, and what to do."""
    update = estimator.last_update
    values = {f'used: {kind}': str(count) for kind, count in sorted(estimator.counts.items())}
    values |= {f'dropped: {reason}': str(count) for reason, count in sorted(dropped.items())}
    if (most := most_frequent(estimator.counts)) is not None:
        count = estimator.counts[most.value]
        values['most points not used'] = f'{count} {most.words}: {most.remedy}'
    values['landmarks known'] = str(len(estimator.landmark_ids))
    values['known landmarks seen last'] = str(0 if update is None else len(update.ids))
    values |= {f'calibration: {part.name}': str(part) for part in estimator.calibration}
    values |= {f'noise of {part.name}': str(part) for part in estimator.motion_factors}
    values |= {f'to do: {each.what}': each.remedy for each in findings}
    values['Lyapunov value'] = f'{estimator.lyapunov:.3e}'
    return values


def of_velocity(estimator: Estimate) -> list[Finding]:
    """Judge whether velocities still come."""
    stale = estimator.stamp_ns is not None and estimator.velocity_is_stale
    return [found('stale_velocity')] if stale else []


def of_estimate(estimator: Estimate) -> list[Finding]:
    """Judge what is estimated of velocities and sensors, live and after a whole run alike."""
    calibration, factors = estimator.undisturbed
    of_odometry = [*of_calibration(calibration), *of_noise(factors)]
    if of_odometry and estimator.has_rare_velocities:
        of_odometry.append(found('rare_velocity', period_s=estimator.velocity_period_s))
    half_points = of_half_points(estimator.anchor_biases, estimator.open_sides)
    return [*of_odometry, *of_mounting(calibration), *half_points]


def of_all_learnt(estimator: Estimate) -> list[Finding]:
    """Judge the same, be it explained by a slip or the like: a mistake may explain both."""
    calibration = estimator.calibration
    of_noise_learnt = of_noise(estimator.motion_factors)
    return [*of_calibration(calibration), *of_mounting(calibration), *of_noise_learnt]


def of_half_points(biases: Mapping[int, float], open_sides: Sequence[int]) -> list[Finding]:
    """Name landmarks whose ranges are off everywhere, and those that fit on two sides."""
    biased = [
        found(
            'anchor_biased',
            anchor=anchor,
            off_m=abs(off_m),
            towards='short' if off_m < 0 else 'long',
        )
        for anchor, off_m in sorted(biases.items())
    ]
    if not open_sides:
        return biased
    ids = ', '.join(str(landmark_id) for landmark_id in open_sides)
    return [*biased, found('side_undecided', ids=ids)]


def of_map_without_ids(estimator: Estimate, ambiguity: Ambiguity | None) -> list[Finding]:
    """Judge whether what was seen without ids makes one map, and makes one at all."""
    findings, known, waiting = [], len(estimator.landmark_ids), estimator.waiting_landmarks
    if ambiguity is not None:
        x, y, _ = ambiguity.position
        lasts_s, probability = to_s(ambiguity.lasts_ns), ambiguity.probability
        findings.append(found('ambiguous_map', lasts_s=lasts_s, x=x, y=y, probability=probability))
    # After twice as many observations as one landmark takes.
    is_begun = estimator.counts['observation'] >= 2 * estimator.settings.confirmations
    if is_begun and known < HARDLY_ANY * waiting:
        findings.append(found('unconfirmed_map', waiting=waiting, known=known))
    return findings


def of_calibration(calibration: Iterable[CalibrationEstimate]) -> list[Finding]:
    """Judge what was found out of the velocity: a delay first, as scales make up for it."""
    parts = list(calibration)
    for part in parts:
        notable_s = max(NOTABLE_DELAY_S, CERTAIN * part.deviation)
        if part.name == DELAY_NAME and abs(part.value - part.nominal) > notable_s:
            when = 'late' if part.value > 0.0 else 'early'
            return [found('late_odometry', delay_s=abs(part.value), when=when, set_to=part.value)]
    findings = []
    for part in parts:
        factor, unit = part.for_people
        times = abs(part.value - part.nominal) / part.stated
        if times > IMPLAUSIBLE:
            finding = found(
                'implausible_calibration',
                name=part.name,
                value=factor * part.value,
                times=times,
                stated=factor * part.stated,
                nominal=f'{factor * part.nominal:g} {unit}'.rstrip(),
            )
            findings.append(finding)
    return findings


def of_mounting(calibration: Iterable[CalibrationEstimate]) -> list[Finding]:
    """Say what to set so that sensors are stated as they were found to be.

    A property is found where it is three standard deviations off, and those have become a third.
    """
    findings = []
    for part in calibration:
        name, _, frame = part.name.partition('/')
        mounted, _, axis = name.rpartition('_')
        off, sensor = part.value - part.nominal, frame or 'the sensor'
        if abs(off) < 3.0 * part.deviation or 3.0 * part.deviation > part.stated:
            continue
        if name == 'range_scale':
            findings.append(found(name, sensor=sensor, found=part, value=part.value))
        elif mounted in MOUNTED:
            factor, unit = part.for_people
            words, entry = MOUNTED[mounted]['xyz'.index(axis)]
            finding = found(
                'mounting',
                sensor=sensor,
                off=f'{abs(factor * off):.2g} ± {factor * part.deviation:.2g} {unit}',
                towards=words.split('/')[int(off < 0.0)],
                amount=off,
                entry=entry,
            )
            findings.append(finding)
    return findings


def of_ranges(power: RangePower | None, is_depth: bool) -> list[Finding]:
    """Judge whether ranges are what they are taken for, ranges or depths along the axis.

    What is estimated follows what they are taken for, so that only a part of the power is seen.
    """
    if power is None:
        return []
    # How far towards the other of the two.
    off = 1.0 - power.value if is_depth else power.value
    if off < max(SHOWN, SURE * power.deviation):
        return []
    looks, set_to = ('range, not depth', 'false') if is_depth else ('depth along the axis', 'true')
    return [
        found(
            'depth_for_range',
            looks=looks,
            power=power.value,
            deviation=power.deviation,
            set_to=set_to,
        )
    ]


def of_noise(factors: Iterable[MotionFactor]) -> list[Finding]:
    """Judge how noisy the odometry is: say what to state if it clearly is more than stated."""
    return [
        found(
            'noisy_odometry',
            factor=part.factor,
            motion=part.name,
            proposed=f'set {part.proposed}' if part.proposed else 'state more',
        )
        for part in factors
        if part.factor >= NOTABLY_NOISIER and math.log(part.factor) > IMPLAUSIBLE * part.deviation
    ]


def of_fit(factor: float | None) -> list[Finding]:
    """Judge how many times as large as stated innovations are; None if that is not known.

    Next to nothing have sensors without any noise, as a simulation's may be.
    """
    if factor is None or factor < NOISELESS:
        return []
    if factor > NOTABLY_WRONG:
        level = Level.WARNING if factor > TOO_WRONG else Level.NOTE
        return [replace(found('small_noise', factor=factor), level=level)]
    return [found('large_noise', factor=1.0 / factor)] if factor < 1.0 / TOO_WRONG else []


def of_rejections(counts: Counter[str], when: str = '') -> list[Finding]:
    """Judge whether more points or orientations were rejected than are outliers, or say little."""
    points, orientations = (
        point_share(counts, f'rejected_{what}') for what in ('landmark', 'orientation')
    )
    found_so = []
    if points > MAX_REJECTED:
        found_so.append(found('rejected_points', percent=100.0 * points, when=when))
    if orientations > MAX_REJECTED_ORIENTATIONS:
        found_so.append(found('rejected_orientations', percent=100.0 * orientations, when=when))
    if point_share(counts, 'vague_point') > MAX_VAGUE:
        count = counts['vague_point']
        found_so.append(found('vague_point', count=count, limit_m=MAX_DEVIATION))
    return found_so


def of_left_out(counts: Counter[str], level: Level) -> list[Finding]:
    """Report points that were left out: most of them, or for their ids."""
    left_out = {reason: counts[reason.value] for reason in LEFT_OUT if counts[reason.value]}
    of_wrong_ids = any(reason in left_out for reason in WRONG_IDS)
    most = most_frequent(counts, WRONG_IDS if of_wrong_ids else LEFT_OUT)
    is_much = of_wrong_ids or 2 * sum(left_out.values()) > counts['observed_point']
    if most is None or not is_much:
        return []
    reasons = ', '.join(f'{count} {reason.words}' for reason, count in left_out.items())
    finding = found(
        'left_out_points', count=counts['observed_point'], reasons=reasons, remedy=most.remedy
    )
    return [replace(finding, level=level)]


def of_stamps(unstamped: Counter[str]) -> list[Finding]:
    """Report topics whose messages, so many of each, came without a stamp."""
    if not unstamped:
        return []
    return [found('zero_stamps', topics=', '.join(unstamped), count=unstamped.total())]


def of_map(counts: Counter[str], *, is_start_given: bool) -> Iterator[Finding]:
    """Judge whether a map that does not grow is the place's."""
    share = point_share(counts, 'unmapped_landmark')
    if share > MAX_UNMAPPED:
        start = ', and did the robot start where it was said to' if is_start_given else ''
        yield found('unmapped_points', percent=100.0 * share, start=start)


SILENT_S = 2.0
"""An input without messages for this long is a warning."""

MIN_POINTS = 50
"""Points that it takes to say how large a share of them is rejected."""

MANY_EMPTY = 200
"""Messages without a landmark, that are no detector that waits for one."""

MANY_UNUSED = 20
"""Messages, none of which was used, that are no transient of the start."""

USED_AS = {'twist': 'velocity', 'landmarks': 'observation'}
"""Inputs, and what their messages are counted as when they are used."""


@dataclass(frozen=True, slots=True)
class InputNumbers:
    """What a node knows of one of its inputs."""

    name: str
    topic: str
    received: int
    silent_s: float
    problem: str  # why no message comes
    doubt: Finding | None  # of publishers and content
    unread: Finding | None  # what was wrong with those that were malformed since the last time


@dataclass(frozen=True, slots=True)
class Progress:
    """What was counted since a node was judged last: in all, and of points lately."""

    dropped: Counter[str]
    counts: Counter[str]
    unstamped: Counter[str]
    lately: Counter[str]
    is_paused: bool
    has_seen: bool  # any landmark, ever


def of_node(
    estimator: Estimate, inputs: Sequence[InputNumbers], progress: Progress
) -> list[Finding]:
    """Judge where the robot is, what came, and what is estimated."""
    findings = _of_place(estimator)
    if progress.dropped and not progress.is_paused:
        # What came while the node was paused or inactive was not to be used.
        findings += [
            found('unused_input', count=each.received, topic=each.topic)
            for each in inputs
            if each.name in USED_AS
            and each.received >= MANY_UNUSED
            and not estimator.counts[USED_AS[each.name]]
        ]
    findings += [
        found('silent_input', topic=each.topic)
        for each in inputs
        if not each.problem and each.silent_s > SILENT_S
    ]
    if progress.is_paused:
        findings.append(found('paused'))
    elif total := progress.dropped.total():
        (reason, _), *others = progress.dropped.most_common()
        count = f'{total} message{"s" * (total != 1)}'
        reasons = f'mostly {reason}' if others else reason
        findings.append(found('dropped_messages', count=count, reasons=reasons))
    said = [*(each.unread for each in inputs), *(each.doubt for each in inputs)]
    findings += [finding for finding in said if finding is not None]
    findings += of_stamps(progress.unstamped)
    if not progress.has_seen and (observations := estimator.counts['observation']) >= MANY_EMPTY:
        findings.append(found('empty_messages', count=observations))
    findings += estimator.ids_at_two_places
    findings += of_left_out(progress.counts, Level.WARNING)
    if progress.lately['observed_point'] >= MIN_POINTS:
        findings += of_rejections(progress.lately, 'seen lately ')
    findings += of_velocity(estimator) + of_estimate(estimator)
    return findings + of_map_without_ids(estimator, estimator.ambiguity)


def _of_place(estimator: Estimate) -> list[Finding]:
    if estimator.is_localised:
        return []
    findings, problem = [found('unknown_pose')], estimator.localisation_problem
    # Landmarks that came without an id have one that was given here.
    is_by_place = is_automatic(estimator.landmark_ids).any() or len(estimator.possible_poses)
    return [*findings, problem] if problem and is_by_place else findings


def diagnostics(
    messages: OutgoingMessages, stamp_ns: int, estimator: Estimate, hardware_id: str
) -> Any:
    """Make the diagnostic_msgs/DiagnosticArray of an estimate, named as the node's."""
    findings = of_velocity(estimator) + of_estimate(estimator)
    findings += of_map_without_ids(estimator, estimator.ambiguity)
    problems = worst_first(findings, [])
    values = estimator_values(estimator, estimator.dropped, findings)
    status = messages.make(
        'diagnostic_msgs/msg/DiagnosticStatus',
        level=Level.WARNING if problems else Level.NOTE,
        name='observer_node: estimate',
        message=in_brief(problems) or 'running',
        hardware_id=hardware_id,
        values=[
            messages.make('diagnostic_msgs/msg/KeyValue', key=key, value=value)
            for key, value in values.items()
        ],
    )
    header = messages.header(stamp_ns, '')
    return messages.make('diagnostic_msgs/msg/DiagnosticArray', header=header, status=[status])
