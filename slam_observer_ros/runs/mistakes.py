"""Which mistake of the set-up explains a recording better than that it is right.

Signs, units and frames: of each mistake the inverse is applied to the first minute and a half of
driving, or to more if that leaves it open, and the points are judged by how likely the filter
found them before it used them. A
density is per unit of length: with points that are multiplied by s it is s^k times as large per
unit of what was recorded, k being 2 in the plane and 3 in space.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, groupby
import math
import time
from typing import Any, TypeAlias, TypeVar

import numpy as np

from slam_observer_ros.common.findings import Finding, found, muted_warnings
from slam_observer_ros.common.stamps import to_ns, to_s
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.estimates import CalibrationEstimate, Update
from slam_observer_ros.estimator.checks import MAX_MEASURED
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import (
    AngularVelocityEvent,
    Event,
    ObservationEvent,
    POINT,
    UNKNOWN_ID,
    VelocityBlock,
    VelocityEvent,
)
from slam_observer_ros.lie import so3
from slam_observer_ros.lie.axes import axes_of
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.models.observation_noise import ObservationNoise
from slam_observer_ros.runs.health import of_mounting
from slam_observer_ros.runs.recorders import Likelihood, LikelihoodRecorder
from slam_observer_ros.settings.estimator_settings import Settings

_IDENTITY = np.eye(3)
EventT = TypeVar('EventT', bound=Event | VelocityBlock)


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """What makes a recording right again that was made with a mistake of one kind."""

    kind: str  # of finding; '' if nothing is wrong
    points: FloatArray = field(default_factory=lambda: _IDENTITY)  # (3, 3), times each point
    turn: float = 1.0  # times the angular velocity
    drive: float = 1.0  # times the linear velocity
    changes: Mapping[str, Any] = field(default_factory=dict)  # of settings, while it is judged
    parts: tuple[Correction, ...] = ()  # of a pair of mistakes

    def goes_with(self, other: Correction) -> bool:
        """Return whether both can be of one set-up, and are not the same as a single one."""
        kinds = {self.kind, other.kind}
        return len(kinds) == 2 and kinds not in ALIKE

    def and_then(self, other: Correction) -> Correction:
        """Return the correction of both mistakes."""
        return Correction(
            '',
            other.points @ self.points,
            self.turn * other.turn,
            self.drive * other.drive,
            parts=(self, other),
        )

    def apply(
        self, events: Iterable[EventT], noise: ObservationNoise | None = None
    ) -> Iterable[EventT]:
        """Yield the events as they should have been recorded.

        With ``noise`` points keep theirs, as a share of their distance: else a world that shrinks
        would be likelier where noise is stated too large.
        """
        scales = np.repeat([self.turn, self.drive], 3)
        for event in events:
            if isinstance(event, ObservationEvent):
                covariances = event.covariances if noise is None else noise.covariances(event)
                M = self.points_seen_along(event.sensor_axis)
                moved = event.lines_of_sight @ (M - _IDENTITY).T
                yield replace(
                    event,
                    points=event.points + moved,
                    covariances=None if covariances is None else M @ covariances @ M.T,
                    orientations=None,
                    orientation_covariances=None,
                )
            elif isinstance(event, VelocityEvent):
                yield replace(event, body_velocity=scales * event.body_velocity)
            elif isinstance(event, VelocityBlock):
                yield replace(event, body_velocities=scales * event.body_velocities)
            else:
                yield replace(event, angular_velocity=self.turn * event.angular_velocity)

    def points_seen_along(self, axis: FloatArray | None) -> FloatArray:
        """Return by what lines of sight (3,) are multiplied that a sensor has which looks there.

        Such a sensor is turned about z against the robot, whose axes the event has.
        """
        if axis is None or not axis[:2].any():
            return self.points
        R = so3.exp(np.array([0.0, 0.0, math.atan2(axis[1], axis[0])]))
        turned: FloatArray = R @ self.points @ R.T
        return turned

    def scale(self) -> float:
        """Return by what lengths are multiplied."""
        return float(abs(np.linalg.det(self.points)) ** (1.0 / 3.0))


OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""From a camera's axes, z forward and x to the right, to a robot's."""

IN_DEGREES = math.radians(1.0)

SIZED = {'linear_scale_stddev': (0.0, 0.0, 0.0)}  # a scale of wheels would hide tags' size

AS_IT_IS, AS_SIZED = Correction(''), Correction('', changes=SIZED)

CORRECTIONS = (
    Correction('points_in_optical_axes', OPTICAL),
    Correction('points_mirrored', np.diag([1.0, -1.0, 1.0])),
    Correction('points_backwards', np.diag([-1.0, -1.0, 1.0])),
    Correction('points_in_millimetres', 1e-3 * _IDENTITY),
    *(
        Correction('tag_size', s * _IDENTITY, changes=SIZED)
        for s in (0.5, 0.67, 0.8, 1.25, 1.5, 2.0)
    ),
    Correction('turning_in_degrees', turn=IN_DEGREES),
    Correction('speed_in_kmh', drive=1.0 / 3.6),
    Correction('turning_negated', turn=-1.0),
    Correction('driving_negated', drive=-1.0),
)

MIRRORED = {'points_mirrored', 'turning_negated'}
ALIKE = (MIRRORED, {'points_backwards', 'driving_negated'})
"""Mirror images of each other, and what differs by which end of the robot is its front."""

IN_MAP = (
    *CORRECTIONS,
    Correction(
        '',
        np.diag([1.0, -1.0, 1.0]),
        turn=-1.0,
        parts=tuple(each for each in CORRECTIONS if each.kind in MIRRORED),
    ),
)
"""With both mirror images at once, of which a robot without a map notices nothing."""

PAIRS = tuple(
    one.and_then(other)
    for one, other in combinations([each for each in CORRECTIONS if not each.changes], 2)
    if one.goes_with(other)
)

ROTATION = (0.1,) * 3  # how far a sensor may be turned against what is stated, rad
USUALLY_TURNED = 0.035  # how far brackets are turned as a rule, rad; settings state it

DRIVE_S, TURNED_RAD = 90.0, 4.0 * math.pi
"""Time of driving, and turns, that are looked at: who stands or goes straight on says little."""

MOST_S = 300.0  # time in all, at most
LEAST_DRIVEN_S = 20.0  # seconds of driving that say something where nothing looks wrong
LONGER = 2.0  # times as much is looked at where less leaves open whether a mistake was made


def first_drive(events: Iterable[Event], part: float = 1.0) -> list[Event]:
    """Return events, with ids alone, until a ``part`` of DRIVE_S is driven, or of MOST_S over."""
    kept: list[Event] = []
    drive, first_ns = Drive(), None
    for event in events:
        first_ns = event.stamp_ns if first_ns is None else first_ns
        is_enough = drive.driven_s > part * DRIVE_S and drive.turned_rad > part * TURNED_RAD
        if is_enough or event.stamp_ns - first_ns > part * to_ns(MOST_S):
            break
        drive.add(event)
        if isinstance(event, ObservationEvent):
            event = event.select(judgeable(event))
        kept.append(event)
    return kept


def judgeable(event: ObservationEvent) -> BoolArray:
    """Return by which of its points (m,) mistakes are judged: whole ones with ids."""
    size = np.abs(event.points).max(axis=1, initial=0.0)
    # What sensors write for 'none' says how far no other point may be.
    usable: BoolArray = (event.ids != UNKNOWN_ID) & (size > 0.0) & (size <= MAX_MEASURED)
    return usable if event.kinds is None else usable & (event.kinds == POINT)


def in_blocks(events: Iterable[Event]) -> Iterator[Event | VelocityBlock]:
    """Yield events with the velocities that follow each other in blocks, which take less time."""

    def alike_in(event: Event) -> tuple[bool, bool, bool] | None:
        """Return what velocities of a block have in common; None for what is no velocity."""
        if not isinstance(event, VelocityEvent):
            return None
        return event.is_mean, event.covariance is None, event.receive_ns is None

    for alike, group in groupby(events, key=alike_in):
        if alike is None:
            yield from group
            continue
        velocities = [each for each in group if isinstance(each, VelocityEvent)]
        covariances = [each.covariance for each in velocities if each.covariance is not None]
        received = [each.receive_ns for each in velocities if each.receive_ns is not None]
        yield VelocityBlock(
            np.array([each.stamp_ns for each in velocities]),
            np.array([each.body_velocity for each in velocities]),
            np.array(covariances) if covariances else None,
            np.array(received) if received else None,
            is_mean=velocities[0].is_mean,
        )


class Drive:
    """How long the robot drives, and by how much velocities turn it.

    These are radians if the velocities are in rad/s. A velocity that is held for more than a
    second says nothing any more.
    """

    def __init__(self, events: Iterable[Event] = ()) -> None:
        self.driven_s, self.turned_rad = 0.0, 0.0
        self._last: VelocityEvent | None = None
        for event in events:
            self.add(event)

    def add(self, event: Event) -> None:
        """Take in an event."""
        if not isinstance(event, VelocityEvent):
            return
        if self._last is not None and self._last.body_velocity.any():
            held_s = min(to_s(max(event.stamp_ns - self._last.stamp_ns, 0)), 1.0)
            self.driven_s += held_s
            self.turned_rad += held_s * float(np.linalg.norm(self._last.body_velocity[:3]))
        self._last = event


OUT_OF_PLANE = 0.1  # share of turning or of speed beyond which a robot is not on a floor


def is_flat(velocities: FloatArray) -> bool:
    """Return whether hardly any of the motion (k, 6) is out of the plane z = 0."""
    squares = np.square(velocities).sum(axis=0)
    tilting, climbing = squares[:2].sum(), squares[5]
    limit = OUT_OF_PLANE**2
    return bool(tilting <= limit * squares[:3].sum() and climbing <= limit * squares[3:].sum())


def never_turns(events: Iterable[Event]) -> bool:
    """Return whether the robot drives, and all its angular velocities are exactly zero."""
    moves = [each.body_velocity for each in events if isinstance(each, VelocityEvent)]
    turns = [each.angular_velocity for each in events if isinstance(each, AngularVelocityEvent)]
    turns += [move[:3] for move in moves]
    return any(move.any() for move in moves) and not any(turn.any() for turn in turns)


Maps: TypeAlias = LandmarkMap | Sequence[LandmarkMap]
T = TypeVar('T')

SURE, CLEAR = 25.0, 0.05  # ln of how many times likelier all points must be, and each on average
LIKELIER = math.log(20.0)  # of all points, where more of the drive may show a mistake

WEAK = 1.0
"""The same for each point on average, of a mistake that may be a symptom of a pair.

What is right gains several as a rule, but sizes of tags, which wheels are to show.
"""

STRETCH_NS, THROUGHOUT = to_ns(5.0), 0.25
"""Stretches of a drive, and the share of them that is likelier at least if a mistake explains it.

N gains that are equal, among others that are nothing, have a sum of √N times their norm. A
stretch counts for SURE at most: where a filter is lost, a single one may be worth all others.
"""

NOTABLE_TURN_RAD = 1.0  # by what is seen, of a robot that turns without saying so
UNKNOWN_TURN = 1.0  # noise of an unknown turning, rad/√s: about a radian in a second
ROUGHLY = 0.2  # deviation of a scale that is known to the next of the sizes that are tried

EARLY, TRIED = 1.0 / 3.0, 3
"""Part of the drive by which corrections are chosen that are tried on the whole, and how many."""

LEAST_TURN_RAD = 1.0  # left in all of an angular velocity that is taken for one in degrees


def mistakes(
    settings: Settings,
    events: Iterable[Event],
    known: Maps | None = None,
    of_mount_only: bool = False,
) -> list[Finding]:
    """Name the mistakes of the set-up, two at most, that explain what was recorded; none if right.

    Points without ids, whose meaning depends on the set-up, are left out, and so are half points,
    of which other densities are compared. ``known`` are the maps in one of which the robot was.
    """
    search = Search(settings, events, known, of_mount_only)
    search.advance(math.inf)
    return search.findings


class Search:
    """Looks for mistakes as :func:`mistakes` does, a part at a time, as a live node can't wait."""

    def __init__(
        self,
        settings: Settings,
        events: Iterable[Event],
        known: Maps | None = None,
        of_mount_only: bool = False,
    ) -> None:
        self.findings: list[Finding] = []
        trial = replace(
            settings,
            gains='riccati',
            reorder_window=0.0,
            use_tag_orientation=False,
            max_hypotheses=1,
            relinearization_interval=0,
        )
        self._steps = _named(trial, events, known, of_mount_only)

    def advance(self, seconds: float) -> bool:
        """Go on for some time; return whether the end is reached, and ``findings`` are known."""
        end_s = time.perf_counter() + seconds
        try:
            with muted_warnings():  # what is wrong with a trial is no news
                while time.perf_counter() < end_s:
                    next(self._steps)
        except StopIteration as end:
            self.findings = end.value
            return True
        return False


Steps: TypeAlias = Generator[None, None, T]
"""What returns a result, and yields after each event that it has used."""


def _named(
    settings: Settings, recorded: Iterable[Event], known: Maps | None, of_mount_only: bool
) -> Steps[list[Finding]]:
    if of_mount_only:
        return (yield from _Trial(settings, first_drive(recorded), known).mount())
    # Else the size of tags, and what not, would be likelier where a sensor is turned.
    opened = settings
    if leaves_mount_open(settings):
        opened = replace(settings, sensor_rotation_stddev=ROTATION)
    longer = first_drive(recorded, LONGER)
    events = first_drive(longer)
    findings = yield from _Trial(opened, events, known).named(EARLY, len(longer) == len(events))
    if findings is None:
        findings = yield from _Trial(opened, longer, known).named(LONGER * EARLY, is_all=True)
    return findings or (yield from _Trial(settings, events, known).mount())


def leaves_mount_open(settings: Settings) -> bool:
    """Return whether a sensor that is turned against what is stated is not found as it drives."""
    turned = axes_of(settings.two_d_mode).turned
    return not np.array(settings.sensor_rotation_stddev)[turned].all()


@dataclass(frozen=True, slots=True)
class _Trial:
    """What corrections are tried on: a drive, and how a filter takes it."""

    settings: Settings
    events: Sequence[Event]
    known: Maps | None

    def sees_any(self) -> bool:
        """Return whether there are points at all."""
        return any(len(each.ids) for each in self.events if isinstance(each, ObservationEvent))

    def mount(self) -> Steps[list[Finding]]:
        """Return how a sensor is turned further than brackets are, if points are likelier so."""
        if not (leaves_mount_open(self.settings) and self.sees_any()):
            return []
        if Drive(self.events).driven_s < LEAST_DRIVEN_S:
            return []
        open_mount = Correction('', changes={'sensor_rotation_stddev': ROTATION})
        turned = yield from self.score(open_mount)
        findings = of_mounting(turned.calibration, 'mount_off', USUALLY_TURNED)
        findings = [each for each in findings if each.kind == 'mount_off']  # no scale of ranges
        if findings:
            before = yield from self.score(AS_IT_IS)
            # What it makes up for, as commands that are obeyed late, helps here and there alone.
            findings = findings if turned.is_clearly_better(before) else []
        return findings

    def named(self, early: float, is_all: bool) -> Steps[list[Finding] | None]:
        """Return the mistakes that explain it; None if more events, unless it is all, may do so.

        By an ``early`` part of the drive is chosen what is tried on the whole.
        """
        if not self.sees_any():
            return []
        trial, singles = self, CORRECTIONS if self.known is None else IN_MAP
        is_silent = never_turns(self.events)
        if is_silent:  # how it turns is for the points to say
            unknown = replace(self.settings, angular_velocity_noise=(UNKNOWN_TURN,) * 3)
            trial = replace(self, settings=unknown)
            singles = tuple(each for each in singles if each.turn == 1.0)
        before = yield from trial.score(AS_IT_IS)
        best, is_open = yield from trial.best(early, before, singles)
        if is_open and not is_all:
            return None
        if best is before or best.mean - before.mean < WEAK:
            # As with points in millimetres and in a camera's axes, where no single one helps much.
            pair, _ = yield from trial.best(early, before, PAIRS)
            best = pair if pair.is_clearly_better(best) else best
        silent = []
        if is_silent and min(before.turned_rad, best.turned_rad) > NOTABLE_TURN_RAD:
            silent = [found('no_turning')]
        parts = best.correction.parts
        if best is not before and not parts:
            first = best.correction
            parts = (first,)
            if not silent:
                changed = replace(trial.settings, **first.changes)
                trial = replace(trial, settings=changed, events=list(first.apply(self.events)))
                before = yield from trial.score(AS_IT_IS)
                others = [each for each in CORRECTIONS if first.goes_with(each)]
                second, _ = yield from trial.best(early, before, others)
                if second is not before:
                    parts = (first, second.correction)
        return [*silent, *(finding for each in parts for finding in self._findings(each))]

    def best(
        self, early: float, before: _Score, corrections: Iterable[Correction]
    ) -> Steps[tuple[_Score, bool]]:
        """Return how likely points are by the correction that makes them clearly the likeliest.

        That is ``before`` where none does, the score of what was recorded. Then some may make them
        likelier, though not clearly so: whether one does is returned, too.
        """
        tried: list[_Score] = []
        at_first = replace(self, events=first_drive(self.events, early))
        before_at_first = before.until(at_first.events[-1].stamp_ns)
        moves = [each.body_velocity for each in self.events if isinstance(each, VelocityEvent)]
        may_be = {
            'turning_in_degrees': Drive(self.events).turned_rad * IN_DEGREES > LEAST_TURN_RAD,
            # In the plane ways that go out of it are too long for what is seen.
            'tag_size': is_flat(np.reshape(moves, (-1, 6))) or not self.settings.two_d_mode,
        }
        for each in corrections:
            if all(may_be.get(part.kind, True) for part in each.parts or (each,)):
                score = yield from at_first.score(each, before)
                if not score.is_hopeless and not before_at_first.is_clearly_better(score):
                    tried.append(score)
        tried.sort(key=lambda score: score.mean)
        best, is_open = before, False
        chosen = [score.correction for score in tried[-TRIED:]]
        if any(each.changes for each in chosen):
            as_sized = yield from self.score(AS_SIZED)
        for each in chosen:
            score = yield from self.score(each, before)
            if score.is_hopeless:
                continue
            rival = as_sized if each.changes else before
            is_better = score.is_clearly_better(rival)
            # In a frame of its own, where no map contradicts it, nothing is compared with the map.
            least_share = max(0.0, before.localised_share - 0.1)
            is_in_map = self.known is None or score.localised_share > least_share
            if is_better and is_in_map and score.mean > best.mean:
                best = score
            gain = score.likelihood.count * (score.mean - rival.mean)
            is_open |= is_in_map and not is_better and gain > LIKELIER
        if best.correction.kind == 'tag_size':
            # The size by what a survey, or else the wheels, makes of ranges
            rough = best.correction
            by_wheels = replace(rough, changes={'linear_scale_stddev': (ROUGHLY, 0.0, 0.0)})
            by_survey = replace(rough, changes=SIZED | {'range_scale_stddev': ROUGHLY})
            score = yield from self.score(by_wheels if self.known is None else by_survey)
            found_out = {each.name.partition('/')[0]: each.value for each in score.calibration}
            factor = 1.0 / found_out.get('linear_scale_x', 1.0)
            if self.known is not None:
                factor = found_out.get('range_scale', 1.0)
            best = replace(best, correction=replace(rough, points=factor * rough.points))
        return best, is_open and best is before

    def _findings(self, correction: Correction) -> list[Finding]:
        if correction.kind == 'tag_size':
            by = 'the wheels' if self.known is None else 'the map'
            return [found('tag_size', factor=correction.scale(), by=by)]
        # Mirror images are what a map alone sets apart.
        alike = [kinds for kinds in ALIKE if correction.kind in kinds]
        alike = [kinds for kinds in alike if self.known is None or kinds != MIRRORED]
        return [found(kind) for kind in sorted(*alike or [{correction.kind}])]

    def score(self, correction: Correction, rival: _Score | None = None) -> Steps[_Score]:
        """Run a filter that believes a correction; given up once it is worse than a rival."""
        settings = replace(self.settings, **correction.changes)
        k, scale = axes_of(settings.two_d_mode).point, correction.scale()
        reach = max(
            float(np.abs(each.points).max(initial=0.0))
            for each in self.events
            if isinstance(each, ObservationEvent)
        )
        recorder, attitudes = LikelihoodRecorder(k, scale * reach), [np.eye(3)]
        localised: list[bool] = []

        def note_update(update: Update) -> None:
            recorder.note_update(update)
            attitudes.append(update.pose[:3, :3])
            localised.append(estimator.is_localised)

        def so_far(is_hopeless: bool = False) -> _Score:
            R = np.array(attitudes)
            return _Score(
                correction,
                recorder.likelihood,
                k * math.log(scale),
                float(np.linalg.norm(so3.log(R[min(1, len(R) - 1)].T @ R), axis=1).max()),
                estimator.calibration,
                sum(localised) / max(len(localised), 1),
                is_hopeless,
            )

        estimator = Estimator(settings, on_update=note_update, judges_innovations=True)
        if self.known is not None:
            estimator.load_map(self.known)
        noise = ObservationNoise(settings) if correction.kind == 'tag_size' else None
        checked_ns = self.events[0].stamp_ns
        for event in correction.apply(in_blocks(self.events), noise):
            if isinstance(event, VelocityBlock):
                estimator.add_velocities(event)
            else:
                estimator.add(event)
                if rival is not None and event.stamp_ns > checked_ns + STRETCH_NS:
                    checked_ns = event.stamp_ns
                    if so_far().is_worse_so_far(rival, checked_ns):
                        return so_far(is_hopeless=True)
            yield
        estimator.flush()
        return so_far()


@dataclass(frozen=True, slots=True)
class _Score:
    """How likely points are, by what a filter expected of them that believes a correction.

    ``per_unit`` is added to ln densities: they are per unit of what was recorded.
    """

    correction: Correction
    likelihood: Likelihood
    per_unit: float
    turned_rad: float  # at most since the start, as it is seen
    calibration: Sequence[CalibrationEstimate]
    localised_share: float  # of the observations, in a loaded map
    is_hopeless: bool = False  # it was given up before its end

    @property
    def mean(self) -> float:
        """Ln of the density of a point, per unit of what was recorded."""
        return self.likelihood.mean + self.per_unit

    def is_clearly_better(self, other: _Score) -> bool:
        """Return whether points are much likelier by this one, and not for a few events' sake.

        Someone who carries the robot once makes a correction likelier that is wrong by and by.
        """
        count = min(self.likelihood.count, other.likelihood.count)
        if not self.mean - other.mean > max(CLEAR, SURE / count if count else math.inf):
            return False
        ends_ns = [each.likelihood.stamps_ns[[0, -1]] for each in (self, other)]
        edges = np.arange(np.min(ends_ns), np.max(ends_ns) + STRETCH_NS + 1, STRETCH_NS)
        (one, counts), (another, other_counts) = (each._stretches(edges) for each in (self, other))
        gains = np.clip(np.minimum(counts, other_counts) * (one - another), -SURE, SURE)
        least = THROUGHOUT * np.count_nonzero(gains) * np.square(gains).sum()
        return bool(gains.sum() > math.sqrt(least))

    def _stretches(self, edges_ns: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the mean, and how many observations with new errors, between stamps (m + 1,)."""
        of, shares = self.likelihood, self.likelihood.shares
        totals, counts = (
            np.histogram(of.stamps_ns, edges_ns, weights=weights)[0]
            for weights in (shares * (of.log_densities + self.per_unit), shares)
        )
        return totals / np.maximum(counts, np.finfo(float).tiny), counts

    def is_worse_so_far(self, other: _Score, stamp_ns: int) -> bool:
        """Return whether points up to a stamp are so unlikely that going on is in vain."""
        rival = other.until(stamp_ns)
        count = min(self.likelihood.count, rival.likelihood.count)
        return count * (rival.mean - self.mean) > SURE

    def until(self, stamp_ns: int) -> _Score:
        """Return how likely points were up to a stamp."""
        part = self.likelihood.select(self.likelihood.stamps_ns <= stamp_ns)
        return replace(self, likelihood=part)
