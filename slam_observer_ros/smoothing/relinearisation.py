"""When observations are relinearised, and what the filter takes over from that.

A covariance that was computed around a poor early estimate stays wrong, so after a long blind
stretch a plain filter closes its loop badly. The corrections since show how much may be wrong: by
how far they have turned the robot.

Relinearised observations are not relinearised again. A summary stands for them from then on, in
coordinates in which later corrections hardly change it (:meth:`.Prior.least_nonlinear`). After a
blind stretch there may be no such summary until known landmarks are seen again. Otherwise the cost
does not grow with the history; only :meth:`Relinearisation.smooth` needs all of it.

The cost is O(n³) for n landmarks. A map without a dense covariance
(:class:`.CompressedCovariance`) is not relinearised any more. Its history goes on, for smoothing,
until it would have to begin again: then it is given up. Among tags the covariance stays dense, but
from :data:`MAX_UNKNOWNS` on they are not relinearised, either.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import replace
import logging
import math
from typing import NamedTuple, Protocol

import numpy as np

from slam_observer_ros.common.errors import ParameterError, SmoothingError
from slam_observer_ros.common.findings import found
from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.filter.flat_arrays import Advanced, Interval
from slam_observer_ros.filter.joint_covariance import JointCovariance
from slam_observer_ros.filter.observer import Observer
from slam_observer_ros.lie import se3
from slam_observer_ros.lie.axes import EstimatedAxes
from slam_observer_ros.lie.sensor_mounting import MEASURED
from slam_observer_ros.models.calibration import Calibration
from slam_observer_ros.models.observation_noise import ObservationNoise
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.smoothing.gauss_newton import Smoother, Step
from slam_observer_ros.smoothing.history import History, Keyframe
from slam_observer_ros.smoothing.keyframes import confirmed_slips, Keyframes, Solution
from slam_observer_ros.smoothing.observations import SensedPoints
from slam_observer_ros.smoothing.prior import Prior

logger = logging.getLogger(__name__)

# Share of all observations so far that are relinearised at once at least, up to ``MAX_INTERVAL``.
# A large map takes many observations. So many share the cost, O(n³) for n landmarks, that each of
# them costs no more than an update, O(n²).
SHARE_OF_HISTORY = 0.1
MAX_INTERVAL = 300  # observations that are enough, however many there were before
MOST_AWAITED = 1000  # keyframes kept for landmarks that may enter: they cost some milliseconds
MAX_UNKNOWNS = 600  # of a map that is relinearised, in some tenths of a second: 100 tags in space
NO_HISTORY = "smoothing needs 'gains: riccati' and a 'relinearization_interval'"
CUT = 'the history was cut (smoothing_window=0 keeps all of it)'
MAX_TURN_RAD = 0.2  # angle, see :meth:`.Prior.least_nonlinear`, beyond which there is no summary

# Share of the observations otherwise waited for that will do after a single large correction:
# until then observations are linearised at the wrong estimate.
EARLY_SHARE = 0.1

# Steps at most; change of pose and map, rad and m, below which one will do.
ITERATIONS, TOLERANCE = 2, 2e-2
ENTRY_ITERATIONS = 10  # at most where a landmark enters, which corrects all since it was seen
PLACING_ITERATIONS, COST_TOLERANCE = 40, 0.1  # steps to place a landmark; least gain of one
SMOOTHING_ITERATIONS, SMOOTHING_TOLERANCE = 50, 1e-6  # the same for smoothing everything
SLIP_TOLERANCE = 1e-4  # change below which a solution will do to judge slips by


class Placed(NamedTuple):
    """Where a landmark is, by views of it."""

    point: FloatArray  # (3,)
    covariance: FloatArray  # (k, k) as seen from the robot, by given scales and mountings, m²
    cost: float  # −2 ln of the likelihood, but for a constant


class KnownErrors(Protocol):
    """The part of :class:`.Errors` that is needed; P may become one for large maps."""

    observer: Observer
    joint: JointCovariance


class Owner(Protocol):
    """A state, which keeps a past beside its estimate."""

    calibration: Calibration

    @property
    def known_errors(self) -> KnownErrors:
        """The errors, which are known where anything is relinearised."""


class NoPast:
    """The past of a filter that relinearises nothing: as :class:`Relinearisation`, but empty."""

    is_active = False

    def copy(self, _owner: Owner) -> NoPast:
        """Return an independent copy for a copy of its owner."""
        return self

    def reset(self, *_: object) -> None:
        """Keep nothing of what is noted."""

    move = slip = know_calibration = note_correction = add = mark = enter = reset
    add_calibration = relocate = forget_orientations = remove = merge = reset

    def poses_of(self, marks: Iterable[int]) -> list[FloatArray | None]:
        """Return the poses (4, 4) of marked observations, which are not known."""
        return [None for _ in marks]

    def placed(self, *_: object) -> None:
        """Return where a landmark is, which is not known."""

    def evidence(self) -> None:
        """Return how likely all that was seen is, which is not known."""

    def smooth(self) -> tuple[Step, int, History]:
        """Raise :exc:`ParameterError`, as no history is kept."""
        raise ParameterError(NO_HISTORY)


class Relinearisation:
    """Keeps the ``history`` of a filter since a prior, and relinearises it when it is due.

    Relinearising changes the observer and the covariance of ``errors``, and the ``calibration``.
    ``relinearization_*``, ``smoothing_window``, ``huber_threshold``, ``rejection_threshold`` and
    the noise of observations are read from the settings.
    """

    def __init__(self, errors: KnownErrors, calibration: Calibration, settings: Settings) -> None:
        self._errors, self._settings = errors, settings
        self._axes = errors.joint.chart.axes
        self._observer, self._calibration = errors.observer, calibration
        self._observation_noise = ObservationNoise(settings)
        self._warned = list[str]()  # by any of its copies, as hypotheses are
        self._seen = self._observations = 0
        self._turn_squared = self._largest_turn = 0.0
        self.reset('the last start')

    def copy(self, owner: Owner) -> Relinearisation:
        """Return an independent copy for a copy of its owner."""
        other, errors = copy(self), owner.known_errors
        other._errors, other._observer = errors, errors.observer
        other._calibration, other.history = owner.calibration, self.history.copy()
        return other

    @property
    def is_active(self) -> bool:
        """Whether there is a history."""
        return self._settings.relinearization_interval > 0 and not self._is_given_up

    def reset(self, since: str) -> None:
        """Begin a new history with the present estimate; ``since`` says why, in words."""
        self._is_given_up = not self._errors.joint.is_dense
        self._start(self._known(), since)

    def move(self, start: FloatArray, motion: Advanced, interval: Interval) -> None:
        """Note a motion of the robot from a pose (4, 4)."""
        if not self.is_active:
            return
        if self._observer.have_moved and self._observer.u.any():
            # Their ways depend on how the robot was turned, which the smoother does not consider.
            self.reset('a landmark came with a velocity')
            return
        duration_s = (interval.end_ns - interval.start_ns) / NANOSECONDS_PER_SECOND
        drift = self._calibration.drift_covariance * duration_s
        self.history.move(start, motion, drift, self._calibration)

    def slip(self, start: FloatArray, motion: Advanced) -> None:
        """Note a slip from a pose (4, 4), which may not have happened."""
        if self.is_active:
            self.history.slip(start, motion)

    def note_correction(self, before: FloatArray, after: FloatArray) -> None:
        """Note a correction that turned the robot from Â to another (4, 4)."""
        change = (after - before)[:3, :3].ravel()
        half_sine = math.sqrt(change.dot(change) / 8.0)
        turn_rad = 2.0 * math.asin(min(half_sine, 1.0))
        self._turn_squared += turn_rad**2
        self._largest_turn = max(self._largest_turn, turn_rad)

    def know_calibration(self, r: FloatArray, H: FloatArray, R: FloatArray) -> None:
        """Note how far the calibration is off: r = H c̃ + noise, R (q, q)."""
        if not self.is_active:
            return
        # All is linear in it. Where it drifts, so much less is known of it as it was at first.
        history, values = self.history, self._calibration.values
        if self._calibration.drifts:
            R = R + H @ history.drift @ H.T
        weighted = np.linalg.solve(R, H).T
        history.know_calibration(weighted @ H, weighted @ (H @ values - r))

    def add(self, keyframe: Keyframe, in_doubt: bool) -> None:
        """Add a keyframe; relinearise the latest ones if it is time.

        Or if ``in_doubt``: some of its landmarks may have moved. The smoother's marginal becomes
        the filter's covariance, and its solution the observer's new reference ξ°, with â_i = 0.
        This is the summary for the next time.
        """
        if not len(keyframe.rows):  # empty: the motions before and after it add up
            return
        self.history.add(keyframe, self._observer.A.copy(), self._calibration.values)
        self._seen += 1
        self._observations += 1
        if not self._errors.joint.is_dense:
            if self._window_is_full:
                self.reset(CUT)
        elif in_doubt:
            self._relinearise()
            # The landmark may be relocated by this very keyframe, which must be kept for that.
            self._is_overdue = True
        elif self._window_is_full or self._is_due:
            self._sum_up(self._relinearise())

    def mark(self, mark: int, stamp_ns: int) -> None:
        """Mark an observation of landmarks that may be known later by a number."""
        if self.is_active:
            A, values = self._observer.A.copy(), self._calibration.values
            self.history.mark(mark, stamp_ns, A, values)

    def poses_of(self, marks: Iterable[int]) -> list[FloatArray | None]:
        """Return the poses (4, 4) of marked observations; None where that is not known."""
        history = self.history
        return [None if at < 0 else history.poses[at + 1] for at in history.marked(marks)]

    def placed(self, points: FloatArray, seen: Sequence[Keyframe]) -> Placed | None:
        """Return where a landmark is that was ``seen`` in marked observations, near a point (3,).

        By all that was seen since the summary; others (m, 3) that wait as well may follow it. None
        where that is not kept, or leaves it open.
        """
        history, first = self.history, self.history.summarised
        marked = [np.array(history.marked(each.marks)) for each in seen]
        if not (self.is_active and self._errors.joint.is_dense) or marked[0].min() < first:
            return None
        solution = self._solution_from(first)
        row, keyframes = len(solution.points), history.latest_keyframes()
        kept = [i for i, numbers in enumerate(marked) if numbers.min() >= first]
        for at, i in enumerate(kept, row):
            rows = np.full(len(marked[i]), at)
            views = history.as_seen(seen[i]._replace(rows=rows), marked[i] - first)
            keyframes = keyframes.with_more(views)
        solution = replace(
            solution,
            points=np.concatenate([solution.points, points[kept]]),
            orientations=np.concatenate([solution.orientations, np.zeros((len(kept), 3, 3))]),
        )
        try:
            smoother = self._smoother(history.summary, keyframes)
            step, cost = smoother.descend(solution, PLACING_ITERATIONS, COST_TOLERANCE)
            covariance = step.factors.marginal()
        except np.linalg.LinAlgError:
            return None
        # Directions lead there from the poses then, unless this is another minimum.
        found, own = step.end.points[row], seen[0]
        back = se3.inverse(step.end.poses[marked[0] - first + 1])
        lines = back[:, :3, :3] @ found + back[:, :3, 3] - (own.points - own.lines_of_sight)
        ahead = np.einsum('mi,mi->m', lines, own.lines_of_sight)
        if (MEASURED[own.kinds][:, 1] & (ahead < 0.0)).any():
            return None
        (d, k), c = (self._axes.p, self._axes.point), self._calibration.count
        pose = step.end.poses[-1]
        y = se3.transform(se3.inverse(pose), found[None])
        J = np.zeros((k, len(covariance)))
        J[:, :d] = -self._axes.output_matrix(y)[0]
        at = d + c + (k + self._axes.turn) * row
        J[:, at : at + k] = pose[:k, :k].T
        of_sensors = np.eye(len(covariance))[d + self._calibration.of_velocity : d + c]
        joint = np.concatenate([J, of_sensors])
        joint = joint @ covariance @ joint.T
        shared = joint[:k, k:] @ np.linalg.pinv(joint[k:, k:])
        there = se3.transform(history.poses[-1], y)[0]
        return Placed(there, joint[:k, :k] - shared @ joint[k:, :k], cost)

    def enter(self, row: int, seen: Keyframe) -> None:
        """Let marked observations (m,) that are kept be all that a landmark was ``seen`` in."""
        numbers = np.array(self.history.marked(seen.marks))
        if not self.is_active or numbers.min() < 0:
            return
        self.history.attach(row, numbers, seen._replace(rows=np.full(len(numbers), row)))
        if not self._errors.joint.is_dense:
            return
        are_latest = numbers.min() >= self.history.summarised
        if not (are_latest and self._relinearise(ENTRY_ITERATIONS)):
            self.history.summarise(self._known().least_nonlinear(self._axes)[0])
            self._clear_counts()

    def add_calibration(self) -> None:
        """Note entries of the calibration that are estimated from now on."""
        known = len(self.history.calibrations[-1])
        values, variances = self._calibration.values, self._calibration.initial_variances
        if len(values) > known:
            self.history.add_calibration(values[known:], variances[known:])

    def relocate(self, rows: IntArray) -> None:
        """Forget all about landmarks (m,) but their latest observation."""
        self.history.relocate(rows)

    def forget_orientations(self, rows: IntArray) -> None:
        """Forget how landmarks (m,) are turned."""
        self.history.forget_orientations(rows)

    def remove(self, rows: IntArray) -> None:
        """Forget landmarks; those behind move up."""
        self.history.remove(rows)

    def merge(self, rows: IntArray, copies: IntArray) -> None:
        """Take landmarks ``copies`` (m,) for ``rows`` (m,), in a new summary if one has both."""
        were_summed_up = np.min(copies) < len(self.history.summary.points)
        self.history.merge(rows, copies)
        if were_summed_up and self.is_active:
            self.history.summarise(self._known().least_nonlinear(self._axes)[0])
            self._clear_counts()

    def evidence(self) -> float | None:
        """Return −2 ln of the likelihood of all that was seen, relinearised; None if unknown.

        It is of all keyframes, where these are no more than are kept for landmarks that may enter.
        """
        history = self.history
        is_short = 0 < len(history.stamps_ns) <= MOST_AWAITED
        if not (self.is_active and self._errors.joint.is_dense and is_short) or self._axes.turn:
            return None
        try:
            smoother = self._smoother(history.prior, history.keyframes().with_slips())
            step, cost = smoother.descend(
                self._solution_from(0), PLACING_ITERATIONS, COST_TOLERANCE, COST_TOLERANCE
            )
            evidence = smoother.evidence(step, cost)
        except np.linalg.LinAlgError:
            return None
        history.poses[:] = list(step.end.poses)  # from where the next time begins
        return evidence

    def smooth(self) -> tuple[Step, int, History]:
        """Return the last step of smoothing, how many slips it confirms, and what it is of.

        Its estimates are iterated from the present ones, which stay as they are. Raise
        :exc:`ParameterError` if what the smoother takes for constant is not, or no history is
        kept, :exc:`SmoothingError` if the observations don't determine everything.
        """
        if self._settings.relinearization_interval == 0:
            raise ParameterError(NO_HISTORY)
        if self._observer.have_moved:
            raise ParameterError('smoothing takes landmarks to rest; some came with velocities')
        if self._is_given_up:
            raise ParameterError(
                f'nothing can be smoothed in so large a map since {self.history.since}'
            )
        try:
            return *self._smoothed(), self.history
        except np.linalg.LinAlgError as error:
            raise SmoothingError(
                'can not smooth: the observations leave some pose or landmark open, or contradict '
                'covariances that say they are exact'
            ) from error

    def _smoothed(self) -> tuple[Step, int]:
        prior, keyframes = self.history.prior, self.history.keyframes()
        start, slips = self._solution_from(0), 0

        def solve(links: Keyframes, before: Solution) -> Solution:
            smoother = self._smoother(prior, links)
            return smoother.smooth(before, SMOOTHING_ITERATIONS, SLIP_TOLERANCE, gated=False).end

        def motion_errors(links: Keyframes, solution: Solution) -> FloatArray:
            return self._smoother(prior, links).motion_errors(solution)

        if len(keyframes.slips):
            are_slips, start = confirmed_slips(solve, motion_errors, keyframes, start)
            keyframes, slips = keyframes.with_slips(are_slips), int(np.sum(are_slips))
        smoother = self._smoother(prior, keyframes)
        start = self._without_outliers_of_then(smoother, start)
        return smoother.smooth(start, SMOOTHING_ITERATIONS, SMOOTHING_TOLERANCE), slips

    def _start(self, prior: Prior, since: str) -> None:
        self.history = History(self._axes, self._observation_noise, prior, since)
        self._clear_counts()

    def _clear_counts(self) -> None:
        self._observations = 0
        self._turn_squared = self._largest_turn = 0.0
        self._is_overdue = False

    @property
    def _window_is_full(self) -> bool:
        """Whether the history has as many keyframes as it may have."""
        return 0 < self._settings.smoothing_window <= len(self.history.stamps_ns)

    @property
    def _is_due(self) -> bool:
        """Whether corrections have turned far, with enough observations since it last was due."""
        if self._is_overdue:  # a landmark that may have moved kept it from being summed up
            return True
        settings = self._settings
        least = max(
            settings.relinearization_interval, min(SHARE_OF_HISTORY * self._seen, MAX_INTERVAL)
        )
        if 0.0 < settings.relinearization_angle < self._largest_turn:
            least *= EARLY_SHARE
        turned_far = self._turn_squared > settings.relinearization_angle**2
        return turned_far and self._observations >= least

    def _sum_up(self, is_done: bool) -> None:
        """Let the present estimate be the summary of all keyframes, if they were relinearised."""
        self._clear_counts()
        if not (is_done or self._window_is_full):
            return
        known, angle_rad = self._known().least_nonlinear(self._axes)
        history = self.history
        is_short = len(history.stamps_ns) - history.summarised < MOST_AWAITED
        # Whether landmarks may enter that were seen since the summary
        is_awaited = is_short and history.last_mark >= history.summarised
        if self._window_is_full:
            self._start(known, CUT)
        elif is_done and angle_rad < MAX_TURN_RAD and not is_awaited:
            history.summarise(known)

    def _relinearise(self, iterations: int = ITERATIONS) -> bool:
        """Relinearise keyframes after the summary; return whether they determine everything."""
        if len(self._errors.joint.P) - self._errors.joint.first > MAX_UNKNOWNS:
            return False
        # Smooth them, after the summary of those before, …
        history, first = self.history, self.history.summarised
        try:
            smoother = self._smoother(history.summary, history.latest_keyframes())
            start = self._without_outliers_of_then(smoother, self._solution_from(first))
            step = smoother.smooth(start, iterations, TOLERANCE)
            covariance = step.factors.marginal()
        except np.linalg.LinAlgError:
            if not self._warned:
                self._warned.append('not_relinearised')
                logger.warning('%s', found('not_relinearised'))
            return False
        # … and let filter and history go on from the result.
        history.poses[first:] = list(step.end.poses)
        history.calibrations[first:] = list(step.end.calibrations)
        self._take_over(step, covariance)
        return True

    def _take_over(self, step: Step, covariance: FloatArray) -> None:
        """Take the last step's start for the reference; the step is a correction from there.

        The ``covariance`` belongs to that start. At the step's end it would seem to know
        something of the gauge, which is unknown.
        """
        start, end, observer = step.start, step.end, self._observer
        # The reference and its covariance, in the coordinates of the filter.
        observer.set_pose(start.poses[-1])
        observer.set_reference(start.points)
        P = _with_pose_error_by(observer.A, covariance, self._axes)
        self._errors.joint.set_of_positions(P, start.points)
        # The step, as any correction.
        self._calibration.shift(end.calibrations[-1] - self._calibration.values)
        D = end.poses[-1] @ se3.inverse(start.poses[-1])
        observer.correct(D, slice(None), end.points - start.points)
        observer.orientations.B[...] = end.orientations

    def _smoother(self, prior: Prior, keyframes: Keyframes) -> Smoother:
        calibration, sensed = self._calibration, None
        if keyframes.sensed is not None:
            parts = calibration.sensor_columns(keyframes.sensed)
            sensed = SensedPoints(*parts, calibration.count)
        return Smoother(self._axes, prior, keyframes, self._settings, sensed)

    def _without_outliers_of_then(self, smoother: Smoother, start: Solution) -> Solution:
        """Return where iterations begin among tags, given the present estimates."""
        if not self._axes.turn:
            return start
        # The poses are as estimated at their time, the map as estimated now: after a loop was
        # closed many points seen from these poses are far off, and would be taken for outliers.
        return smoother.ungated(start)

    def _solution_from(self, first: int) -> Solution:
        """Return the present estimates, of poses those from before keyframe ``first`` on."""
        poses = np.array(self.history.poses[first:])
        calibrations = np.tile(self._calibration.values, (len(poses), 1))
        if self._calibration.drifts:
            calibrations = np.array(self.history.calibrations[first:])
        observer = self._observer
        return Solution(poses, calibrations, observer.points, observer.orientations.B.copy())

    def _known(self) -> Prior:
        """Return the present estimate as a prior."""
        observer, joint = self._observer, self._errors.joint
        points = observer.points[:0] if self._is_given_up else observer.points
        P = joint.of_robot if self._is_given_up else joint.of_positions(points)
        P = _with_pose_error_by(se3.inverse(observer.A), P, self._axes)
        values = self._calibration.values
        orientations = observer.orientations.B[: len(points)].copy()
        return Prior(observer.A.copy(), values, points, orientations, P)


def _with_pose_error_by(A: FloatArray, P: FloatArray, axes: EstimatedAxes) -> FloatArray:
    """Return the covariance of Ad_A ε and all else, given the one of ε and all else."""
    p = axes.p
    Ad = se3.adjoint(A)[axes.pose, axes.pose]
    changed: FloatArray = P.copy()
    changed[:p] = Ad @ changed[:p]
    changed[:, :p] = changed[:, :p] @ Ad.T
    return changed
