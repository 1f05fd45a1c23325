"""Looking back: when all that was seen is linearised anew, and what comes of it.

Covariances that were computed around a poor early estimate stay wrong, so after a long blind
stretch a plain filter closes its loop badly. How much its linearisation can have lost shows in
how far its corrections have turned the robot.
"""

from __future__ import annotations

import logging
import math

import numpy as np

from slam_observer_ros.axes import Axes
from slam_observer_ros.errors import SmoothingError
from slam_observer_ros.gains.base import Seen
from slam_observer_ros.gains.history import History
from slam_observer_ros.settings import Settings
from slam_observer_ros.smoothing import Prior, Smoother, Solution, Step
from slam_observer_ros.types import FloatArray

logger = logging.getLogger(__name__)

GROWTH = 0.1
"""Share of the history that is new at least when looking back at all of it; with any less, the
cost of each observation would grow with the history.
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

    def linearise_anew(self, start: Solution) -> tuple[Step, FloatArray] | None:
        """Return the last step from ``start``, and the covariance where all was linearised.

        None, the first time after a warning, if the observations don't determine everything.
        """
        self._rest()
        try:
            step = self._smoother().smooth(start, ITERATIONS, TOLERANCE)
            covariance = step.marginal()
        except np.linalg.LinAlgError:
            self._warning.give()
            return None
        self.history.poses = list(step.end.poses)
        return step, covariance

    def smooth(self, start: Solution) -> Solution:
        """Return the estimates in hindsight, iterated from ``start`` until nothing moves.

        Raises
        ------
        SmoothingError
            If the observations don't determine everything.

        """
        try:
            return self._smoother().smooth(start, 50, 1e-6).end
        except np.linalg.LinAlgError as error:
            raise SmoothingError(
                'can not smooth: the observations leave some pose or landmark open, or contradict '
                'covariances that say they are exact'
            ) from error

    def _smoother(self) -> Smoother:
        history = self.history
        return Smoother(self._axes, history.prior, history.frames(), self.settings)


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
