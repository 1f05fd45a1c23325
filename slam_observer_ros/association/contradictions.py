"""Whether the pose is wrong, as observation after observation contradicts it.

A rejected landmark may have moved, and a rejected observation may be garbled. The pose is wrong if
three things come together: all landmarks of an observation are rejected, other landmarks were
rejected before, and a single motion of the robot explains all of them. Odometry has then drifted
or slipped by more than its stated noise. Filters with a joint covariance weigh this as hypotheses;
for all other filters it is decided here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slam_observer_ros.association.slip import slip
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry import se3
from slam_observer_ros.state.matching import match, MatchedObservation, residuals_of
from slam_observer_ros.state.state import State

AGREEMENT = 3.0
"""Standard deviations within which earlier landmarks must be where a corrected pose has them."""


@dataclass(frozen=True, slots=True)
class _Rejected:
    """Where a landmark seemed to be when it was rejected."""

    position: FloatArray  # (3,) metres, reference frame
    covariance: FloatArray  # (3, 3) of the point, body frame, m²


class Contradictions:
    """The landmarks that were rejected since a landmark last passed the gate, by id."""

    def __init__(self) -> None:
        self._rejected: dict[int, _Rejected] = {}

    def clear(self) -> None:
        """Forget what was rejected."""
        self._rejected.clear()

    def resolve(self, state: State, matched: MatchedObservation) -> bool:
        """Let the robot have slipped if that explains all rejections; return whether it does.

        The observation has to be matched again then.
        """
        known, settings = matched.known, state.settings
        if not len(known.ids):
            return False
        if (state.gains.distances(matched.residuals) <= settings.rejection_threshold).any():
            self.clear()
            return False
        may_stray = settings.unknown_linear_motion or settings.unknown_angular_motion
        others = [i for i in self._rejected if i not in known.ids]
        if others and may_stray and self._agree(state, matched, others):
            slip(state, matched)
            self.clear()
            return True
        self._note(state, matched)
        return False

    def _agree(self, state: State, matched: MatchedObservation, others: list[int]) -> bool:
        """Return whether a pose that explains what is seen explains the ``others``, too."""
        trial = state.copy()
        slip(trial, matched)
        trial.gains.observe(match(trial, matched.event).residuals)
        ids = np.array(others)
        rows = trial.landmarks.rows_of(ids)
        rejected = [self._rejected[i] for i in others]
        # The earlier points as they would be seen now, with the same error of the pose.
        back = se3.inverse(state.observer.A)
        seen = replace(
            matched.known,
            ids=ids,
            points=se3.transform(back, np.array([other.position for other in rejected])),
            covariances=np.array([other.covariance for other in rejected]),
            velocities=None,
            sensor=None,
            sensed=None,
        )
        if (rows < 0).any():  # one was forgotten meanwhile
            return False
        trial.gains.prepare(rows)
        residuals = residuals_of(trial, seen, rows, np.array([o.covariance for o in rejected]))
        return bool((trial.gains.distances(residuals) <= AGREEMENT).all())

    def _note(self, state: State, matched: MatchedObservation) -> None:
        """Note where landmarks seem to be that are rejected."""
        positions = se3.transform(state.observer.A, matched.known.points)
        covariances = matched.covariances[matched.rows >= 0]
        for landmark_id, position, covariance in zip(
            matched.known.ids.tolist(), positions, covariances, strict=True
        ):
            self._rejected[landmark_id] = _Rejected(position, covariance)
