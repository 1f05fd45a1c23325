"""What the log says of events, at the 1st, the 10th, the 100th time that it happens."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
import logging

from slam_observer_ros.common.errors import InvalidEventError
from slam_observer_ros.common.types import IntArray
from slam_observer_ros.common.units import NANOSECONDS_PER_SECOND
from slam_observer_ros.events import FIRST_AUTOMATIC_ID, LAST_AUTOMATIC_ID

logger = logging.getLogger(__name__)

MAX_NAMED = 10
"""Ids that a warning lists at most."""

MANY_LANDMARKS = 300
"""Landmarks of a dense covariance from which on a step takes 20 ms and more."""

MANY_POINTS = 300
"""Points in one observation from which on these gains take a tenth of a second and more."""

MANY_MOVED = 5
"""Landmarks that seem to have moved lately from which on the odometry may be at fault."""

MOVED_LATELY_NS = 60 * NANOSECONDS_PER_SECOND
"""How long ago that is at most, nanoseconds."""

UNEXPECTED_POSES = {
    'slip': 'Odometry does not explain what is seen: the robot slipped or was carried, or the '
    'stated noise of its velocity is too small',
    'unexpected_place': 'Nothing that is seen is where the map has it: if the robot slipped or '
    'was carried, without ids it is found again in a loaded map only',
    'doubled_landmark': 'A landmark without an id was added where a known one should be seen and '
    'is not: that one was moved, or it is in the map twice now, as the stated noise of the '
    'velocity or of the points is too small',
}
"""What is wrong with the robot's pose when these counts grow."""


class EventWarnings:
    """Counts what there is to warn of, and logs it more and more seldom."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._reported: Counter[str] = Counter()
        self._moved_ns: dict[int, int] = {}

    def dropped(self, error: InvalidEventError) -> None:
        """Warn that a message is not used, and why."""
        self._warn(error.reason, f'Dropped a message, {error.reason}: {error}')

    def late_velocity(self) -> None:
        """Warn that a velocity came too late to be put in order."""
        text = 'A velocity came later than reorder_window allows and counts only from then on'
        self._warn('late_velocity', text)

    def repeated_ids(self, ids: Sequence[int]) -> None:
        """Warn that an observation has several points of each of these ids."""
        text = f'Not used: an observation has several points of the ids {_list(ids)}'
        self._warn('repeated_id', text)

    def reserved_ids(self, ids: Sequence[int]) -> None:
        """Warn that a sensor has ids which landmarks without one are given."""
        text = (
            f'Not used: points with the ids {_list(ids)}; those from {FIRST_AUTOMATIC_ID} to '
            f'{LAST_AUTOMATIC_ID} number landmarks without an id: give these others'
        )
        self._warn('reserved_id', text)

    def impossible_ids(self, count: int) -> None:
        """Warn that points of an observation have numbers in place of ids that can't be any."""
        text = f'Not used: {count} points of an observation, whose ids are fractional, below -1, '
        self._warn('impossible_id', f'{text}or more than their field holds')

    def unknown_ids(self, gains: str) -> None:
        """Warn that these gains can't use points without an id."""
        text = f'Points without an id are not used by {gains} gains, only by riccati'
        self._warn('unknown_id', text)

    def many_points(self, count: int) -> None:
        """Say once that one observation has so many points that riccati gains take long."""
        if count >= MANY_POINTS:
            self._warn_once(
                'many_points',
                f'An observation has {count} points: the time that riccati gains take grows with '
                'the cube of them, to seconds and a gigabyte for 1000. Let the sensor or its '
                'driver send fewer, or use constant gains.',
            )

    def unweighed_points(self, count: int, most: int) -> None:
        """Warn that one observation has more points than can be weighed without their ids."""
        text = (
            f'{count} points in one message, some of them or of the landmarks without an id: the '
            f'{most} with an id or nearest are used. Give ids, or send fewer points'
        )
        self._warn('unweighed_point', text)

    def large_map(self, count: int, limit: int, is_dense: bool) -> None:
        """Say once that a map is full, with 0 < ``limit``, and once that it takes long.

        That is where a joint covariance has all landmarks in it.
        """
        if 0 < limit <= count:
            self._warn_once(
                'full_map',
                f'The map has {count} landmarks, and max_landmarks is {limit}: from now on a new '
                'one replaces the one seen least often. If so many are right, set it higher; if '
                'not, look for ids that the sensor makes up.',
            )
        if is_dense and count >= MANY_LANDMARKS:
            self._warn_once(
                'large_map',
                f'The map has {count} landmarks. Where they move or have orientations, time and '
                'memory that riccati gains take grow with their square: 70 ms a step and 0.5 GB '
                'for 600 tags. max_landmarks limits them; use_tag_orientation: false takes a step '
                'of a large map back to that of a small one.',
            )

    def loaded_map(self, count: int, limit: int) -> None:
        """Say that a loaded map, to which new landmarks are added, will not be kept whole."""
        if 0 < limit < count:
            logger.warning(
                'The loaded map has %d landmarks, and max_landmarks is %d: those that are not '
                'seen make room for new ones. To keep them, set it higher, or '
                'localization_mode: uncertain.',
                count,
                limit,
            )

    def left_out_correlations(self, count: int) -> None:
        """Warn that a map to be saved is too large for correlations."""
        text = (
            f'Correlations between the {count} landmarks of the map are not saved, they are too '
            'many: where it is loaded their errors count as independent'
        )
        self._warn('left_out_correlations', text)

    def more_than_max(self, count: int, limit: int) -> None:
        """Warn that one observation has more landmarks than may be kept."""
        text = f'{count} points in one message, and max_landmarks is {limit}: some are always new'
        self._warn('more_than_max', text)

    def moved_landmarks(self, ids: IntArray, stamp_ns: int) -> None:
        """Warn that landmarks have moved, and, if many have lately, that odometry may be wrong."""
        self._warn('moved_landmark', f'Landmarks {ids.tolist()} have moved')
        moved_ns = self._moved_ns | dict.fromkeys(ids.tolist(), stamp_ns)
        # Those after this stamp are from before a jump of the clock.
        lately = {i: t for i, t in moved_ns.items() if 0 <= stamp_ns - t < MOVED_LATELY_NS}
        self._moved_ns = lately
        if len(lately) >= MANY_MOVED:
            self._moved_ns = {}
            text = (
                f'{len(lately)} landmarks seem to have moved within a minute: odometry may err by '
                'more than is stated. Look for a bias or scale that is larger than stated, or not '
                'estimated (angular_bias_stddev and the like), noise that is set too small, and '
                'time without messages (unknown_linear_motion, unknown_angular_motion)'
            )
            self._warn('many_moved', text)

    def carried_landmarks(self, ids: set[int]) -> None:
        """Warn of landmarks that move with the robot, whenever there are more of them."""
        if len(ids) > self._reported['carried_landmark']:
            logger.warning('Not used: landmarks %s move with the robot.', _list(sorted(ids)))
        self._reported['carried_landmark'] = len(ids)

    def unexpected_poses(self, count: Callable[[str], int]) -> None:
        """Warn that the robot is not where it was taken to be, if ``count`` says so again."""
        for name, text in UNEXPECTED_POSES.items():
            if count(name) > self._reported.get(name, 0):
                self._warn(name, text)
                self._reported[name] = count(name)

    def _warn_once(self, kind: str, text: str) -> None:
        self._counts[kind] += 1
        if self._counts[kind] == 1:
            logger.warning(text)

    def _warn(self, kind: str, text: str) -> None:
        """Count one more of a kind; ``text`` is logged if their number is a power of ten."""
        self._counts[kind] += 1
        count = self._counts[kind]
        if str(count).rstrip('0') == '1':
            logger.warning('%s (%d so far).', text, count)


def _list(ids: Sequence[int]) -> str:
    """Return the first few ids, as a sentence names them."""
    named = ', '.join(str(landmark_id) for landmark_id in ids[:MAX_NAMED])
    return named + (' and others' if len(ids) > MAX_NAMED else '')
