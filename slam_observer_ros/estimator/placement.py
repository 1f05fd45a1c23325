"""Where the estimate begins: at a pose that is given, in a loaded map, or at an unknown pose."""

from __future__ import annotations

from collections.abc import Sequence
import logging

import numpy as np

from slam_observer_ros.common.findings import found
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimates import Outcomes, Update
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.filter.constant import ConstantGains
from slam_observer_ros.filter.gains import Gains
from slam_observer_ros.filter.observer import Observer
from slam_observer_ros.filter.riccati.riccati import RiccatiGains
from slam_observer_ros.lie import se3
from slam_observer_ros.lie.axes import axes_of
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.mapping.localiser import is_rough, Localiser
from slam_observer_ros.models.calibration import Calibration, without_calibration
from slam_observer_ros.models.motion_noise import MotionNoise
from slam_observer_ros.settings.estimator_settings import LiveSettings, Settings
from slam_observer_ros.tracking.half_points import take_scales
from slam_observer_ros.tracking.hypotheses import Hypotheses
from slam_observer_ros.tracking.state import State
from slam_observer_ros.tracking.waiting_room import Window

logger = logging.getLogger(__name__)

DESIGNS: dict[str, type[Gains]] = {'constant': ConstantGains, 'riccati': RiccatiGains}
"""The values of the parameter ``gains``, and what they are."""

GIVEN_POSE_STD = np.repeat([0.26, 0.5], 3)
"""Standard deviation of a pose in a map that is given without any, rad and m: RViz's, AMCL's."""


def make_gains(
    settings: Settings, reference_pose: FloatArray, design: type[Gains] | None = None
) -> Gains:
    """Return a design, by default what ``gains`` names, at P° = ``reference_pose`` (4, 4)."""
    design, observer = design or DESIGNS[settings.gains], Observer(reference_pose)
    estimated = settings if design.estimates_calibration else without_calibration(settings)
    calibration = Calibration(observer, estimated, axes_of(settings.two_d_mode))
    return design(settings, observer, calibration, MotionNoise(settings))


class Placement:
    """Starts ``hypotheses``, and moves them into the frame of a map that the ``localiser`` has.

    ``was_placed`` is whether somebody has said where the robot is, so that the pose of the
    settings is not where it starts. ``judges_innovations`` and ``keeps_outcomes`` are as for
    :class:`.Estimator`.
    """

    def __init__(
        self, settings: LiveSettings, judges_innovations: bool, keeps_outcomes: bool
    ) -> None:
        self._settings = settings
        self._judges_innovations, self._keeps_outcomes = judges_innovations, keeps_outcomes
        self.hypotheses = Hypotheses(self._state_at(np.eye(4)))
        self.localiser = Localiser()
        self.was_placed = False

    def reset(self, pose: FloatArray | None) -> None:
        """Start again at ``pose`` (4, 4); if None, where the settings say, or at identity.

        In a loaded map it is unknown then, unless the settings say it.
        """
        self.was_placed = pose is not None
        if pose is None and self._settings.set_initial_pose:
            self._start_where_settings_say()
        else:
            self.start(pose)

    def load(
        self,
        maps: Sequence[LandmarkMap],
        pose: FloatArray | None,
        covariance: FloatArray | None,
        *,
        is_at_start: bool,
    ) -> None:
        """Take maps, and the pose in them if it is given, or said by the settings at the start.

        Otherwise the pose follows from landmarks that were seen, or that will be.
        """
        self.localiser.load(maps, self._settings.two_d_mode)
        if pose is not None:
            self.place(pose, covariance)
        elif self._settings.set_initial_pose and is_at_start and not self.was_placed:
            self._start_where_settings_say()
        elif self.hypotheses.best.is_mapping:
            if self.localiser.enter(self.hypotheses.best):
                self.hypotheses.prune_to_best()
        else:  # in a map that does not grow there is nothing to carry into another one
            self.start(None)

    def place(self, pose: FloatArray, covariance: FloatArray | None, map_name: str = '') -> None:
        """Move the robot; if the pose in a loaded map was not known, it is now.

        Of several maps it is in ``map_name``; by default the pose does not say which one.
        """
        self.was_placed = True
        named = [known for known in self.localiser.maps if map_name and known.name == map_name]
        if self.localiser.is_localised:
            self.hypotheses.prune_to_best().set_pose(self._allowed(pose), covariance)
            self.localiser.doubt_pose()
        else:
            self.start(pose, covariance, named[0] if named else None)

    def doubt(self, pose: FloatArray, covariance: FloatArray | None) -> None:
        """Search about the present pose if it is too rough to match points without ids by it."""
        if covariance is not None and is_rough(covariance):
            self.start(None)
            self.localiser.search_near(pose, covariance)

    def localise(self, event: ObservationEvent, update: Update, window: Window) -> None:
        """Look for the pose in a loaded map if it is not known, or not any more.

        The ``window`` has the views of ranges or bearings alone since then.
        """
        localiser, hypotheses = self.localiser, self.hypotheses
        missed = hypotheses.missed
        reason = localiser.reason_to_reset(hypotheses.best, event, update, missed)
        if reason is not None:
            logger.warning('%s', found('wrong_pose', reason=reason))
            self.start(None)
        if localiser.search(hypotheses.best):
            hypotheses.prune_to_best()
        elif (by_tag := localiser.pose_by_tag(hypotheses.best)) is not None:
            self.start(by_tag.pose, by_tag.covariance, by_tag.known)
            localiser.try_tag(by_tag.tag_id)
        elif (fix := localiser.pose_by_half_points(hypotheses.best, window)) is not None:
            lost = hypotheses.best
            self.start(fix.pose, fix.covariance[:6, :6], fix.known)
            take_scales(hypotheses.best, lost, fix.scales, fix.covariance)

    def start(
        self,
        pose: FloatArray | None,
        covariance: FloatArray | None = None,
        known: LandmarkMap | None = None,
    ) -> None:
        """Start again with an empty map, or the loaded one, at ``pose`` (4, 4) if it is known.

        ``known`` is the map that it is in; of several ones it is searched for if that is None.
        """
        rough = pose if known is None and len(self.localiser.maps) > 1 else None
        pose = pose if rough is None else None
        state = self._state_at(np.eye(4) if pose is None else self._allowed(pose))
        self.hypotheses.reset(state)
        self.localiser.start(state, pose is not None, covariance, known)
        if rough is not None:
            given = np.zeros((6, 6)) if covariance is None else covariance
            self.localiser.search_near(rough, given + np.diag(GIVEN_POSE_STD**2))

    def _start_where_settings_say(self) -> None:
        self.start(se3.from_rpy(self._settings.initial_pose), np.diag(GIVEN_POSE_STD**2))

    def _state_at(self, pose: FloatArray) -> State:
        """Return a state at its start, with P° = ``pose`` (4, 4)."""
        state = State(make_gains(self._settings, pose), self._settings)
        state.judges_innovations = self._judges_innovations
        state.counts = Outcomes(is_kept=self._keeps_outcomes)
        return state

    def _allowed(self, pose: FloatArray) -> FloatArray:
        """Return a pose (4, 4), with ``two_d_mode`` its part in the plane."""
        return se3.flatten(pose) if self._settings.two_d_mode else pose
