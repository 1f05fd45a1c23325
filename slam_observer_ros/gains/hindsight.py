"""Looking back: when what was seen is linearised anew, and what comes of it.

Covariances that were computed around a poor early estimate stay wrong, so after a long blind
stretch a plain filter closes its loop badly. How much its linearisation can have lost shows in
how far its corrections have turned the robot.

What was linearised anew stays as it is: from then on a summary stands for it, of where landmarks
lie as seen from the pose of that time (:meth:`.Prior.relative`), which later corrections hardly
bend. So the cost of looking back does not grow with the history, of which only
:meth:`Hindsight.smooth` needs all.
"""

from __future__ import annotations

import logging
import math

import numpy as np

from slam_observer_ros.axes import Axes
from slam_observer_ros.errors import SmoothingError
from slam_observer_ros.gains.base import Seen
from slam_observer_ros.gains.history import History
from slam_observer_ros.prior import Prior
from slam_observer_ros.settings import Settings
from slam_observer_ros.smoothing import Smoother, Solution, Step
from slam_observer_ros.types import FloatArray

logger = logging.getLogger(__name__)

GROWTH = 0.1
"""Share of the history that is looked back at at least. As large maps take long histories, the
O(n³) that looking back costs for n landmarks is shared by so many observations that each costs no
more than an update, O(n²).
"""

HURRY = 0.1
"""Share of the observations otherwise waited for that will do after a single large correction:
what is linearised before the next time of looking back is linearised in the wrong place.
"""

ITERATIONS = 2
"""Steps of looking back at most; the next time it goes on from where they led."""

TOLERANCE = 2e-2
"""Change of pose and map, rad and m, below which one step will do."""


class Hindsight:
    """What was seen since a prior, and whether it is time to look back at it.

    Parameters
    ----------
    axes : Axes
        Which axes are estimated.
    settings : Settings
        The settings ``hindsight_*``, and ``huber_threshold``.
    prior : Prior
        What was known before.

    Attributes
    ----------
    settings : Settings
        The settings in force.
    history : History
        What was seen since the prior.

    """

    def __init__(self, axes: Axes, settings: Settings, prior: Prior) -> None:
        self.settings = settings
        self._axes = axes
        self._warning = _Warning()
        self.restart(prior, 'the last start')

    def restart(self, prior: Prior, since: str) -> None:
        """Forget all but the prior; ``since`` is why, in words."""
        self.history = History(self._axes, prior, since)
        self._rest()

    def _rest(self) -> None:
        self._observations, self._turn_squared, self._largest_turn = 0, 0.0, 0.0

    @property
    def window_is_full(self) -> bool:
        """Whether the history has as many frames as it may have."""
        return 0 < self.settings.hindsight_window <= len(self.history.stamps_ns)

    @property
    def is_due(self) -> bool:
        """Whether corrections have turned far, with enough observations since it last was due."""
        settings = self.settings
        least = max(settings.hindsight_interval, GROWTH * len(self.history.stamps_ns))
        if 0.0 < settings.hindsight_turn < self._largest_turn:
            least *= HURRY
        turned_far = self._turn_squared > settings.hindsight_turn**2
        return turned_far and self._observations >= least

    def note_correction(self, rotation: FloatArray) -> None:
        """Note a correction that turned the robot by ``rotation`` (3,), rad."""
        turn_squared = float(rotation @ rotation)
        self._turn_squared += turn_squared
        self._largest_turn = max(self._largest_turn, math.sqrt(turn_squared))

    def see(self, seen: Seen, pose: FloatArray) -> None:
        """Add a frame to the history; see :meth:`History.see`."""
        self.history.see(seen, pose)
        self._observations += 1

    def linearise_anew(
        self, calibration: FloatArray, points: FloatArray
    ) -> tuple[Step, FloatArray] | None:
        """Linearise the frames anew that are not summarised yet, at the present estimates.

        Returns
        -------
        step : Step
            The last step.
        covariance : FloatArray
            That of the last pose, calibration and landmarks at the start of the step. None at
            all, the first time after a warning, if the observations don't determine everything.

        """
        self._rest()
        history, first = self.history, self.history.summarised
        frames = history.frames().since(first)
        start = Solution(np.array(history.poses[first:]), calibration, points)
        try:
            smoother = Smoother(self._axes, history.summary, frames, self.settings)
            step = smoother.smooth(start, ITERATIONS, TOLERANCE)
            covariance = step.marginal()
        except np.linalg.LinAlgError:
            self._warning.give()
            return None
        history.poses[first:] = list(step.end.poses)
        return step, covariance

    def smooth(self, calibration: FloatArray, points: FloatArray) -> Solution:
        """Return all estimates in hindsight, iterated from the present ones until nothing moves.

        Raises
        ------
        SmoothingError
            If the observations don't determine everything.

        """
        history = self.history
        start = Solution(np.array(history.poses), calibration, points)
        try:
            smoother = Smoother(self._axes, history.prior, history.frames(), self.settings)
            return smoother.smooth(start, 50, 1e-6).end
        except np.linalg.LinAlgError as error:
            raise SmoothingError(
                'can not smooth: the observations leave some pose or landmark open, or contradict '
                'covariances that say they are exact'
            ) from error


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
