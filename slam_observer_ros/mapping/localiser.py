"""Decides when the estimate enters a loaded map, or one of several, and when it is lost there."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
import logging
import math
from typing import TYPE_CHECKING

import numpy as np

from slam_observer_ros.common.findings import Finding, found
from slam_observer_ros.common.types import FloatArray, is_automatic
from slam_observer_ros.estimates import Update
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.mapping.map_alignment import (
    AlikeMaps,
    Differences,
    likeness_by_ids,
    pose_by_tag,
    TagPose,
)
from slam_observer_ros.mapping.merging import enter_map, start_in_map
from slam_observer_ros.tracking.state import State
from slam_observer_ros.tracking.waiting_room import Window

if TYPE_CHECKING:
    from slam_observer_ros.mapping.finder import Finder
    from slam_observer_ros.mapping.half_finder import Fix, HalfFinder
    from slam_observer_ros.mapping.places import Place

logger = logging.getLogger(__name__)

# Share of the observations that is new when the same landmarks are compared with a map again: with
# many of them that takes long, and a single further observation seldom decides it.
NEWS = 0.1
CONFIRMING_VOTES = 10  # observations that confirm a pose that was given
MAX_NAMED = 3

# Standard deviations of a given pose, rad and m, beyond which points can't be matched by where
# they are: the map is then searched as if the pose was not known at all.
ROUGH_STD = np.repeat([0.5, 1.0], 3)

# ln of how much likelier a point is where the robot is lost, if the map does not explain it, and
# if it does: then 7 points in 10 are of nothing known, else 1 in 10.
MISSING, EXPLAINED = 1.95, -1.1
MAX_STEP = 3.0  # what an observation may say at most: its points have errors in common
LIMIT = 8.0  # sum at which the robot is lost

# Observations in a row, and for how long, that reject all that a fixed map has there. By then it
# is no garbled message any more: behaviour trees ask within a second.
CONTRADICTED_TIMES, CONTRADICTED_NS = 3, 500_000_000
STRAYED_NS = 2_000_000_000  # a pose is doubted that landmarks contradict, too few to find it


class Localiser:
    """Follows whether the estimate is in the frame of a map that was loaded."""

    def __init__(self) -> None:
        self.maps: list[LandmarkMap] = []  # the robot is in one of them
        self.loaded: LandmarkMap | None = None  # that one, once it is known
        self._alike = AlikeMaps([], likeness_by_ids)
        self.is_localised = True  # in the final frame: always, unless a map was loaded
        self.counts: Counter[str] = Counter()  # 'not_localised' observations, poses 'lost'
        self._trial: PoseTrial | None = None
        self._observations = self._compared_at = self._shared = 0  # as :meth:`search` counts
        self._finder: Finder | None = None
        self._half_finder: HalfFinder | None = None
        self._rough: tuple[FloatArray, FloatArray] | None = None
        self._unexplained = Unexplained()
        self._contradiction = Contradiction()
        self._differences: Differences | None = None
        self._said_problem = False
        self._tag: int | None = None  # which the pose was taken from that is on trial
        self._refused: set[int] = set()  # tags whose poses were wrong

    def load(self, maps: Sequence[LandmarkMap], two_d_mode: bool) -> None:
        """Take maps instead of those loaded before; the pose in one of them is yet to be found."""
        self.maps = [known.flattened() if two_d_mode else known for known in maps]
        if any(known.is_planar for known in maps) and not two_d_mode:
            logger.warning('%s', found('flat_map'))
        self._alike = AlikeMaps(self.maps, likeness_by_ids)
        self._refused = set()
        self._search_again()

    def start(
        self,
        state: State,
        pose_is_given: bool,
        covariance: FloatArray | None,
        known: LandmarkMap | None,
    ) -> None:
        """Take a state at its start, in a loaded map if its pose there is given.

        ``covariance`` (6, 6) belongs to the given pose; None for an exact one. ``known`` is the
        map that it is in, if there are several.
        """
        self._search_again()
        self.is_localised = not self.maps or pose_is_given
        if known is not None:
            self.loaded = known
        if self.loaded is not None and pose_is_given:
            start_in_map(state, self.loaded, covariance)
            self._trial = PoseTrial(self.loaded)

    def doubt_pose(self) -> None:
        """Put a pose that was given on trial."""
        self._trial = None if self.loaded is None else PoseTrial(self.loaded)

    def _search_again(self) -> None:
        """Take the pose in the map for unknown, and forget what was seen."""
        self.is_localised = False
        self.loaded = self.maps[0] if len(self.maps) == 1 else None
        self._trial = self._finder = self._half_finder = self._rough = self._tag = None
        self._said_problem = False
        self._observations = self._compared_at = self._shared = 0
        self._unexplained, self._contradiction = Unexplained(), Contradiction()
        self._differences = None

    @property
    def is_contradicted(self) -> bool:
        """Whether what is seen of a map contradicts the pose, at once or view by view."""
        return self._contradiction.lasts or self._contradiction.is_doubted

    def doubt_strayed(self, state: State, update: Update, shows_turn: bool) -> None:
        """Doubt a pose which the last views contradict together, if they do not find it either."""
        if len(update.ids) < state.axes.point:
            self.counts['contradicted_pose'] += not self.is_contradicted
            self._contradiction.doubt(update.stamp_ns, shows_turn)

    def may_be_rough(self, event: ObservationEvent) -> bool:
        """Return whether points without ids are to be matched by a pose just given."""
        is_untried = self._trial is not None and self._trial.is_untried
        return is_untried and bool((event.ids == UNKNOWN_ID).any())

    def search_near(self, pose: FloatArray, covariance: FloatArray) -> None:
        """Search about a pose (4, 4) of the state at its start, with a covariance (6, 6)."""
        self._rough = pose, covariance
        logger.info('Searching %s about the pose that was given.', self._where)

    def reason_to_reset(
        self, state: State, event: ObservationEvent, update: Update, missed: float
    ) -> str | None:
        """Return why the pose must be wrong; ``missed`` landmarks should have been seen, too."""
        if self.loaded is None:
            return None
        is_elsewhere = False
        if self.is_localised and not state.is_mapping:
            # Enough of a map that does not change says so, one after the other.
            self._contradiction.confirm(update.ids[~update.rejected].tolist(), state.axes.point)
            if self._contradiction.begins(update):
                self.counts['contradicted_pose'] += 1
                logger.warning('%s', found('contradicted_pose'))
            is_elsewhere = self._contradiction.is_by(
                state.axes.point, state.settings.max_rejections
            )
        reason = None
        if self._trial is not None and self._trial.vote(update, state.settings.max_rejections):
            reason = 'most landmarks contradict the pose that was given'
            if self._tag is not None:
                reason = f'most landmarks contradict the pose that tag {self._tag} gave'
                self._refused.add(self._tag)
        elif is_elsewhere or (self.is_localised and is_lost(state)):
            reason = 'all landmarks are far from where they should be'
        elif self.is_localised and self._unexplained.is_too_much(state, event, missed):
            reason = 'most of what is seen is not in the map'
        elif self.is_localised and len(self.maps) > 1:
            if self._differences is None:
                self._differences = Differences(self.loaded, self.maps)
            if name := self._differences.note(state, event):
                reason = f'what is seen is as in the map {name}'
        self.counts['lost'] += reason is not None
        return reason

    def search(self, state: State) -> bool:
        """Enter the map after an observation, if it is time to compare; return whether it did."""
        if self.is_localised:
            return False
        ids = np.concatenate([known.ids for known in self.maps])
        shared = int(np.sum(state.landmarks.rows_of(ids) >= 0))
        self._observations += 1
        if shared != self._shared or self._observations >= (1.0 + NEWS) * self._compared_at:
            self._shared, self._compared_at = shared, self._observations
            self.enter(state)
        if not self.is_localised:
            self._find(state)
        self.counts['not_localised'] += not self.is_localised
        return self.is_localised

    def pose_by_tag(self, state: State) -> TagPose | None:
        """Return the pose in the map by a single tag, where it is not known; None if none is."""
        known = None if self.is_localised else self._named(state)
        return None if known is None else pose_by_tag(state, known, self._refused)

    def try_tag(self, tag_id: int) -> None:
        """Note that the pose on trial was given by a tag."""
        self._tag = tag_id
        logger.info('Found the pose in the map by tag %d.', tag_id)

    def pose_by_half_points(self, state: State, window: Window) -> Fix | None:
        """Return where the robot is by half points alone; None if known, or not one place fits."""
        if self.is_localised or not window.views:
            return None
        from slam_observer_ros.mapping.half_finder import HalfFinder  # which few runs need

        if self._half_finder is None:
            self._half_finder = HalfFinder(self.maps)
        fix, finder = self._half_finder.find(state, window), self._half_finder
        if fix is not None:
            logger.info('Found the pose in the map by %d half points.', len(window.views))
        elif (finder.rivals or finder.in_a_line) and not self._said_problem:
            self._said_problem = True
            logger.warning('%s', self.problem(state))
        return fix

    @property
    def places(self) -> list[Place]:
        """Where in the map the robot's own frame may be, the most likely place first."""
        finder = self._finder
        return [] if finder is None or finder.places is None else finder.places.all

    @property
    def likely_places(self) -> list[Place]:
        """The places that are worth to be named, the most likely first."""
        finder = self._finder
        return [] if finder is None or finder.places is None else finder.places.likely

    def problem(self, state: State) -> Finding | None:
        """Return why the pose in the map is not known; None if it is."""
        if self.is_localised:
            return None
        if self._finder is not None:
            self._finder.compare_ids(state)
        if (finder := self._half_finder) is not None and finder.in_a_line:
            ids = ', '.join(str(landmark_id) for landmark_id in finder.in_a_line)
            return found('anchors_in_a_line', ids=ids)
        if finder is not None and finder.rivals:
            fits = ' and '.join(_where(pose) for pose in finder.rivals[:MAX_NAMED])
            return found(
                'drive_a_curve', number=len(finder.rivals), where=self._where, places=fits
            )
        places = self.likely_places
        if self._finder is not None and self._finder.contradiction is not None:
            return self._finder.contradiction
        if not places:
            return found('no_place', where=self._where)
        maps = [place.map_index for place in places]
        looks = AlikeMaps([], likeness_by_ids) if self._finder is None else self._finder.alike
        if alike := self._alike.among(maps) or looks.among(maps):
            return alike
        named = [_where(place.transform @ state.observer.A) for place in places[:MAX_NAMED]]
        if len(self.maps) > 1:
            named = [f'{at} in {self.maps[i].name}' for at, i in zip(named, maps, strict=False)]
        fits = ' and '.join(named)
        if len(places) > MAX_NAMED:
            fits += f' and {len(places) - MAX_NAMED} more'
        elif len(places) == 1:
            fits += f', right with a probability of {places[0].share:.2f}'
        number = f'{len(places)} places' if len(places) > 1 else 'one place'
        return found('ambiguous_place', number=number, where=self._where, places=fits)

    def _find(self, state: State) -> None:
        """Find the pose by landmarks without ids."""
        if not len(self.maps[0].ids) or state.errors is None:
            return
        if self._finder is None:
            from slam_observer_ros.mapping.finder import Finder  # which few runs need

            self._finder = Finder(self.maps, state, self._rough)
        fit, places = self._finder.find(state), self._finder.places
        if fit is not None and places is not None and enter_map(state, *fit):
            self.loaded, (rows, _) = fit
            self.is_localised = True
            logger.info(
                'Found the pose in the map%s by %d of %d landmarks (wrong with a probability of '
                '%.0e).',
                f' {self.loaded.name}' if len(self.maps) > 1 else '',
                len(rows),
                len(places.all[0].rows),
                places.error_probability,
            )
        elif not self._said_problem and len(self.likely_places) > 1:
            self._said_problem = True
            finding = self.problem(state)
            if finding is not None and finding.kind == 'ambiguous_place':  # others are known
                logger.warning('%s', finding)

    def enter(self, state: State) -> bool:
        """Move an estimate into the frame of a loaded map, if landmarks with ids suffice."""
        known = self._named(state)
        if known is not None and enter_map(state, known):
            self.loaded, self.is_localised = known, True
            name = f'{known.name} ' if len(self.maps) > 1 else ''
            logger.info('Found the pose in the map %sof %d landmarks.', name, len(known.ids))
        return self.is_localised

    def _named(self, state: State) -> LandmarkMap | None:
        """Return the only map, or the only one of several that has any of the ids seen."""
        if len(self.maps) == 1:
            return self.maps[0]
        ids = state.landmarks.ids
        seen = ids[~is_automatic(ids)]
        named = [known for known in self.maps if np.isin(seen, known.ids).any()]
        return named[0] if len(named) == 1 else None

    @property
    def _where(self) -> str:
        """What is searched, in words."""
        return 'the map' if len(self.maps) == 1 else f'the {len(self.maps)} maps'


def _where(pose: FloatArray) -> str:
    """Return where a pose (4, 4) is, in words."""
    x, y = pose[:2, 3]
    return f'({x:.1f} m, {y:.1f} m, {math.atan2(pose[1, 0], pose[0, 0]):.2f} rad)'


def is_lost(state: State) -> bool:
    """Return whether the pose in a map has been wrong for some time, or the robot was carried.

    All landmarks seen of late were rejected then, and as many as would do to find the pose again
    so often that elsewhere they would be taken to have moved.
    """
    often = state.settings.max_rejections
    moved = np.sum(state.landmarks.rejections >= often)
    needed = state.axes.point
    return bool(not state.is_mapping and state.rejected_in_a_row >= often and moved >= needed)


def is_rough(covariance: FloatArray) -> bool:
    """Return whether points without ids can't be matched by a pose with a covariance (6, 6)."""
    return bool((np.diagonal(covariance) > ROUGH_STD**2).any())


class PoseTrial:
    """A pose in a map that someone has given, on trial until landmarks of the map confirm it.

    With a wrong one the map's landmarks would be rejected, and where mapping goes on be taken to
    have moved, all of them. Observations vote: against it, if more of the map's landmarks in them
    were rejected than accepted. One alone may be garbled, and some landmarks have moved.
    """

    def __init__(self, known: LandmarkMap) -> None:
        self._ids = known.ids
        self._for = self._against = 0

    @property
    def is_untried(self) -> bool:
        """Whether no observation has voted yet."""
        return self._for == self._against == 0

    def vote(self, update: Update, often: int) -> bool:
        """Count the vote of an observation; return whether ``often`` ones say it is wrong."""
        if self._for >= CONFIRMING_VOTES and self._for > self._against:
            return False
        rejected = int(np.isin(update.ids[update.rejected], self._ids).sum())
        accepted = int(np.isin(update.ids, self._ids).sum()) - rejected
        self._for += int(accepted > 0 and accepted >= rejected)
        self._against += int(rejected > accepted)
        return self._against >= often and self._against > self._for


class Contradiction:
    """Whether all landmarks of a map that are seen are rejected, for more than a moment.

    Then the pose is wrong, or somebody has moved the few that are in view. One that was rejected
    beside others that were where they should be has moved, and says nothing of the pose.
    """

    def __init__(self) -> None:
        self._moved: set[int] = set()
        self._rejected: set[int] = set()  # since any was accepted
        self._times = self._since_ns = self._last_ns = self._doubted_until_ns = 0
        self._is_ambiguous, self._confirming = False, set[int]()

    def doubt(self, stamp_ns: int, shows_turn: bool) -> None:
        """Doubt the pose, as few landmarks contradict it.

        By one point alone the robot may be anywhere around it, once it was moved: if it
        contradicts the pose again, the doubt lasts until others are where they should be. A tag
        that ``shows_turn`` finds the pose.
        """
        self._is_ambiguous = self._is_ambiguous or (self.is_doubted and not shows_turn)
        self._doubted_until_ns, self._confirming = stamp_ns + STRAYED_NS, set()

    def confirm(self, ids: list[int], needed: int) -> None:
        """Doubt it no more once so many landmarks were accepted since, ``ids`` just now."""
        self._confirming.update(ids)
        if len(self._confirming) >= needed:
            self._is_ambiguous, self._doubted_until_ns, self._confirming = False, 0, set()

    @property
    def is_doubted(self) -> bool:
        """Whether it was contradicted by few landmarks lately, and nothing has confirmed it."""
        lately = 0 < self._doubted_until_ns - self._last_ns <= STRAYED_NS
        return lately or self._is_ambiguous

    @property
    def lasts(self) -> bool:
        """Whether that is so now."""
        is_long = self._last_ns - self._since_ns >= CONTRADICTED_NS
        return is_long and self._times >= CONTRADICTED_TIMES

    def is_by(self, landmarks: int, often: int) -> bool:
        """Return whether so many landmarks contradict the pose, each so often in the mean.

        Where one is in view at a time, as of codes on a floor, each is seen a few times and left
        behind: none is rejected as often as :func:`is_lost` asks of each.
        """
        return len(self._rejected) >= landmarks and self._times >= landmarks * often

    def begins(self, update: Update) -> bool:
        """Take what an observation has shown; return whether it begins to be so by that."""
        lasted = self.lasts
        rejected = set(update.ids[update.rejected].tolist())
        accepted = set(update.ids[~update.rejected].tolist())
        if accepted:
            self._moved = (self._moved | rejected) - accepted
            self._times, self._rejected = 0, set()
        elif rejected - self._moved:
            if not self._times:
                self._since_ns = update.stamp_ns
            self._times += 1
            self._rejected |= rejected - self._moved
        self._last_ns = update.stamp_ns
        return self.lasts and not lasted


# Sightings from which on a landmark without an id explains a point, if the map has not had it: one
# that a carried robot adds must not at once.
FAMILIAR = 5


class Unexplained:
    """A cumulative sum of what observations say of a robot that was carried (E. S. Page, 1954)."""

    def __init__(self) -> None:
        self._sum = 0.0

    def is_too_much(self, state: State, event: ObservationEvent, missed: float) -> bool:
        """Add an observation, already used; return whether the pose must be wrong by now.

        Where the map grows points of nothing known are no sign of that, unless in place of them
        other landmarks should have been seen: ``missed``.
        """
        if not (event.ids == UNKNOWN_ID).any():
            return False
        landmarks = state.landmarks
        is_seen = (landmarks.last_seen_ns == event.stamp_ns) & ~landmarks.tentative
        is_seen &= (landmarks.born_ns < 0) | (landmarks.counts >= FAMILIAR)
        explained = int(np.count_nonzero(is_seen))
        missing: float = max(0, len(event.ids) - explained)
        if state.is_mapping:
            missing = min(missing, missed)
        step = MISSING * missing + EXPLAINED * explained
        self._sum = max(0.0, self._sum + min(max(step, -MAX_STEP), MAX_STEP))
        return self._sum > LIMIT
