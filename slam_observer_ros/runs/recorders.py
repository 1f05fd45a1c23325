"""What is noted while a run goes on: sampled trajectories, instants, innovations, likelihood.

How likely what was seen is by what the filter expected measures its noise, without truth. Each
residual r of a known landmark, given those before it, is N(0, S) with the S that the filter
states, or else an outlier, anywhere in view. As both densities are normalised, no noise is good
for all: too large a one spreads them out (log det S), too small a one leaves r in their tails, and
what the filter rejects is paid for as an outlier.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

from slam_observer_ros.common.stamps import due_rows, is_due, NANOSECONDS_PER_SECOND
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.estimates import Innovations, Instant, Update
from slam_observer_ros.estimator.estimate import Estimate
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.models.velocity_history import VelocityHistory
from slam_observer_ros.recordings.trajectory import Trajectory

SAMPLE_PERIOD_NS = 50_000_000  # least time between two poses of a sampled trajectory


class PoseSamples:
    """Poses (4, 4) at least a period apart, and their stamps: all, or the first and the last."""

    def __init__(self, keep_all: bool = True) -> None:
        self._keep_all = keep_all
        self.stamps_ns: list[int] = []
        self._poses: list[FloatArray] = []
        self._covariances: list[FloatArray] = []

    def due(self, stamps_ns: IntArray) -> list[int]:
        """Return the rows of increasing stamps (s,) at which poses are to be added."""
        last_ns = self.stamps_ns[-1] if self.stamps_ns else None
        return due_rows(stamps_ns, last_ns, SAMPLE_PERIOD_NS)

    def add(
        self, stamps_ns: IntArray, poses: FloatArray, covariances: FloatArray | None = None
    ) -> None:
        """Append poses (s, 4, 4), and their covariances (s, 6, 6) where these are known."""
        self.stamps_ns += stamps_ns.tolist()
        self._poses += list(poses)
        if covariances is not None:
            self._covariances += list(covariances)
        if not self._keep_all:
            del self.stamps_ns[1:-1], self._poses[1:-1]

    @property
    def trajectory(self) -> Trajectory:
        """The poses in stamp order."""
        return Trajectory.from_samples(self.stamps_ns, self._poses)

    @property
    def covariances(self) -> FloatArray | None:
        """(k, 6, 6) covariance of each pose of the trajectory; None where they are not known."""
        if not self._covariances:
            return None
        latest = dict(zip(self.stamps_ns, self._covariances, strict=True))
        return np.array([latest[stamp_ns] for stamp_ns in sorted(latest)])


MOST_PENDING = 64  # motions that are worked off at once: one by one costs three times as much


class DeadReckoning:
    """Collects the poses that the velocities alone lead through, from the identity on."""

    def __init__(self, keep_all: bool = True) -> None:
        self._pose = np.eye(4)
        self._samples = PoseSamples(keep_all)
        self._pending: list[tuple[FloatArray, IntArray]] = []
        self._most_pending = MOST_PENDING if keep_all else 1
        self._has_begun = False
        self._end_ns = 0

    def advance(self, velocities: VelocityHistory, start_ns: int, end_ns: int) -> None:
        """Move on from one stamp to another, nanoseconds."""
        held = velocities.held(start_ns, end_ns)
        self._has_begun = self._has_begun or bool(held.dt_s.any())
        if not self._has_begun:
            return
        if start_ns != self._end_ns or len(self._pending) == self._most_pending:
            self._move_on()
        elapsed_s = np.append(0.0, np.cumsum(held.dt_s + held.gap_s))
        stamps_ns = start_ns + np.rint(elapsed_s * NANOSECONDS_PER_SECOND).astype(np.int64)
        self._pending.append((held.body_velocities * held.dt_s[:, None], stamps_ns))
        self._end_ns = end_ns

    def _move_on(self) -> None:
        """Work off motions that follow each other, each from where the one before it ended."""
        if not self._pending:
            return
        twists, stamps_ns = zip(*self._pending, strict=True)
        self._pending.clear()
        path = se3.path(self._pose, np.concatenate(twists))
        at_ns = np.concatenate([stamps_ns[0][:1], *(each[1:] for each in stamps_ns)])
        rows = self._samples.due(at_ns)
        self._samples.add(at_ns[rows], path[rows])
        self._pose = se3.pose(so3.normalise(path[-1, :3, :3]), path[-1, :3, 3])

    @property
    def trajectory(self) -> Trajectory:
        """The poses kept, in stamp order."""
        self._move_on()
        return self._samples.trajectory


FIRST_PERIOD_NS = 250_000_000  # between two instants at first; doubled when they are too many

MAX_INSTANTS = 600
MAX_LANDMARKS_KEPT = 100_000  # landmarks of all instants together
LATELY_NS = 1_000_000_000  # how long ago an observation may be that an instant shows


class NisTally:
    """Sums up the normalised innovations of a run."""

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
        """NIS per degree of freedom over the run, 1 is consistent; None if none is known."""
        total = self._degrees_of_freedom
        return self._nis / total if total else None


class RunRecorder(NisTally):
    """Notes instants and innovations of a run while it goes on, too, as a page shows them.

    Memory and time are bounded: as a run grows longer, instants lie further apart.
    """

    def clear(self) -> None:
        """Forget all: the run has started again."""
        super().clear()
        self._instants: list[Instant] = []
        self._updates: list[Update] = []
        self._period_ns = FIRST_PERIOD_NS

    def note_update(self, update: Update) -> None:
        """Take in an observation, whose innovation the estimator has judged."""
        super().note_update(update)
        if len(update.ids):
            self._updates.append(update)

    def note_stamp(self, estimator: Estimate) -> None:
        """Take in the state when all events of a stamp have been used, if one is due."""
        stamp_ns = estimator.stamp_ns
        if stamp_ns is None or not estimator.is_localised:
            return
        last_ns = self._instants[-1].stamp_ns if self._instants else None
        if not is_due(stamp_ns, last_ns, self._period_ns):
            return
        self._instants.append(_instant(estimator, stamp_ns))
        kept = sum(len(instant.ids) for instant in self._instants)
        if len(self._instants) > MAX_INSTANTS or kept > MAX_LANDMARKS_KEPT:
            del self._instants[1::2]
            self._period_ns *= 2

    def finish(self, estimator: Estimate) -> tuple[Instant, ...]:
        """Return the instants in the order of their stamps, the end of the run as the last."""
        by_stamp = {instant.stamp_ns: instant for instant in self._instants}
        if estimator.stamp_ns is not None and estimator.is_localised:
            by_stamp[estimator.stamp_ns] = _instant(estimator, estimator.stamp_ns)
        return tuple(by_stamp[stamp_ns] for stamp_ns in sorted(by_stamp))

    @property
    def innovations(self) -> Innovations:
        """What was noted of all observations."""
        judged = [(update, update.innovation) for update in self._updates if update.innovation]
        updates, each = [update for update, _ in judged], [innovation for _, innovation in judged]
        stamps_ns = np.array([update.stamp_ns for update in updates], dtype=np.int64)
        counts = np.array([len(update.ids) for update in updates], dtype=np.int64)
        none = np.empty(0)
        return Innovations(
            stamps_ns=np.repeat(stamps_ns, counts),
            ids=np.concatenate([none.astype(np.int64), *(update.ids for update in updates)]),
            distances=np.concatenate([none, *(one.distances for one in each)]),
            residuals=np.concatenate([np.empty((0, 3)), *(one.residuals for one in updates)]),
            weights=np.concatenate([none, *(one.weights for one in each)]),
            moved=np.concatenate(
                [none.astype(np.bool_), *(np.isin(u.ids, u.moved_ids) for u in updates)]
            ),
            update_stamps_ns=stamps_ns,
            nis=np.array([one.nis for one in each], dtype=np.float64),
            degrees_of_freedom=np.array([one.degrees_of_freedom for one in each], dtype=np.int64),
            lyapunov=np.array([update.lyapunov for update in updates]),
        )


def _instant(estimator: Estimate, stamp_ns: int) -> Instant:
    last = estimator.last_update
    is_late = last is None or not 0 <= stamp_ns - last.stamp_ns < LATELY_NS
    return Instant(
        stamp_ns=stamp_ns,
        pose=estimator.pose,
        pose_covariance=estimator.pose_covariance,
        ids=estimator.landmark_ids,
        world_points=estimator.world_points,
        landmark_covariances=estimator.landmark_covariances,
        calibration=tuple(estimator.calibration),
        dropped=estimator.dropped.copy(),
        doubted_ids=estimator.doubted_ids,
        seen=None if is_late else last,
    )


OUTLIERS = 0.02  # share of points taken for outliers: sensors have some per cent of them


@dataclass(frozen=True, slots=True, eq=False)
class Likelihood:
    """Log densities of all residuals of a run, in natural logarithms.

    ``shares`` say how much of an observation each is: those whose errors last, as
    ``observation_correlation_time`` has it, are together one.
    """

    stamps_ns: IntArray  # (m,)
    log_densities: FloatArray  # (m,)
    shares: FloatArray  # (m,)

    def select(self, mask: BoolArray) -> Likelihood:
        """Return the part that ``mask`` (m,) picks."""
        return Likelihood(self.stamps_ns[mask], self.log_densities[mask], self.shares[mask])

    @property
    def total(self) -> float:
        """Log likelihood of them all."""
        return float(self.shares @ self.log_densities)

    @property
    def mean(self) -> float:
        """The same per observation with new errors; −∞ if there is none."""
        return self.total / self.count if self.count > 0.0 else -math.inf

    @property
    def count(self) -> float:
        """How many observations with new errors there are."""
        return float(self.shares.sum())


class LikelihoodRecorder:
    """Notes the likelihood of each observation of a run; a point has the ``dimension``."""

    def __init__(self, dimension: int, reach_m: float) -> None:
        ball = math.pi ** (dimension / 2) / math.gamma(dimension / 2 + 1) * reach_m**dimension
        self.log_outlier = math.log(OUTLIERS / ball)
        self.clear()

    def clear(self) -> None:
        """Forget all: the run has started again."""
        self._stamps_ns: list[int] = []
        self._log_densities: list[FloatArray] = []
        self._shares: list[FloatArray] = []

    def note_update(self, update: Update) -> None:
        """Take in an observation, whose innovation the estimator has judged."""
        innovation = update.innovation
        if innovation is None:
            return
        regular = math.log1p(-OUTLIERS) + innovation.log_densities
        self._log_densities.append(np.logaddexp(regular, self.log_outlier))
        self._shares.append(innovation.shares)
        self._stamps_ns += [update.stamp_ns] * len(regular)

    @property
    def likelihood(self) -> Likelihood:
        """What was noted so far."""
        none = np.empty(0)
        return Likelihood(
            np.array(self._stamps_ns, dtype=np.int64),
            np.concatenate([none, *self._log_densities]),
            np.concatenate([none, *self._shares]),
        )
