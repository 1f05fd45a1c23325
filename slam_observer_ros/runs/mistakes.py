"""Which mistake of the set-up explains a recording better than that it is right.

Signs, units and frames: of each mistake the inverse is applied to the first minute and a half of
driving, and the points are judged by how likely the filter found them before it used them. A
density is per unit of length: with points that are multiplied by s it is s^k times as large per
unit of what was recorded, k being 2 in the plane and 3 in space.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
import logging
import math

import numpy as np

from slam_observer_ros.common.findings import Finding, found
from slam_observer_ros.common.stamps import to_ns, to_s
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import (
    AngularVelocityEvent,
    Event,
    ObservationEvent,
    UNKNOWN_ID,
    VelocityEvent,
)
from slam_observer_ros.geometry.axes import axes_of
from slam_observer_ros.known_map.landmark_map import LandmarkMap
from slam_observer_ros.runs.accuracy import LikelihoodRecorder
from slam_observer_ros.sensor_models.observation_noise import ObservationNoise
from slam_observer_ros.settings.estimator_settings import Settings

DRIVE_S, TURNED_RAD = 90.0, 4.0 * math.pi
"""Time of driving, and turns, that are looked at: who stands or goes straight on says little."""

MOST_S = 300.0
"""Time in all, at most."""

SURE, CLEAR = 15.0, 0.1
"""ln of how many times likelier all points must be, and each on average."""

NOTABLE_TURN = 2.0
"""Times the stated noise of turning that a robot which turns without saying so shows at least."""

_IDENTITY = np.eye(3)


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """What makes a recording right again that was made with a mistake of one kind."""

    kind: str  # of finding; '' if nothing is wrong
    points: FloatArray = field(default_factory=lambda: _IDENTITY)  # (3, 3), times each point
    turn: float = 1.0  # times the angular velocity
    drive: float = 1.0  # times the linear velocity

    def apply(
        self, events: Iterable[Event], noise: ObservationNoise | None = None
    ) -> Iterable[Event]:
        """Yield the events as they should have been recorded.

        With ``noise`` points keep theirs, as a share of their distance: else a world that shrinks
        would be likelier where noise is stated too large.
        """
        scales = np.repeat([self.turn, self.drive], 3)
        for event in events:
            if isinstance(event, ObservationEvent):
                covariances = event.covariances if noise is None else noise.covariances(event)
                if covariances is not None:
                    covariances = self.points @ covariances @ self.points.T
                yield replace(
                    event,
                    points=event.points @ self.points.T,
                    covariances=covariances,
                    orientations=None,
                    orientation_covariances=None,
                )
            elif isinstance(event, VelocityEvent):
                yield replace(event, body_velocity=scales * event.body_velocity)
            else:
                yield replace(event, angular_velocity=self.turn * event.angular_velocity)

    def scale(self) -> float:
        """Return by what lengths are multiplied."""
        return float(abs(np.linalg.det(self.points)) ** (1.0 / 3.0))


OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""From a camera's axes, z forward and x to the right, to a robot's."""

AS_IT_IS = Correction('')

CORRECTIONS = (
    Correction('points_in_optical_axes', OPTICAL),
    Correction('points_mirrored', np.diag([1.0, -1.0, 1.0])),
    Correction('points_backwards', np.diag([-1.0, -1.0, 1.0])),
    Correction('points_in_millimetres', 1e-3 * _IDENTITY),
    *(Correction('tag_size', s * _IDENTITY) for s in (0.5, 0.67, 0.8, 1.25, 1.5, 2.0)),
    Correction('turning_in_degrees', turn=math.radians(1.0)),
    Correction('speed_in_kmh', drive=1.0 / 3.6),
    Correction('turning_negated', turn=-1.0),
    Correction('driving_negated', drive=-1.0),
)

ALIKE = ({'points_mirrored', 'turning_negated'}, {'points_backwards', 'driving_negated'})
"""Mirror images of each other, and what differs by which end of the robot is its front."""

LEAST_TURN_RAD = 1.0
"""Turn in all that must be left of an angular velocity which is taken for one in degrees."""


def mistakes(
    settings: Settings, events: Sequence[Event], known: LandmarkMap | None = None
) -> list[Finding]:
    """Name the mistake of the set-up that explains what was recorded; none if it is right.

    Points without ids, whose meaning depends on the set-up, are left out. ``known`` is a map that
    the robot was in.
    """
    log = logging.getLogger('slam_observer_ros')
    level = log.level
    log.setLevel(logging.CRITICAL)  # what is wrong with a trial is no news
    try:
        return _named(settings, first_drive(events), known)
    finally:
        log.setLevel(level)


def _named(
    settings: Settings, events: Sequence[Event], known: LandmarkMap | None
) -> list[Finding]:
    seen = [event for event in events if isinstance(event, ObservationEvent)]
    if not any(len(event.ids) for event in seen):
        return []
    reach = float(np.max([np.abs(event.points).max(initial=0.0) for event in seen]))
    settings = replace(
        settings,
        gains='riccati',
        reorder_window=0.0,
        use_tag_orientation=False,
        max_hypotheses=1,
        relinearization_interval=0,
    )
    before = _Score(settings, events, AS_IT_IS, reach, known)
    if never_turns(events) and before.turning_factor > NOTABLE_TURN:
        return [found('no_turning')]
    scores = [
        _Score(settings, events, each, reach, known)
        for each in CORRECTIONS
        if each.kind != 'turning_in_degrees' or each.turn * turned(events) > LEAST_TURN_RAD
    ]
    better = [score for score in scores if score.is_clearly_better(before)]
    if not better:
        return []
    best = max(better, key=lambda score: score.mean).correction
    if best.kind == 'tag_size':
        return [found('tag_size', factor=best.scale())]
    kinds = next((alike for alike in ALIKE if best.kind in alike), {best.kind})
    return [found(kind) for kind in sorted(kinds)]


def turned(events: Iterable[Event]) -> float:
    """Return by how much the velocities turn the robot in all, radians if they are in rad/s."""
    total, last = 0.0, None
    for event in events:
        if isinstance(event, VelocityEvent):
            if last is not None:
                held_s = min(to_s(max(event.stamp_ns - last.stamp_ns, 0)), 1.0)
                total += held_s * float(np.linalg.norm(last.body_velocity[:3]))
            last = event
    return total


def first_drive(events: Sequence[Event]) -> list[Event]:
    """Return the events until the robot has driven for DRIVE_S, with points that have ids."""
    kept: list[Event] = []
    driven_ns, turned_rad, last, first_ns = 0, 0.0, None, None
    for event in events:
        first_ns = event.stamp_ns if first_ns is None else first_ns
        is_enough = driven_ns > to_ns(DRIVE_S) and turned_rad > TURNED_RAD
        if is_enough or event.stamp_ns - first_ns > to_ns(MOST_S):
            break
        if isinstance(event, ObservationEvent):
            kept.append(event.select(event.ids != UNKNOWN_ID))
            continue
        kept.append(event)
        if isinstance(event, VelocityEvent):
            if last is not None and last.body_velocity.any():
                held_ns = min(max(event.stamp_ns - last.stamp_ns, 0), to_ns(1.0))
                driven_ns += held_ns
                turned_rad += to_s(held_ns) * float(np.linalg.norm(last.body_velocity[:3]))
            last = event
    return kept


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


class _Score:
    """How likely points are, by what a filter expected of them that believes a correction."""

    def __init__(
        self,
        settings: Settings,
        events: Sequence[Event],
        correction: Correction,
        reach: float,
        known: LandmarkMap | None,
    ) -> None:
        self.correction = correction
        k, scale = axes_of(settings.two_d_mode).point, correction.scale()
        recorder = LikelihoodRecorder(k, scale * reach)
        estimator = Estimator(settings, on_update=recorder.note_update, judges_innovations=True)
        if known is not None:
            estimator.load_map(known)
        keeps_noise = correction.kind == 'tag_size'
        noise = ObservationNoise(settings) if keeps_noise else None
        for event in correction.apply(events, noise):
            estimator.add(event)
        estimator.flush()
        factors = {each.name: each.factor for each in estimator.motion_factors}
        self.turning_factor = factors.get('turning', 1.0)
        likelihood = recorder.likelihood
        # ln of the density per unit of what was recorded, and of how many points with new errors
        self.mean, self.weight = likelihood.mean + k * math.log(scale), likelihood.count

    def is_clearly_better(self, other: _Score) -> bool:
        """Return whether points are much likelier by this one."""
        gain = self.mean - other.mean
        return gain > CLEAR and gain * min(self.weight, other.weight) > SURE
