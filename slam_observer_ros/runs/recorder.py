"""What a report shows of a run: states at sampled instants, and how far off each residual was.

Memory and time are bounded: as a run grows longer, instants lie further apart.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.stamps import is_due
from slam_observer_ros.estimates import Update
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.evaluation.run_record import Innovations, Instant

FIRST_PERIOD_NS = 250_000_000
"""Time between two instants at first; it doubles whenever there are too many of them."""

MAX_INSTANTS = 600
MAX_LANDMARKS_KEPT = 100_000
"""Landmarks of all instants together."""


class RunRecorder:
    """Notes instants and innovations of a run while it goes on."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all: the run has started again."""
        self._instants: list[Instant] = []
        self._updates: list[Update] = []
        self._period_ns = FIRST_PERIOD_NS

    def note_update(self, update: Update) -> None:
        """Take in an observation, whose innovation the estimator has judged."""
        if len(update.ids):
            self._updates.append(update)

    def note_stamp(self, estimator: Estimator) -> None:
        """Take in the state when all events of a stamp have been used, if one is due."""
        stamp_ns = estimator.stamp_ns
        if stamp_ns is None or not estimator.is_localised:
            return
        if not is_due(stamp_ns, self._last_ns, self._period_ns):
            return
        self._instants.append(_instant(estimator, stamp_ns))
        kept = sum(len(instant.ids) for instant in self._instants)
        if len(self._instants) > MAX_INSTANTS or kept > MAX_LANDMARKS_KEPT:
            del self._instants[1::2]
            self._period_ns *= 2

    @property
    def _last_ns(self) -> int | None:
        return self._instants[-1].stamp_ns if self._instants else None

    def finish(self, estimator: Estimator) -> tuple[Instant, ...]:
        """Return the instants in the order of their stamps, the end of the run as the last."""
        by_stamp = {instant.stamp_ns: instant for instant in self._instants}
        if estimator.stamp_ns is not None and estimator.is_localised:
            by_stamp[estimator.stamp_ns] = _instant(estimator, estimator.stamp_ns)
        return tuple(by_stamp[stamp_ns] for stamp_ns in sorted(by_stamp))

    @property
    def mean_nis(self) -> float | None:
        """As :attr:`.Innovations.mean_nis`."""
        return self.innovations.mean_nis

    @property
    def innovations(self) -> Innovations:
        """What was noted of all observations."""
        judged = [(update, update.innovation) for update in self._updates if update.innovation]
        updates = [update for update, _ in judged]
        each = [innovation for _, innovation in judged]
        stamps_ns = np.array([update.stamp_ns for update in updates], dtype=np.int64)
        counts = np.array([len(update.ids) for update in updates], dtype=np.int64)
        none = np.empty(0)
        return Innovations(
            stamps_ns=np.repeat(stamps_ns, counts),
            ids=np.concatenate([none.astype(np.int64), *(update.ids for update in updates)]),
            distances=np.concatenate([none, *(innovation.distances for innovation in each)]),
            residuals=np.concatenate(
                [np.empty((0, 3)), *(update.residuals for update in updates)]
            ),
            weights=np.concatenate([none, *(innovation.weights for innovation in each)]),
            moved=np.concatenate(
                [none.astype(np.bool_), *(np.isin(u.ids, u.moved_ids) for u in updates)]
            ),
            update_stamps_ns=stamps_ns,
            nis=np.array([innovation.nis for innovation in each], dtype=np.float64),
            degrees_of_freedom=np.array(
                [innovation.degrees_of_freedom for innovation in each], dtype=np.int64
            ),
            lyapunov=np.array([update.lyapunov for update in updates]),
        )


class NisTally:
    """Sums up the normalised innovations of a run, and keeps nothing else of it."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all: the run has started again."""
        self._nis, self._degrees_of_freedom = 0.0, 0

    def note_update(self, update: Update) -> None:
        """Take in an observation, whose innovation the estimator has judged."""
        innovation = update.innovation
        if innovation is not None and innovation.nis is not None:
            self._nis += innovation.nis
            self._degrees_of_freedom += innovation.degrees_of_freedom

    @property
    def mean_nis(self) -> float | None:
        """As :attr:`.Innovations.mean_nis`."""
        total = self._degrees_of_freedom
        return self._nis / total if total else None


def _instant(estimator: Estimator, stamp_ns: int) -> Instant:
    return Instant(
        stamp_ns=stamp_ns,
        pose=estimator.pose,
        pose_covariance=estimator.pose_covariance,
        ids=estimator.landmark_ids,
        world_points=estimator.world_points,
        landmark_covariances=estimator.landmark_covariances,
        calibration=tuple(estimator.calibration),
        dropped=estimator.dropped.copy(),
    )
