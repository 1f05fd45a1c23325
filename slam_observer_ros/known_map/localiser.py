"""The hypotheses, in a frame of their own or in that of a map that was loaded."""

from __future__ import annotations

from collections import Counter
import logging

import numpy as np

from slam_observer_ros.association.hypotheses import Hypotheses
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.matrices import with_variances_above
from slam_observer_ros.known_map.landmark_map import LandmarkMap
from slam_observer_ros.known_map.merging import (
    enter_map,
    is_lost,
    PlaceSearch,
    PoseTrial,
    shape_covariances,
    start_in_map,
)
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.state.state import Slam
from slam_observer_ros.state.step import Outcome

logger = logging.getLogger(__name__)

GIVEN_POSE_STD = np.repeat([0.26, 0.5], 3)
"""Standard deviation of a pose in a map that is given without any, rad and m; RViz's."""

MOVING_SPEED = 0.1
"""Speed from which on a landmark is left out of a map, m/s; slower ones may be at rest."""


class MapFrame:
    """Hypotheses, and where they are in a loaded map, as far as that is known.

    Parameters
    ----------
    settings : Settings
        All settings.

    Attributes
    ----------
    settings : Settings
        The settings in force.
    hypotheses : Hypotheses
        The hypotheses.
    loaded : LandmarkMap or None
        The map that was loaded.
    is_localised : bool
        Whether the hypotheses are in their final frame: always, unless a map was loaded.

    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.loaded: LandmarkMap | None = None
        self.is_localised = True
        self.hypotheses = Hypotheses(Slam(settings, np.eye(4)))
        self._counts: Counter[str] = Counter()
        self._trial: PoseTrial | None = None
        self._start_pose: FloatArray | None = None
        # By somebody, so that the settings don't say any more where it is.
        self._is_placed = False
        self._search = PlaceSearch()
        is_given = any(settings.initial_position) or settings.initial_yaw != 0.0
        if is_given and not settings.set_initial_pose:
            logger.warning(
                'initial_position and initial_yaw have no effect (use set_initial_pose: true).'
            )

    @property
    def slam(self) -> Slam:
        """The most likely state."""
        return self.hypotheses.best

    @property
    def counts(self) -> Counter[str]:
        """What befell the landmarks, and how often the place in the map was not known or lost."""
        return self._counts + self.slam.counts

    def count(self, name: str) -> int:
        """Return one of the :attr:`counts`, without adding up all of them."""
        return self._counts[name] + self.slam.counts[name]

    @property
    def landmark_map(self) -> LandmarkMap:
        """The present map; see :attr:`.Estimator.landmark_map`."""
        slam, rows = self.slam, self.slam.confirmed
        rows = rows[np.linalg.norm(slam.observer.u[rows], axis=1) < MOVING_SPEED]
        is_own_frame = self.loaded is None or not self.is_localised
        covariances = shape_covariances(slam) if is_own_frame else slam.landmark_covariances
        return LandmarkMap(
            slam.landmarks.ids[rows],
            slam.world_points[rows],
            None if covariances is None else with_variances_above(0.0, covariances[rows]),
            slam.landmarks.counts[rows],
        )

    def change_settings(self, settings: Settings) -> None:
        """Use other values of the settings that may change, from now on."""
        self.settings = settings
        self.hypotheses.change_settings(settings)

    def start_run(self, pose: FloatArray | None) -> None:
        """Start a run at ``pose`` (4, 4), exactly; by default where the settings have it start."""
        self._start_pose = pose
        self._is_placed = pose is not None
        if pose is None and self.settings.set_initial_pose:
            self._start_where_settings_say()
        else:
            self._start(pose)

    def restart_run(self) -> None:
        """Start again where the run began; in a loaded map where the settings say, or anywhere."""
        self.start_run(None if self.loaded else self._start_pose)

    def restart_time(self) -> None:
        """Go on from here at any other time."""
        self.hypotheses.restart_time()
        self._is_placed = True

    def _start_where_settings_say(self) -> None:
        settings = self.settings
        pose = se3.from_rpy((*settings.initial_position, 0.0, 0.0, settings.initial_yaw))
        self._start(pose, np.diag(GIVEN_POSE_STD**2))

    def _start(self, pose: FloatArray | None, covariance: FloatArray | None = None) -> None:
        """Start again with an empty map, or with the one that was loaded.

        Parameters
        ----------
        pose : FloatArray or None
            (4, 4) body to world. By default identity, or unknown in a map that was loaded.
        covariance : FloatArray, optional
            (6, 6) its covariance in a map that was loaded; default exact.

        """
        self._counts += self.slam.counts
        slam = Slam(self.settings, np.eye(4) if pose is None else self._allowed(pose))
        self.hypotheses = Hypotheses(slam)
        self._search = PlaceSearch()
        self.is_localised = self.loaded is None or pose is not None
        self._trial = None
        if self.loaded is not None and pose is not None:
            start_in_map(self.slam, self.loaded, covariance)
            self._trial = PoseTrial(self.loaded)

    def load(
        self,
        landmark_map: LandmarkMap,
        pose: FloatArray | None,
        covariance: FloatArray | None,
        has_begun: bool,
    ) -> None:
        """Take a map in the place of one loaded before, with the robot at ``pose`` (4, 4) in it.

        If that is None the robot is where the settings say, unless the run ``has_begun`` or
        someone has placed it elsewhere; else its place follows from what it sees, or has seen.
        """
        self.loaded = landmark_map.flattened() if self.settings.two_d_mode else landmark_map
        if landmark_map.is_planar and not self.settings.two_d_mode:
            logger.warning(
                'The map was made with two_d_mode, which is off: in space its heights of zero are '
                'taken for exact (use two_d_mode: true for a robot on a floor).'
            )
        self.is_localised = False
        self._trial = None
        self._search = PlaceSearch()
        if pose is not None:
            self.set_pose(pose, covariance)
        elif self.settings.set_initial_pose and not (has_begun or self._is_placed):
            self._start_where_settings_say()
        elif self.slam.is_mapping:
            self._enter()
        else:  # in a map that does not grow there is nothing to carry into another one
            self._start(None)

    def set_pose(self, pose: FloatArray, covariance: FloatArray | None) -> None:
        """Move the robot; if the place in a loaded map was not known, it is now."""
        self._is_placed = True
        if self.is_localised:
            self.hypotheses.prune_to_best().set_pose(self._allowed(pose), covariance)
            self._trial = None if self.loaded is None else PoseTrial(self.loaded)
        else:
            self._start(pose, covariance)

    def observe(self, event: ObservationEvent) -> Outcome:
        """Use an observation made at the hypotheses' instant; return what the best makes of it.

        The place in a loaded map is then looked for if it is not known, or not any more.
        """
        outcome = self.hypotheses.observe(event)
        self._find_place(outcome)
        return outcome

    def _find_place(self, outcome: Outcome) -> None:
        if self.loaded is None:
            return
        often = self.settings.max_rejections
        if self._trial is not None and self._trial.vote(outcome, often):
            self._search_anew('Most landmarks contradict the pose that was told')
        elif self.is_localised and is_lost(self.slam):
            self._search_anew('All landmarks are far from where they should be')
        if not self.is_localised:
            shared = int(np.sum(self.slam.landmarks.rows_of(self.loaded.ids) >= 0))
            if self._search.tell(shared):
                self._enter()
            self._counts['not_localised'] += not self.is_localised

    def _search_anew(self, why: str) -> None:
        logger.warning('%s; localising anew.', why)
        self._counts['lost'] += 1
        self._start(None)

    def _enter(self) -> None:
        """Move the best hypothesis into the frame of the loaded map, if the landmarks suffice."""
        if self.loaded is not None and enter_map(self.slam, self.loaded):
            self.hypotheses.prune_to_best()
            self.is_localised = True
            logger.info('Found the place in the map of %d landmarks.', len(self.loaded.ids))

    def _allowed(self, pose: FloatArray) -> FloatArray:
        """Return a pose (4, 4), or with ``two_d_mode`` what of it lies in the plane."""
        return se3.flatten(pose) if self.settings.two_d_mode else pose
