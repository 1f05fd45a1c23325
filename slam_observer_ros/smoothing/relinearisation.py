"""Looking back: when what was seen is linearised anew, and what comes of it.

Covariances that were computed around a poor early estimate stay wrong, so after a long blind
stretch a plain filter closes its loop badly. How much its linearisation can have lost shows in
how far its corrections have turned the robot.

What was linearised anew stays as it is: from then on a summary stands for it, in coordinates in
which later corrections hardly change it (:meth:`.Prior.least_nonlinear`). After a blind stretch
there may be no such summary until landmarks seen before are seen again. Else the cost of looking
back does not grow with the history, of which only :meth:`Hindsight.smooth` needs all.
"""

from __future__ import annotations

import logging
import math

import numpy as np

from slam_observer_ros.common.errors import SmoothingError
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.axes import Axes
from slam_observer_ros.observer.filter import FrameObservation
from slam_observer_ros.observer.observer import Correction, Observer
from slam_observer_ros.observer.riccati.joint_covariance import JointCovariance
from slam_observer_ros.sensor_models.calibration import Calibration
from slam_observer_ros.sensor_models.observation_noise import ObservationNoise
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.smoothing.gauss_newton import Smoother, Solution, Step
from slam_observer_ros.smoothing.history import History
from slam_observer_ros.smoothing.prior import Prior

logger = logging.getLogger(__name__)

SHARE_OF_HISTORY = 0.1
"""Share of all observations so far that are looked back at at least, up to ``MAX_INTERVAL``.

As large maps take many observations, the O(n³) that looking back costs for n landmarks is shared
by so many that each of them costs no more than an update, O(n²).
"""

MAX_INTERVAL = 300
"""Observations that are enough to be looked back at, however many there were before."""

MAX_TURN_RAD = 0.2
"""Angle, see :meth:`.Prior.least_nonlinear`, beyond which there is no summary."""

EARLY_SHARE = 0.1
"""Share of the observations otherwise waited for that will do after a single large correction:
what is linearised before the next time of looking back is linearised in the wrong place.
"""

ITERATIONS, TOLERANCE = 2, 2e-2
"""Steps of looking back at most; change of pose and map, rad and m, below which one will do."""

SMOOTHING_ITERATIONS, SMOOTHING_TOLERANCE = 50, 1e-6
"""The same for smoothing everything."""


class Hindsight:
    """What was seen since a prior, and looking back at it.

    Parameters
    ----------
    axes : Axes
        Which axes are estimated.
    settings : Settings
        The settings ``hindsight_*``, ``huber_threshold``, and the noise of observations.
    calibration, joint : Calibration, JointCovariance
        What the gains know, which looking back changes; at first there are no landmarks.

    Attributes
    ----------
    settings : Settings
        The settings in force.
    history : History
        What was seen since the prior.

    """

    def __init__(
        self, axes: Axes, settings: Settings, calibration: Calibration, joint: JointCovariance
    ) -> None:
        self.settings = settings
        self._axes, self._calibration, self._joint = axes, calibration, joint
        self._observation_noise = ObservationNoise(settings)
        self._warning = _Warning()
        self._seen = 0
        at_start = Prior(np.eye(4), calibration.values, np.empty((0, 3)), joint.P.copy())
        self._start(at_start, 'the last start')

    def restart(self, observer: Observer, since: str) -> None:
        """Forget all but what is known now; ``since`` is why, in words."""
        self._start(self._known(observer), since)

    def _start(self, prior: Prior, since: str) -> None:
        self.history = History(self._axes, self._observation_noise, prior, since)
        self._rest()

    def _rest(self) -> None:
        self._observations, self._turn_squared, self._largest_turn = 0, 0.0, 0.0
        self._is_owed = False

    @property
    def _window_is_full(self) -> bool:
        """Whether the history has as many frames as it may have."""
        return 0 < self.settings.hindsight_window <= len(self.history.stamps_ns)

    @property
    def _is_due(self) -> bool:
        """Whether corrections have turned far, with enough observations since it last was due.

        Or whether what was looked back at could not be summed up for a landmark in doubt.
        """
        if self._is_owed:
            return True
        settings = self.settings
        least = max(settings.hindsight_interval, min(SHARE_OF_HISTORY * self._seen, MAX_INTERVAL))
        if 0.0 < settings.hindsight_turn < self._largest_turn:
            least *= EARLY_SHARE
        turned_far = self._turn_squared > settings.hindsight_turn**2
        return turned_far and self._observations >= least

    def note_correction(self, rotation: FloatArray) -> None:
        """Note a correction that turned the robot by ``rotation`` (3,), rad."""
        turn_squared = float(rotation @ rotation)
        self._turn_squared += turn_squared
        self._largest_turn = max(self._largest_turn, math.sqrt(turn_squared))

    def look_back(self, observer: Observer, seen: FrameObservation, in_doubt: bool) -> None:
        """Add a frame to the history; if it is time, or asked for, linearise the latest ones anew.

        The smoother's marginal becomes the filter's covariance, and its solution the observer's
        new reference ξ°, with â_i = 0. It sums up all that was seen, for the next time.
        """
        self.history.see(seen, observer.A)
        self._seen += 1
        self._observations += 1
        if in_doubt:
            self._linearise_anew(observer)
            # It may be placed anew by this very frame, which must be kept for that.
            self._is_owed = True
        elif self._window_is_full or self._is_due:
            self._sum_up(observer, self._linearise_anew(observer))

    def _sum_up(self, observer: Observer, is_done: bool) -> None:
        """Let what is known now stand for all frames, if they could be linearised anew."""
        self._rest()
        known, angle_rad = self._known(observer).least_nonlinear(self._axes)
        if self._window_is_full:
            self._start(known, 'the history was cut (hindsight_window=0 keeps all of it)')
        elif is_done and angle_rad < MAX_TURN_RAD:
            self.history.summarise(known)

    def smooth(self, observer: Observer) -> Solution:
        """Return all estimates in hindsight, iterated from the present ones.

        Until the last pose, the map and the calibration rest.

        Raises
        ------
        SmoothingError
            If the observations don't determine everything.

        """
        history = self.history
        try:
            smoother = Smoother(self._axes, history.prior, history.frames(), self.settings)
            start = self._solution_from(0, observer)
            return smoother.smooth(start, SMOOTHING_ITERATIONS, SMOOTHING_TOLERANCE).end
        except np.linalg.LinAlgError as error:
            raise SmoothingError(
                'can not smooth: the observations leave some pose or landmark open, or contradict '
                'covariances that say they are exact'
            ) from error

    def _linearise_anew(self, observer: Observer) -> bool:
        """Linearise the frames anew that are not summarised yet, at the present estimates.

        Return whether anything came of it. If they don't determine everything, more may do so
        later; the first time there is a warning.
        """
        history, first = self.history, self.history.summarised
        try:
            smoother = Smoother(
                self._axes, history.summary, history.latest_frames(), self.settings
            )
            step = smoother.smooth(self._solution_from(first, observer), ITERATIONS, TOLERANCE)
            covariance = step.marginal()
        except np.linalg.LinAlgError:
            self._warning.give()
            return False
        history.poses[first:] = list(step.end.poses)
        self._rebase(observer, step, covariance)
        return True

    def _rebase(self, observer: Observer, step: Step, covariance: FloatArray) -> None:
        """Take where all was linearised for the reference; the step from there is a correction.

        ``covariance`` belongs to the step's start. Taken for that of its end it would tell
        something of the gauge, of which nothing is known; settling carries it over.
        """
        start, end = step.start, step.end
        observer.A = start.poses[-1]
        observer.rebase(start.points)
        self._joint.P = covariance
        self._joint.P = self._joint.with_pose_error_by(observer.A)
        self._calibration.shift(end.calibration - self._calibration.values)
        D = end.poses[-1] @ se3.inverse(start.poses[-1])
        observer.correct(Correction(D, slice(None), end.points - start.points))
        self._joint.settle(observer)

    def _solution_from(self, first: int, observer: Observer) -> Solution:
        """Return the present estimates, of poses those from before frame ``first`` on."""
        poses = np.array(self.history.poses[first:])
        return Solution(poses, self._calibration.values, observer.points)

    def _known(self, observer: Observer) -> Prior:
        """Return what is known now."""
        covariance = self._joint.with_pose_error_by(se3.inverse(observer.A))
        points = observer.points
        return Prior(observer.A, self._calibration.values, points, covariance)


class _Warning:
    """Says once what may be amiss, for all copies of its owner: hypotheses are copies."""

    def __init__(self) -> None:
        self._is_given = False

    def __deepcopy__(self, _memo: object) -> _Warning:
        return self

    def give(self) -> None:
        if self._is_given:
            return
        self._is_given = True
        logger.warning(
            'Could not look back (told only once): the observations so far leave something open, '
            'as where covariances are so large that they say nothing. Odometry often has such for '
            'z, roll and pitch: set two_d_mode: true for a robot on a floor.'
        )
