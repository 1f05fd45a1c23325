"""The judge of health: what is wrong with an estimate, live and in a replay alike.

What it finds are data (``common/findings.py``), which table, JSON, report, log and /diagnostics
show. Nodes hand over what they count and measure; ``run_health.py`` judges what only a whole run
shows.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
import math
from statistics import median_low
from typing import Any

import numpy as np

from slam_observer_ros.common.findings import fault, Finding, found, Level
from slam_observer_ros.common.stamps import is_of_1970, to_s
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
    Update,
)
from slam_observer_ros.estimator.estimate import Estimate
from slam_observer_ros.lie.matrices import MAX_DEVIATION
from slam_observer_ros.settings.node_settings import ObserverNodeSettings

MAX_REJECTED = 0.1  # share of the points beyond which they are more than a sensor's outliers
MAX_REJECTED_ORIENTATIONS = 0.5  # … more than the flips of small or frontal tags
MAX_UNMAPPED = 0.5  # … more than what a map has not got yet
MAX_VAGUE = 0.5  # … stated to be anywhere, and so what the sensor states

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

NOTABLE_DELAY_S, CERTAIN = 0.1, 3.0  # least delay of velocities that is named, and its deviations

SHOWN, SURE = 0.25, 4.0
"""Power of the cosine in ranges, beyond the power of what they are taken for, that is worth a
finding, and by how many of its deviations."""

HARDLY_ANY = 0.25  # landmarks in a map over those seen too seldom, below which it is hardly one
IMPLAUSIBLE = 4.0  # stated deviations by which no calibration is off: something else is wrong
NOTABLY_NOISIER = 1.5  # factor of the noise of the odometry from which it is named as a problem

NOTABLY_WRONG, TOO_WRONG = math.sqrt(1.5), 2.0
"""Factors of the stated noise: what is worth a note, and what neither chance nor a sensor's usual
correlation explains."""

NOISELESS = 0.01  # share of the stated noise below which there is none at all

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


def rule(holds: bool, kind: str, /, level: Level | None = None, **figures: Any) -> list[Finding]:
    """Return the finding of a kind where it holds, else none; at a level of its own, if given."""
    if not holds:
        return []
    finding = found(kind, **figures)
    return [finding if level is None else replace(finding, level=level)]


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


def of_now(estimator: Estimate) -> list[Finding]:
    """Judge an estimate as it is now: whether velocities come, and what it has learnt."""
    is_stale = estimator.stamp_ns is not None and estimator.velocity_is_stale
    return [
        *rule(is_stale, 'stale_velocity'),
        *of_estimate(estimator),
        *of_map_without_ids(estimator, estimator.ambiguity),
    ]


def of_estimate(estimator: Estimate) -> list[Finding]:
    """Judge what is estimated of velocities and sensors, live and after a whole run alike."""
    calibration, factors = estimator.undisturbed
    of_odometry = [*of_calibration(calibration), *of_noise(factors)]
    is_rare = bool(of_odometry) and estimator.has_rare_velocities
    return [
        *of_odometry,
        *rule(is_rare, 'rare_velocity', period_s=estimator.velocity_period_s),
        *of_mounting(calibration),
        *of_half_points(estimator.anchor_biases, estimator.open_sides),
    ]


def of_all_learnt(estimator: Estimate) -> list[Finding]:
    """Judge the same, be it explained by a slip or the like: a mistake may explain both."""
    calibration = estimator.calibration
    of_velocity = [*of_calibration(calibration), *of_mounting(calibration)]
    return [*of_velocity, *of_noise(estimator.motion_factors)]


def of_half_points(biases: Mapping[int, float], open_sides: Sequence[int]) -> list[Finding]:
    """Name landmarks whose ranges are off everywhere, and those that fit on two sides."""
    biased = [
        found('anchor_biased', anchor=i, off_m=abs(m), towards='short' if m < 0 else 'long')
        for i, m in sorted(biases.items())
    ]
    ids = ', '.join(map(str, open_sides))
    return [*biased, *rule(bool(ids), 'side_undecided', ids=ids)]


def of_map_without_ids(estimator: Estimate, ambiguity: Ambiguity | None) -> list[Finding]:
    """Judge whether what was seen without ids makes one map, and makes one at all."""
    findings, known, waiting = [], len(estimator.landmark_ids), estimator.waiting_landmarks
    if ambiguity is not None:
        findings.append(found('ambiguous_map', **ambiguity.figures))
    # After twice as many observations as one landmark takes.
    is_begun = estimator.counts['observation'] >= 2 * estimator.settings.confirmations
    is_hardly_any = is_begun and known < HARDLY_ANY * waiting
    return findings + rule(is_hardly_any, 'unconfirmed_map', waiting=waiting, known=known)


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
        findings += rule(
            times > IMPLAUSIBLE,
            'implausible_calibration',
            name=part.name,
            value=factor * part.value,
            times=times,
            stated=factor * part.stated,
            nominal=f'{factor * part.nominal:g} {unit}'.rstrip(),
        )
    return findings


def of_mounting(
    calibration: Iterable[CalibrationEstimate], kind: str = 'mounting', usual: float = 0.0
) -> list[Finding]:
    """Say what to set so that sensors are stated as they were found to be.

    A property is found where it is three standard deviations off what is ``usual``, and those
    have become a third.
    """
    findings = []
    for part in calibration:
        name, _, frame = part.name.partition('/')
        mounted, _, axis = name.rpartition('_')
        off, sensor = part.value - part.nominal, frame or 'the sensor'
        if abs(off) < usual + 3.0 * part.deviation or 3.0 * part.deviation > part.stated:
            continue
        if name == 'range_scale':
            findings.append(found(name, sensor=sensor, found=part, value=part.value))
        elif mounted in MOUNTED:
            factor, unit = part.for_people
            words, entry = MOUNTED[mounted]['xyz'.index(axis)]
            findings += rule(
                True,
                kind,
                sensor=sensor,
                off=f'{abs(factor * off):.2g} ± {factor * part.deviation:.2g} {unit}',
                towards=words.split('/')[int(off < 0.0)],
                amount=off,
                entry=entry,
            )
    return findings


def of_ranges(power: RangePower | None, is_depth: bool) -> list[Finding]:
    """Judge whether ranges are what they are taken for, ranges or depths along the axis.

    What is estimated follows what they are taken for, so that only a part of the power is seen.
    """
    if power is None:
        return []
    # How far towards the other of the two.
    off = 1.0 - power.value if is_depth else power.value
    looks, set_to = ('range, not depth', 'false') if is_depth else ('depth along the axis', 'true')
    figures: dict[str, Any] = {'power': power.value, 'deviation': power.deviation}
    is_other = off >= max(SHOWN, SURE * power.deviation)
    return rule(is_other, 'depth_for_range', looks=looks, set_to=set_to, **figures)


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
    level = Level.WARNING if factor > TOO_WRONG else Level.NOTE
    return [
        *rule(factor > NOTABLY_WRONG, 'small_noise', level, factor=factor),
        *rule(factor < 1.0 / TOO_WRONG, 'large_noise', factor=1.0 / factor),
    ]


RECENT_INNOVATIONS = 300  # observations whose innovations are compared with stated noise
MIN_DEGREES = 100  # degrees of freedom that it takes to say so; the factor is then known to 7 %


class NoiseFit:
    """Compares the innovations of late with the noise that is stated."""

    def __init__(self) -> None:
        self._recent: deque[tuple[float, int]] = deque(maxlen=RECENT_INNOVATIONS)

    def add(self, update: Update) -> None:
        """Count an observation, if the gains know what was to be expected of it."""
        innovation = update.innovation
        if innovation is not None and innovation.nis is not None:
            self._recent.append((innovation.nis, innovation.degrees_of_freedom))

    @property
    def factor(self) -> float | None:
        """How many times as large as stated innovations are; None while that is not known."""
        degrees = sum(each for _, each in self._recent)
        if degrees < MIN_DEGREES:
            return None
        return float(np.sqrt(sum(nis for nis, _ in self._recent) / degrees))

    @property
    def findings(self) -> list[Finding]:
        """What is wrong with the noise that is stated."""
        return of_fit(self.factor)

    def __str__(self) -> str:
        """Return the factor, and what is wrong with the noise by it."""
        if self.factor is None:
            return 'not known yet'
        return f'{self.factor:.2f}' + ''.join(f' ({each.what})' for each in self.findings)


def of_rejections(counts: Counter[str], when: str = '') -> list[Finding]:
    """Judge whether more points or orientations were rejected than are outliers, or say little."""
    names = ('rejected_landmark', 'rejected_orientation', 'vague_point')
    points, turns, vague = (point_share(counts, name) for name in names)
    count, limit_m = counts['vague_point'], MAX_DEVIATION
    return [
        *rule(points > MAX_REJECTED, 'rejected_points', percent=100.0 * points, when=when),
        *rule(
            turns > MAX_REJECTED_ORIENTATIONS,
            'rejected_orientations',
            percent=100.0 * turns,
            when=when,
        ),
        *rule(vague > MAX_VAGUE, 'vague_point', count=count, limit_m=limit_m),
    ]


def of_left_out(counts: Counter[str], level: Level) -> list[Finding]:
    """Report points that were left out: most of them, or for their ids."""
    left_out = {reason: counts[reason.value] for reason in LEFT_OUT if counts[reason.value]}
    of_wrong_ids = any(reason in left_out for reason in WRONG_IDS)
    most = most_frequent(counts, WRONG_IDS if of_wrong_ids else LEFT_OUT)
    total = counts['observed_point']
    if most is None or not (of_wrong_ids or 2 * sum(left_out.values()) > total):
        return []
    reasons = ', '.join(f'{count} {reason.words}' for reason, count in left_out.items())
    remedy = most.remedy
    return rule(True, 'left_out_points', level, count=total, reasons=reasons, remedy=remedy)


def of_stamps(unstamped: Counter[str]) -> list[Finding]:
    """Report topics whose messages, so many of each, came without a stamp."""
    count = unstamped.total()
    return rule(count > 0, 'zero_stamps', topics=', '.join(unstamped), count=count)


SILENT_S = 2.0  # an input without messages for this long is a warning
MIN_POINTS = 50  # points that it takes to say how large a share of them is rejected
MANY_EMPTY = 200  # messages without a landmark, that are no detector that waits for one
MANY_UNUSED = 20  # messages, none of which was used, that are no transient of the start
USED_AS = {'twist': 'velocity', 'landmarks': 'observation'}  # what inputs count as


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

    def level(self, findings: Iterable[Finding], problems: Sequence[str]) -> Level:
        """Return how bad a node's state is; all that came in vain is an error."""
        level = max((finding.level for finding in findings), default=Level.NOTE)
        used = self.counts['velocity'] + self.counts['observation']
        if self.dropped and not used and not self.is_paused:
            return Level.ERROR
        return max(level, Level.WARNING) if problems else level


def of_node(
    estimator: Estimate, inputs: Sequence[InputNumbers], progress: Progress
) -> list[Finding]:
    """Judge where the robot is, what came, and what is estimated."""
    counts, total = estimator.counts, progress.dropped.total()
    unused = [
        found('unused_input', count=each.received, topic=each.topic)
        for each in inputs
        if each.name in USED_AS and each.received >= MANY_UNUSED and not counts[USED_AS[each.name]]
    ]
    silent = [
        found('silent_input', topic=each.topic)
        for each in inputs
        if not each.problem and each.silent_s > SILENT_S
    ]
    place = rule(not estimator.is_localised, 'unknown_pose')
    # Landmarks that came without an id have one that was given here.
    if place and (is_automatic(estimator.landmark_ids).any() or len(estimator.possible_poses)):
        problem = estimator.localisation_problem
        place += [problem] if problem else []
    dropped = rule(progress.is_paused, 'paused')
    # What came while the node was paused or inactive was not to be used.
    if total and not progress.is_paused:
        (reason, _), *others = progress.dropped.most_common()
        count = f'{total} message{"s" * (total != 1)}'
        reasons = f'mostly {reason}' if others else reason
        dropped = [found('dropped_messages', count=count, reasons=reasons)]
    is_empty = not progress.has_seen and counts['observation'] >= MANY_EMPTY
    has_points = progress.lately['observed_point'] >= MIN_POINTS
    said = [*(each.unread for each in inputs), *(each.doubt for each in inputs)]
    return [
        *place,
        *(unused if total and not progress.is_paused else []),
        *silent,
        *dropped,
        *(finding for finding in said if finding is not None),
        *of_stamps(progress.unstamped),
        *rule(is_empty, 'empty_messages', count=counts['observation']),
        *estimator.ids_at_two_places,
        *of_left_out(progress.counts, Level.WARNING),
        *(of_rejections(progress.lately, 'seen lately ') if has_points else []),
        *of_now(estimator),
    ]


def deviations(estimator: Estimate) -> tuple[float, float] | None:
    """Return standard deviations of position, in its worst direction, m, and of heading, rad.

    None if they are not known, and infinite if the covariance is not finite.
    """
    covariance = None if estimator.stamp_ns is None else estimator.pose_covariance
    if covariance is None:
        return None
    if not np.isfinite(covariance).all():
        return np.inf, np.inf
    variances_m2 = np.linalg.eigvalsh(covariance[3:, 3:])
    return math.sqrt(max(variances_m2[-1], 0.0)), math.sqrt(max(covariance[2, 2], 0.0))


def localisation(
    estimator: Estimate, limits: ObserverNodeSettings, share: float = 1.0
) -> tuple[Level, str]:
    """Judge, in words too, how well the pose is known: lost from a share of the error level on."""
    if estimator.stamp_ns is None:
        return Level.WARNING, 'no estimate yet'
    if not estimator.is_localised:
        return Level.ERROR, 'the pose in the loaded map is not known'
    if estimator.is_contradicted:
        return Level.ERROR, found('contradicted_pose').what
    if estimator.map_name and estimator.ambiguity is not None:
        return Level.ERROR, 'what is seen fits several places of the map'
    if (known := deviations(estimator)) is None:
        return Level.NOTE, 'localised; the gains know no standard deviation'
    worst, reasons = Level.NOTE, []
    for name, value, unit, (warn, lost) in (
        ('position', known[0], 'm', limits.position_limits),
        ('heading', known[1], 'rad', limits.heading_limits),
    ):
        error = share * lost
        if value > min(warn, error):
            worst = max(worst, Level.ERROR if value > error else Level.WARNING)
            reasons.append(f'{name} uncertain: σ = {value:.2f} {unit}')
    return worst, '; '.join(reasons) or 'localised'


def of_publishers(topic: str, publishers: Sequence[Any]) -> Finding | None:
    """Report who publishes on a topic, by rclpy's TopicEndpointInfo, if more than one does."""
    if len(publishers) < 2:
        return None
    names = sorted(f'{p.node_namespace.rstrip("/")}/{p.node_name}' for p in publishers)
    return found('several_publishers', count=len(names), names=', '.join(names), topic=topic)


def of_types(topic: str, heard: str, others: str) -> Finding:
    """Report that types beside the one that is heard are published on a topic."""
    return found('several_types', topic=topic, heard=heard, others=others)


def of_twist(topic: str, problem: str) -> Finding:
    """Report that an odometry's twist is not how its poses move; without problem, that it is 0."""
    return found('wrong_twist' if problem else 'zero_twist', topic=topic, problem=problem)


BEHIND_S = 0.3  # messages that wait for less, as while a map is loaded, are no matter
LASTING_S = 2.0  # how long messages have to wait for more than that before it is reported


class Backlog:
    """Distinguishes a program that can't keep up with a topic from one busy for a moment.

    ``wait_s`` is how long the last message has waited, seconds.
    """

    def __init__(self) -> None:
        self.wait_s = 0.0
        self._last_s = 0.0
        self._behind_since_s: float | None = None

    def add(self, wait_s: float, now_s: float) -> None:
        """Take how long a message that is read now, at a steady time, has waited, seconds.

        That is less than zero if the clock was set meanwhile.
        """
        is_long_ago = now_s - self._last_s > LASTING_S
        self.wait_s, self._last_s = max(wait_s, 0.0), now_s
        if self.wait_s <= BEHIND_S:
            self._behind_since_s = None
        elif self._behind_since_s is None or is_long_ago:
            self._behind_since_s = now_s

    def problem(self, topic: str, now_s: float) -> str:
        """Report that messages have waited for long and still do; empty if not."""
        since_s, last_s = self._behind_since_s, self._last_s
        if since_s is None or last_s - since_s < LASTING_S or now_s - last_s > LASTING_S:
            return ''
        return fault('slow_node', topic=topic, wait_s=self.wait_s)


MIN_PERIOD_S = 2.0  # time over which drops are counted: who was busy for a moment does keep up
MANY_SHED = 0.1  # share of the messages from which on it is reported


def overload(topic: str, read: int, shed: int, period_s: float) -> str:
    """Report that many messages of a period were dropped, and how many would not be; else ''."""
    if period_s < MIN_PERIOD_S or shed <= MANY_SHED * read:
        return ''
    rate_hz, used_hz = read / period_s, (read - shed) / period_s
    return fault('overload', topic=topic, rate_hz=rate_hz, used_hz=used_hz)


SAMPLES = 11  # messages whose median offset is looked at: five stragglers in a row change nothing
FUTURE_NS = 50_000_000  # stamps further ahead of their reception are of another clock


class ClockOffset:
    """Offset of the stamps of one publisher, by which they may be of another clock.

    Behind this machine's by more than ``limit_ns``, or ahead of it by ``FUTURE_NS``: a message can
    be late, but not early.

    Attributes
    ----------
    offset_ns : int or None
        Stamp minus time of reception, median of the last messages; None until known.
    correction_ns : int
        What must be added to the stamps to have them in this machine's time; it changes only
        when the stamps so corrected leave the limit, so that their order is kept.

    """

    def __init__(self, limit_ns: int) -> None:
        self._limit_ns = self._ahead_ns = limit_ns
        self._recent: deque[int] = deque(maxlen=SAMPLES)
        self.offset_ns: int | None = None
        self.correction_ns = 0
        self._counts_from_start = False

    @property
    def is_off(self) -> bool:
        """Whether the stamps are from another clock."""
        return self.offset_ns is not None and not self._is_near(self.offset_ns)

    def __str__(self) -> str:
        """Say how far off the stamps are."""
        offset_ns = self.offset_ns or 0
        side = 'ahead of' if offset_ns > 0 else 'behind'
        return f"{to_s(abs(offset_ns)):.3f} s {side} this machine's clock"

    def problem(self, topic: str, is_simulated: bool) -> str:
        """Report how far off the stamps on a topic are, or one of late; empty if they are right.

        ``is_simulated``: this machine's clock is /clock.
        """
        if self.is_off and self._counts_from_start:
            simulation = 'whose /clock is another' if is_simulated else 'set use_sim_time'
            return fault('stamps_of_1970', topic=topic, simulation=simulation)
        advice = 'synchronise the clocks, or set use_sim_time (for a recording)'
        if is_simulated:
            advice = 'see whether their publisher uses /clock, and this machine keeps up with it'
        if self.is_off:
            late = ':'
            if (self.offset_ns or 0) < 0:
                late = ', or what publishes them is that late: then make it faster; otherwise'
            return fault('stamps_off', topic=topic, off=self, late=late, advice=advice)
        ahead_ns = max(self._recent, default=0)
        if ahead_ns > self._ahead_ns:
            return fault('stamp_ahead', topic=topic, ahead_s=to_s(ahead_ns), advice=advice)
        return ''

    def add(self, stamp_ns: int, receive_ns: int, is_simulated: bool = False) -> None:
        """Take the stamp and the time of reception of a message; by /clock if ``is_simulated``."""
        # /clock stands still between two of its messages.
        self._ahead_ns = self._limit_ns if is_simulated else min(FUTURE_NS, self._limit_ns)
        self._recent.append(stamp_ns - receive_ns)
        self._counts_from_start = is_of_1970(stamp_ns) and not is_of_1970(receive_ns)
        if len(self._recent) < SAMPLES:
            return
        self.offset_ns = median_low(self._recent)
        if not self._is_near(self.offset_ns + self.correction_ns):
            self.correction_ns = -self.offset_ns if self.is_off else 0

    def _is_near(self, offset_ns: int) -> bool:
        return -self._limit_ns <= offset_ns <= self._ahead_ns

    def clear(self) -> None:
        """Forget all offsets, as after a jump of this machine's clock."""
        self._recent.clear()
        self.offset_ns = None
        self.correction_ns = 0
