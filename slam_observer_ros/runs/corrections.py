"""Which mistakes of a set-up there are: what makes each right again, and what else it explains.

And by which part of a drive they are judged.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations, groupby
import math
from typing import Any, TypeVar

import numpy as np

from slam_observer_ros.common.findings import Finding
from slam_observer_ros.common.stamps import to_ns, to_s
from slam_observer_ros.common.types import FloatArray
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
from slam_observer_ros.models.observation_noise import ObservationNoise

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

SIZED = {'linear_scale_stddev': (0.0, 0.0, 0.0)}
"""A wheel's scale that is estimated would make up for the size of tags."""

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

MISTAKES = frozenset({'no_turning', *(each.kind for each in CORRECTIONS)})
"""Kinds of finding that name a mistake of the set-up."""

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

SYMPTOMS = frozenset(
    {
        'rejected_points',
        'left_out_points',
        'unmapped_points',
        'unknown_pose',
        'no_place',
        'other_hall',
        'other_ids',
        'drive_a_curve',
        'lost_pose',
        'wrong_pose',
        'contradicted_pose',
        'diverged',
        'not_relinearised',
        'slip',
        'unexpected_place',
        'moved_landmark',
        'many_moved',
        'carried_landmark',
        'late_odometry',
        'implausible_calibration',
        'mounting',
        'range_scale',
        'depth_for_range',
        'noisy_odometry',
        'axis_noise',
        'motion_noise',
        'point_noise',
        'small_noise',
        'large_noise',
        'overconfident_pose',
        'error_growth',
    }
)
"""Findings that a mistake of the set-up may cause, and whose remedies would then be untrue."""

OF_ODOMETRY = frozenset(
    {
        'late_odometry',
        'implausible_calibration',
        'noisy_odometry',
        'axis_noise',
        'motion_noise',
        'small_noise',
    }
)
"""Those of them that speak of the delay and the noise of the odometry."""

_OF_POSE = frozenset(
    {
        *('unknown_pose', 'no_place', 'other_hall', 'other_ids'),
        *('lost_pose', 'contradicted_pose', 'diverged'),
    }
)

EXPLAINED: Mapping[str, frozenset[str]] = {
    **dict.fromkeys(MISTAKES, SYMPTOMS | {'rare_velocity'}),
    # Where the robot is must be known, whatever the reason.
    'several_publishers': (SYMPTOMS | MISTAKES | {'rare_velocity'}) - _OF_POSE,
    'rare_velocity': OF_ODOMETRY,
}
"""By the kinds of causes: which findings they explain, whose remedies would be untrue."""

ODOMETRY_CAUSES = frozenset(EXPLAINED) - MISTAKES
"""Causes while which nothing can be learnt of the odometry."""

SUSPICIOUS = SYMPTOMS - {'large_noise', 'error_growth', 'axis_noise', 'left_out_points'}
"""Those of them that are reason to look for one."""


def explained(findings: Iterable[Finding]) -> list[Finding]:
    """Return findings without those that another one of them explains."""
    findings = list(findings)
    known = {each.kind for each in findings}
    symptoms = {kind for cause in EXPLAINED.keys() & known for kind in EXPLAINED[cause]}
    # A symptom explains nothing in its turn.
    causes = known - symptoms
    symptoms = {kind for cause in EXPLAINED.keys() & causes for kind in EXPLAINED[cause]}
    return [each for each in findings if each.kind not in symptoms]


DRIVE_S, TURNED_RAD = 90.0, 4.0 * math.pi
"""Time of driving, and turns, that are looked at: who stands or goes straight on says little."""

MOST_S = 300.0
"""Time in all, at most."""


def first_drive(events: Iterable[Event], part: float = 1.0) -> list[Event]:
    """Return the events until the robot has driven for DRIVE_S, with points that have ids.

    Or until a ``part`` of that.
    """
    kept: list[Event] = []
    drive, first_ns = _Drive(), None
    for event in events:
        first_ns = event.stamp_ns if first_ns is None else first_ns
        is_enough = drive.driven_s > part * DRIVE_S and drive.turned_rad > part * TURNED_RAD
        if is_enough or event.stamp_ns - first_ns > part * to_ns(MOST_S):
            break
        if isinstance(event, ObservationEvent):
            usable = event.ids != UNKNOWN_ID
            if event.kinds is not None:
                usable &= event.kinds == POINT
            kept.append(event.select(usable))
            continue
        kept.append(event)
        if isinstance(event, VelocityEvent):
            drive.add(event)
    return kept


def in_blocks(events: Iterable[Event]) -> Iterator[Event | VelocityBlock]:
    """Yield events with the velocities that follow each other in blocks, which take less time."""
    for alike, group in groupby(events, key=_of_a_block):
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


def _of_a_block(event: Event) -> tuple[bool, bool, bool] | None:
    """Return what velocities of a block have in common; None for what is no velocity."""
    if not isinstance(event, VelocityEvent):
        return None
    return event.is_mean, event.covariance is None, event.receive_ns is None


def driven_s(events: Iterable[Event]) -> float:
    """Return for how long the robot drives in all, seconds."""
    return _driven(events).driven_s


def turned(events: Iterable[Event]) -> float:
    """Return by how much the velocities turn the robot in all, radians if they are in rad/s."""
    return _driven(events).turned_rad


class _Drive:
    """Sums up the velocities; one that is held for more than a second says nothing any more."""

    def __init__(self) -> None:
        self.driven_s, self.turned_rad = 0.0, 0.0
        self._last: VelocityEvent | None = None

    def add(self, event: VelocityEvent) -> None:
        if self._last is not None and self._last.body_velocity.any():
            held_s = min(to_s(max(event.stamp_ns - self._last.stamp_ns, 0)), 1.0)
            self.driven_s += held_s
            self.turned_rad += held_s * float(np.linalg.norm(self._last.body_velocity[:3]))
        self._last = event


def _driven(events: Iterable[Event]) -> _Drive:
    drive = _Drive()
    for event in events:
        if isinstance(event, VelocityEvent):
            drive.add(event)
    return drive


def never_turns(events: Iterable[Event]) -> bool:
    """Return whether the robot drives, and all its angular velocities are exactly zero."""
    drives = False
    for event in events:
        if isinstance(event, AngularVelocityEvent) and event.angular_velocity.any():
            return False
        if isinstance(event, VelocityEvent):
            if event.body_velocity[:3].any():
                return False
            drives |= bool(event.body_velocity.any())
    return drives
