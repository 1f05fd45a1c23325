"""What the log says of events, at the 1st, the 10th, the 100th time that it happens."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
import logging

from slam_observer_ros.common.findings import found
from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND
from slam_observer_ros.common.types import IntArray
from slam_observer_ros.observer.gains import Gains
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.parameter_table import changed_names

logger = logging.getLogger(__name__)

MAX_NAMED = 10
"""Ids that a warning lists at most."""

MANY_LANDMARKS = 300
"""Landmarks of a dense covariance from which on a step takes 20 ms and more."""

MANY_MOVED = 5
"""Landmarks that seem to have moved lately from which on the odometry may be at fault."""

MOVED_LATELY_NS = 60 * NANOSECONDS_PER_SECOND
"""How long ago that is at most, nanoseconds."""

UNEXPECTED_POSES = ('slip', 'unexpected_place', 'doubled_landmark')
"""Counts that grow when something is wrong with the robot's pose."""


class EventWarnings:
    """Counts findings of each kind, and logs them more and more seldom."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._reported: Counter[str] = Counter()
        self._moved_ns: dict[int, int] = {}

    def warn(self, kind: str, counted_as: str = '', **figures: object) -> None:
        """Count one more of a kind of finding; it is logged if there are 1, 10, 100 and so on."""
        self._counts[counted_as or kind] += 1
        count = self._counts[counted_as or kind]
        if str(count).rstrip('0') == '1':
            logger.warning('%s', found(kind, **figures).text(f' ({count} so far)'))

    def large_map(self, count: int, limit: int, gains: Gains) -> None:
        """Say once that a map is full, with 0 < ``limit``, and that its ``gains`` take long."""
        if 0 < limit <= count:
            self._warn_once('full_map', count=count, limit=limit)
        if count >= MANY_LANDMARKS and gains.takes_all:
            self._warn_once('large_map', count=count)

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

    def unexpected_poses(self, counts: Sequence[int]) -> None:
        """Warn that the robot is not where it was taken to be, if one of these has grown."""
        for name, count in zip(UNEXPECTED_POSES, counts, strict=True):
            if count > self._reported.get(name, 0):
                self.warn(name)
                self._reported[name] = count

    def unused_settings(self, settings: Settings, gains: Gains) -> None:
        """Name settings that have been changed and have no effect."""
        changed = set(changed_names(settings))
        if unused := [name for name in gains.ignores if name in changed]:
            names = ', '.join(unused)
            logger.warning('%s', found('ignored_settings', gains=settings.gains, names=names))
        is_ignored = 'use_tag_orientation' in gains.ignores
        if settings.use_tag_orientation and gains.tags is None and not is_ignored:
            logger.warning('%s', found('ignored_orientations'))
        is_given = any(settings.initial_position) or settings.initial_yaw != 0.0
        if is_given and not settings.set_initial_pose:
            logger.warning('%s', found('ignored_start'))

    def _warn_once(self, kind: str, **figures: object) -> None:
        self._counts[kind] += 1
        if self._counts[kind] == 1:
            logger.warning('%s', found(kind, **figures).text())


def listed(ids: Iterable[int]) -> str:
    """Return the first few ids, as a sentence names them."""
    every = [str(landmark_id) for landmark_id in ids]
    return ', '.join(every[:MAX_NAMED]) + (' and others' if len(every) > MAX_NAMED else '')
