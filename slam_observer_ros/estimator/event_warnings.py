"""What the log says of events, at the 1st, the 10th, the 100th time that it happens."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
import logging
import math

import numpy as np

from slam_observer_ros.common.findings import Finding, found
from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import Update
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.filter.gains import Gains
from slam_observer_ros.lie import se3
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.parameter_table import changed_names
from slam_observer_ros.tracking.matching import is_contradiction, SAME_POSITION
from slam_observer_ros.tracking.state import State

logger = logging.getLogger(__name__)

MAX_NAMED = 10
"""Ids that a warning lists at most."""

MANY_LANDMARKS = 300
"""Landmarks of a dense covariance from which on a step takes 20 ms and more."""

MANY_MOVED = 5
"""Landmarks that seem to have moved lately from which on the odometry may be at fault."""

MOVED_LATELY_NS = 60 * NANOSECONDS_PER_SECOND
"""How long ago that is at most, nanoseconds."""

MOST_PLACES = 8
"""Places that are remembered of one id."""

RETURNED = 0.25
"""Share of the way to another place by which a landmark that is back may be off, as maps drift."""

UNEXPECTED_POSES = ('slip', 'unexpected_place', 'doubled_landmark')
"""Counts that grow when something is wrong with the robot's pose."""


class EventWarnings:
    """Counts findings of each kind, and logs them more and more seldom."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._reported: Counter[str] = Counter()
        self._moved_ns: dict[int, int] = {}
        self.two_places = TwoPlaces()

    def warn(self, kind: str, counted_as: str = '', **figures: object) -> None:
        """Count one more of a kind of finding; it is logged if there are 1, 10, 100 and so on."""
        self._counts[counted_as or kind] += 1
        count = self._counts[counted_as or kind]
        if str(count).rstrip('0') == '1':
            logger.warning('%s', found(kind, **figures).text(f' ({count} so far)'))

    def loaded_map(self, count: int, limit: int) -> None:
        """Say that a loaded map, to which new landmarks are added, will not be kept whole."""
        if 0 < limit < count:
            logger.warning('%s', found('loaded_map', count=count, limit=limit).text())

    def moved_landmarks(self, ids: IntArray, stamp_ns: int) -> None:
        """Warn that landmarks have moved, and, if many have lately, that odometry may be wrong."""
        self.warn('moved_landmark', ids=ids.tolist())
        moved_ns = self._moved_ns | dict.fromkeys(ids.tolist(), stamp_ns)
        # Those after this stamp are from before a jump of the clock.
        lately = {i: t for i, t in moved_ns.items() if 0 <= stamp_ns - t < MOVED_LATELY_NS}
        self._moved_ns = lately
        if len(lately) >= MANY_MOVED:
            self._moved_ns = {}
            self.warn('many_moved', count=len(lately))

    def carried_landmarks(self, ids: set[int]) -> None:
        """Warn of landmarks that move with the robot, whenever there are more of them."""
        if len(ids) > self._reported['carried_landmark']:
            logger.warning('%s', found('carried_landmark', ids=listed(sorted(ids))).text())
        self._reported['carried_landmark'] = len(ids)

    def of_state(self, counts: Sequence[int], landmarks: int, limit: int, gains: Gains) -> None:
        """Warn that the robot is not where it was taken to be, if one of ``counts`` has grown.

        Say once that a map of ``landmarks`` is full, with 0 < ``limit``, and that its ``gains``
        take long.
        """
        for name, count in zip(UNEXPECTED_POSES, counts, strict=True):
            if count > self._reported.get(name, 0):
                self.warn(name)
                self._reported[name] = count
                self.two_places.doubt(is_all=True)
        if 0 < limit <= landmarks:
            self._warn_once('full_map', count=landmarks, limit=limit)
        if landmarks >= MANY_LANDMARKS and gains.takes_all:
            self._warn_once('large_map', count=landmarks)

    def unused_settings(self, settings: Settings, gains: Gains) -> None:
        """Name settings that have been changed and have no effect."""
        changed = set(changed_names(settings))
        if unused := [name for name in gains.ignores if name in changed]:
            names = ', '.join(unused)
            logger.warning('%s', found('ignored_settings', gains=settings.gains, names=names))
        is_ignored = 'use_tag_orientation' in gains.ignores
        if settings.use_tag_orientation and gains.tags is None and not is_ignored:
            logger.warning('%s', found('ignored_orientations'))
        if any(settings.initial_pose) and not settings.set_initial_pose:
            logger.warning('%s', found('ignored_start'))

    def _warn_once(self, kind: str, **figures: object) -> None:
        self._counts[kind] += 1
        if self._counts[kind] == 1:
            logger.warning('%s', found(kind, **figures).text())


@dataclass(slots=True)
class _Sighted:
    """Where a landmark was seen that was rejected, in the world, metres."""

    places: list[FloatArray]  # (3,) one after the other, the first where it was known to be
    # By sensor: mean (3,) of the latest points in a row at one place, and how many there were.
    runs: dict[str, tuple[FloatArray, int]] = field(default_factory=dict)
    pending: FloatArray | None = None  # (3,) the next place, if the pose is right
    against: set[int] = field(default_factory=set)  # landmarks that say that it is not


class TwoPlaces:
    """Finds landmarks whose id is there twice: seen at one place, at another, and at the first.

    It counts as a place where a landmark is seen ``max_rejections`` times in a row, as it does to
    take one for moved. If it was rejected there, the pose may have been wrong instead: the other
    landmarks that are seen then, or next, decide that.
    """

    def __init__(self) -> None:
        self.sighted: dict[int, _Sighted] = {}
        self.findings: dict[int, Finding] = {}  # by id

    def doubt(self, *, is_all: bool) -> None:
        """Forget where landmarks seem to be as the pose was wrong; or all places, if it may be."""
        kept = {} if is_all else self.sighted
        self.sighted = {i: _Sighted(each.places) for i, each in kept.items()}

    def note(self, state: State, event: ObservationEvent, update: Update) -> None:
        """Take what an observation has shown, where points were rejected or some are sighted."""
        rejected = dict(zip(update.ids.tolist(), update.rejected.tolist(), strict=True))
        self._confirm({i: is_off for i, is_off in rejected.items() if i not in self.sighted})
        at = {i: k for k, i in enumerate(event.ids.tolist()) if i in rejected}
        points = se3.transform(update.pose, event.points)
        if len(rejected) > 1 and is_contradiction(update.rejected):
            return
        self._begin(state, update, {i: points[k] for i, k in at.items()})
        variances = np.trace(state.observation_noise.covariances(event), axis1=1, axis2=2)
        for i in self.sighted.keys() & at.keys():
            tolerance_m = SAME_POSITION * math.sqrt(variances[at[i]])
            often = state.settings.max_rejections
            seen = points[at[i]], event.sensor_frame
            self._follow(i, *seen, rejected[i], tolerance_m, often)

    def _confirm(self, are_off: Mapping[int, bool]) -> None:
        """Decide by other landmarks, that are rejected or not, whether the pose was right."""
        votes = len(are_off) - 2 * sum(are_off.values())
        for i, sighted in list(self.sighted.items()):
            if sighted.pending is None or not votes:
                continue
            if votes > 0:
                self._add(i, sighted.pending)
                continue
            sighted.against.update(other for other, is_off in are_off.items() if is_off)
            if len(sighted.against) > 1:  # a single one may be there twice, too
                del self.sighted[i]

    def _begin(self, state: State, update: Update, points: Mapping[int, FloatArray]) -> None:
        """Follow landmarks that are rejected for the first time, if they were known well."""
        landmarks, rows = state.landmarks, state.landmarks.rows_of(update.ids)
        for k in np.flatnonzero(update.rejected & (rows >= 0)).tolist():
            i, row = int(update.ids[k]), rows[k]
            is_known = landmarks.counts[row] >= state.settings.confirmations
            is_known |= landmarks.born_ns[row] < 0  # in a map that was loaded
            if is_known and i in points and i not in self.sighted:
                self.sighted[i] = _Sighted([points[i] - update.residuals[k]])

    def _follow(
        self,
        landmark_id: int,
        point: FloatArray,
        sensor: str,
        is_rejected: bool,
        tolerance_m: float,
        often: int,
    ) -> None:
        """Take one more point (3,) of a landmark, world, metres."""
        sighted = self.sighted[landmark_id]
        places = sighted.places
        if not is_rejected and len(places) == 1 and sighted.pending is None:
            sighted.runs.pop(sensor, None)
            if not sighted.runs:  # but an outlier
                del self.sighted[landmark_id]
            return
        pending = sighted.pending
        if pending is not None and not is_rejected:
            is_there = np.linalg.norm(point - pending) <= tolerance_m
            sighted.pending = pending if is_there else None  # it was the pose that was wrong
        mean, count = sighted.runs.get(sensor, (point, 0))
        if np.linalg.norm(point - mean) > tolerance_m:
            mean, count = point, 0
        count = min(count + 1, often)
        mean = mean + (point - mean) / count
        sighted.runs[sensor] = mean, count
        if count < often:
            return
        off_m = np.linalg.norm(mean - places[-1])
        if off_m > 2.0 * tolerance_m:
            sighted.pending = mean
            if not is_rejected:
                self._add(landmark_id, mean)

    def _add(self, landmark_id: int, place: FloatArray) -> None:
        """Note that a landmark is at a place; it is found if it has been there before."""
        sighted = self.sighted[landmark_id]
        sighted.pending, sighted.against, last = None, set(), sighted.places[-1]
        near_m = RETURNED * float(np.linalg.norm(place - last))
        before = sighted.places[:-1]
        has_returned = any(np.linalg.norm(place - each) <= near_m for each in before)
        sighted.places = [*sighted.places, place][-MOST_PLACES:]
        if has_returned and landmark_id not in self.findings:
            (x, y, z), (other_x, other_y, other_z) = place.tolist(), last.tolist()
            figures = {'other_x': other_x, 'other_y': other_y, 'other_z': other_z}
            finding = found('id_at_two_places', id=landmark_id, x=x, y=y, z=z, **figures)
            self.findings[landmark_id] = finding
            logger.warning('%s', finding)


def listed(ids: Iterable[int]) -> str:
    """Return the first few ids, as a sentence names them."""
    every = [str(landmark_id) for landmark_id in ids]
    return ', '.join(every[:MAX_NAMED]) + (' and others' if len(every) > MAX_NAMED else '')
