"""The judge of health: what is wrong with an estimate, live and in a replay alike.

What it finds are data (``common/findings.py``), which table, JSON, report, log and /diagnostics
show. ``input_health.py`` judges what a recording holds, ``error_health.py`` its errors.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
import math
from typing import Any, Protocol, TypeAlias

from slam_observer_ros.common.findings import Finding, found, in_brief, Level, worst_first
from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import IntArray
from slam_observer_ros.estimates import (
    Ambiguity,
    CalibrationEstimate,
    DELAY_NAME,
    most_frequent,
    MotionFactor,
    point_share,
    RangePower,
    Reason,
    Update,
)
from slam_observer_ros.lie.matrices import MAX_DEVIATION
from slam_observer_ros.messages.outgoing import OutgoingMessages
from slam_observer_ros.settings.estimator_settings import Settings

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
        (
            'further rolled to the right/further rolled to the left',
            'further down/further up',
            'further to the left/further to the right',
        ),
        ('roll', 'pitch', 'yaw'),
    ),
    'sensor_translation': (
        (
            'further forward/further back',
            'further to the left/further to the right',
            'higher/lower',
        ),
        ('x', 'y', 'z'),
    ),
}
"""In words, by axis, how a sensor is mounted whose turn or shift is positive/negative."""


Learnt: TypeAlias = tuple[Sequence[CalibrationEstimate], Sequence[MotionFactor]]
"""Calibration and noise of the odometry."""


class Diagnosed(Protocol):
    """What is looked at of an :class:`.Estimator`."""

    last_update: Update | None

    @property
    def counts(self) -> Counter[str]: ...  # noqa: D102 (as all below, of the estimator)
    @property
    def dropped(self) -> Counter[str]: ...  # noqa: D102
    @property
    def landmark_ids(self) -> IntArray: ...  # noqa: D102
    @property
    def settings(self) -> Settings: ...  # noqa: D102
    @property
    def ambiguity(self) -> Ambiguity | None: ...  # noqa: D102
    @property
    def waiting_landmarks(self) -> int: ...  # noqa: D102
    @property
    def calibration(self) -> Sequence[CalibrationEstimate]: ...  # noqa: D102
    @property
    def motion_factors(self) -> Sequence[MotionFactor]: ...  # noqa: D102
    @property
    def anchor_biases(self) -> Mapping[int, float]: ...  # noqa: D102
    @property
    def open_sides(self) -> Sequence[int]: ...  # noqa: D102
    @property
    def undisturbed(self) -> Learnt: ...  # noqa: D102
    @property
    def has_rare_velocities(self) -> bool: ...  # noqa: D102
    @property
    def velocity_period_s(self) -> float: ...  # noqa: D102
    @property
    def lyapunov(self) -> float: ...  # noqa: D102
    @property
    def stamp_ns(self) -> int | None: ...  # noqa: D102
    @property
    def velocity_is_stale(self) -> bool: ...  # noqa: D102


def estimator_values(
    estimator: Diagnosed, dropped: Counter[str], findings: Iterable[Finding]
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


def of_velocity(estimator: Diagnosed) -> list[Finding]:
    """Judge whether velocities still come."""
    stale = estimator.stamp_ns is not None and estimator.velocity_is_stale
    return [found('stale_velocity')] if stale else []


def of_estimate(estimator: Diagnosed) -> list[Finding]:
    """Judge what is estimated of velocities and sensors, live and after a whole run alike."""
    calibration, factors = estimator.undisturbed
    of_odometry = [*of_calibration(calibration), *of_noise(factors)]
    if of_odometry and estimator.has_rare_velocities:
        of_odometry.append(found('rare_velocity', period_s=estimator.velocity_period_s))
    half_points = of_half_points(estimator.anchor_biases, estimator.open_sides)
    return [*of_odometry, *of_mounting(calibration), *half_points]


def of_all_learnt(estimator: Diagnosed) -> list[Finding]:
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


def of_map_without_ids(estimator: Diagnosed, ambiguity: Ambiguity | None) -> list[Finding]:
    """Judge whether what was seen without ids makes one map, and makes one at all."""
    findings, known, waiting = [], len(estimator.landmark_ids), estimator.waiting_landmarks
    if ambiguity is not None:
        x, y, _ = ambiguity.position
        lasts_s, probability = to_s(ambiguity.lasts_ns), ambiguity.probability
        findings.append(found('ambiguous_map', lasts_s=lasts_s, x=x, y=y, probability=probability))
    # After twice as many observations as one landmark takes.
    times = estimator.settings.min_support
    is_begun = estimator.counts['observation'] >= 2 * times
    if is_begun and known < HARDLY_ANY * waiting:
        findings.append(found('unconfirmed_map', waiting=waiting, times=times, known=known))
    return findings


def of_calibration(calibration: Iterable[CalibrationEstimate]) -> list[Finding]:
    """Judge what was found out of the velocity: a delay first, as scales make up for it."""
    parts = list(calibration)
    for part in parts:
        notable_s = max(NOTABLE_DELAY_S, CERTAIN * part.deviation)
        if part.name == DELAY_NAME and abs(part.value - part.nominal) > notable_s:
            when = 'late' if part.value > 0.0 else 'early'
            return [found('late_odometry', delay_s=abs(part.value), when=when, set_to=part.value)]
    return [_implausible(part) for part in parts if _times_off(part) > IMPLAUSIBLE]


def _times_off(part: CalibrationEstimate) -> float:
    return abs(part.value - part.nominal) / part.stated


def _implausible(part: CalibrationEstimate) -> Finding:
    factor, unit = part.for_people
    return found(
        'implausible_calibration',
        name=part.name,
        value=factor * part.value,
        times=_times_off(part),
        stated=factor * part.stated,
        nominal=f'{factor * part.nominal:g} {unit}'.rstrip(),
    )


def of_mounting(calibration: Iterable[CalibrationEstimate]) -> list[Finding]:
    """Say what to set so that sensors are stated as they were found to be."""
    return [finding for part in calibration if (finding := _mounting(part))]


def _mounting(part: CalibrationEstimate) -> Finding | None:
    """Judge one property of a sensor.

    It is found where it is three standard deviations off, and those have become a third.
    """
    name, _, frame = part.name.partition('/')
    off, sensor = part.value - part.nominal, frame or 'the sensor'
    if abs(off) < 3.0 * part.deviation or 3.0 * part.deviation > part.stated:
        return None
    if name == 'range_scale':
        return found('range_scale', sensor=sensor, found=part, value=part.value)
    mounted, _, axis = name.rpartition('_')
    if mounted not in MOUNTED:
        return None
    factor, unit = part.for_people
    words, entries = MOUNTED[mounted]
    number = 'xyz'.index(axis)
    return found(
        'mounting',
        sensor=sensor,
        off=f'{abs(factor * off):.2g} ± {factor * part.deviation:.2g} {unit}',
        towards=words[number].split('/')[int(off < 0.0)],
        amount=off,
        entry=entries[number],
    )


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


def diagnostics(
    messages: OutgoingMessages, stamp_ns: int, estimator: Diagnosed, hardware_id: str
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
