"""How X̂ on SLAM_n(3) is advanced, corrected and extended, and the covariance of its errors.

Gains that know no joint covariance have no errors, and what a subclass of :class:`Gains` does not
override is right where no noise is known. Landmarks are given by rows (m,), points (m, 3) in the
body frame, metres, with covariances (m, 3, 3), m², and how the points change with the calibration,
D (m, 3, c), reference frame; None where they don't.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from copy import copy
import math
from typing import ClassVar, Protocol, TYPE_CHECKING

import numpy as np

from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.filter import core, step
from slam_observer_ros.filter.arrays import SeenOrientations
from slam_observer_ros.filter.flat_arrays import (
    Advanced,
    FilterState,
    Interval,
    Limits,
    Observed,
    Seen,
    Tuning,
)
from slam_observer_ros.filter.joint_covariance import JointCovariance
from slam_observer_ros.filter.known_landmarks import KnownLandmarks
from slam_observer_ros.filter.observer import Observer, Residuals
from slam_observer_ros.lie.axes import EstimatedAxes
from slam_observer_ros.lie.matrices import mahalanobis, with_blocks
from slam_observer_ros.models.calibration import Calibration
from slam_observer_ros.models.held_velocities import Velocities
from slam_observer_ros.models.motion_noise import MotionNoise
from slam_observer_ros.models.point_noise import PointFigures

if TYPE_CHECKING:
    from typing_extensions import Self

OF_CONSTANT_GAINS = ('gain_l', 'step_mode', 'max_innovation_time')
"""Settings without effect on other gains; ``gain_k`` is in the Lyapunov value of all."""


class Errors:
    """The errors of X̂, as the covariance P, ``joint``, of gains that know it has them.

    They are in the reference frame; covariances are in m² and rad².
    """

    observer: Observer
    joint: JointCovariance
    axes: EstimatedAxes

    def pose_covariance(self) -> FloatArray:
        """Return the covariance (6, 6) of ε in Â = exp(ε) A; zero on axes not estimated."""
        return self.axes.full_pose_covariance(self.joint.pose)

    def landmark_covariances(self, duration_s: float = 0.0) -> FloatArray:
        """Return those (n, 3, 3) of ã_i, when landmarks have moved on for ``duration_s``."""
        points = self.observer.points + duration_s * self.observer.u
        return self.joint.landmarks(points, duration_s)

    def joint_covariance(self, rows: IntArray) -> FloatArray | None:
        """Return the covariance (p + m k, p + m k) of ε and ã_i; None in an exact map."""
        return self.joint.with_pose(rows, self.observer.points[rows])

    def orientation_matrices(self, rows: IntArray) -> FloatArray:
        """Return orientations B̂_i (m, 3, 3) of landmarks, zero where there is none."""
        return self.joint.turned(rows, self.observer.orientations.B[rows])

    def orientation_sigmas(self, rows: IntArray) -> FloatArray:
        """Return standard deviations (m,) of orientations about the axis of the largest, rad."""
        if self.observer.is_exact:
            sigmas: FloatArray = self.observer.orientations.map_sigmas[rows]
            return sigmas
        largest = np.linalg.eigvalsh(self.joint.own_turns(rows))[:, -1]
        return np.asarray(np.sqrt(np.maximum(largest, 0.0)))

    def distances(self, residuals: Residuals) -> FloatArray:
        """Return the Mahalanobis distance (m,) of each residual."""
        return mahalanobis(residuals.on(self.axes)[0], self.own_innovation_covariances(residuals))

    def own_innovation_covariances(self, residuals: Residuals) -> FloatArray:
        """Return the covariance (m, k, k) of each residual alone, noise included."""
        C = self.joint.output_matrix(residuals, chord=0.5)
        return self.joint.output(C, residuals.rows)[1] + residuals.on(self.axes)[1]

    def innovation_covariance(self, residuals: Residuals) -> FloatArray:
        """Return the joint covariance (m k, m k) of residuals, noise included."""
        return with_blocks(self.predicted(residuals)[1], residuals.on(self.axes)[1])

    def predicted(self, residuals: Residuals) -> tuple[FloatArray, FloatArray]:
        """Return what P predicts of m residuals: with ε (p, m k), and their own (m k, m k)."""
        C = self.joint.output_matrix(residuals, chord=0.5)
        return self.joint.outputs(C, residuals.rows)


class TagGains(Protocol):
    """What moves X̂ by how tags are turned."""

    def learn_motion_noise(self, residuals: Residuals) -> None:
        """Let residuals show how noisy the motion was, before orientations correct it."""

    def correct_by_orientations(self, seen: SeenOrientations) -> tuple[FloatArray, BoolArray]:
        """Move the state by known orientations; return weights (m,), and which are unclear."""

    def clear_turns(self, seen: SeenOrientations) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return φ_i (m, q), their noise (m, q, q), and which (m,) are not of flipped twins."""

    def add_orientations(self, seen: SeenOrientations) -> None:
        """Take over orientations as they are seen, where none is known yet."""


class Gains(ABC):
    """What moves an ``observer``'s X̂, by a calibration and a noise of motions."""

    ignores: ClassVar[tuple[str, ...]] = ()  # settings without effect
    estimates_calibration: ClassVar[bool] = False
    joint: JointCovariance | None = None  # P, if it is known

    def __init__(
        self,
        tuning: Tuning,
        observer: Observer,
        calibration: Calibration,
        motion_noise: MotionNoise,
    ) -> None:
        self._tuning, self.axes = tuning, calibration.axes  # what of pose and points is estimated
        self.observer = observer  # X̂ and its reference ξ°
        self.calibration, self.motion_noise = calibration, motion_noise

    def copy(self) -> Self:
        """Return an independent copy."""
        other = copy(self)
        other.observer = self.observer.copy()
        other.calibration = self.calibration.of(other.observer)
        other.motion_noise = self.motion_noise.copy()
        return other

    @property
    def tags(self) -> TagGains | None:
        """What moves it by orientations of tags; None where only their positions are used."""
        return None

    @property
    def errors(self) -> Errors | None:
        """Itself, if it knows the covariance of pose and landmarks together."""
        return None

    # The step (27)-(31)

    def flat(self) -> FilterState:
        """Return the estimate as plain arrays: of the landmarks in P, or all of an exact map."""
        observer, calibration, joint = self.observer, self.calibration, self.joint
        rows: IntArray | slice = slice(None)
        if joint is None:  # as of an exact map
            P, size = np.zeros((self._robot, self._robot)), self._robot
            first, stride, u = size, 0, None
        else:
            P, size = observer.covariance._storage, observer.covariance._size
            first, stride = joint.first, 0 if observer.is_exact else joint.chart.stride
            rows = rows if observer.is_exact else joint.active
            u = observer.u if joint.chart.velocity else None
        return FilterState(
            observer.A,
            observer.y_ref[rows],
            observer.a[rows],
            P,
            size,
            first,
            stride,
            self.axes.is_planar,
            calibration.rates,
            calibration.velocity_places,
            calibration.drift_covariance,
            u,
        )

    @property
    def _robot(self) -> int:
        """How many errors the robot and the calibration have: p + c."""
        return self.axes.p + self.calibration.count

    def advance(self, velocities: Velocities, interval: Interval) -> Advanced:
        """Move pose and landmarks along velocities (27); return what that did."""
        joint = self.joint
        if self.observer.have_moved:  # else this would cost O(n) at every step
            duration_s = to_s(interval.end_ns - interval.start_ns)
            self.observer.a += self.observer.u * duration_s  # (27) has zero, here they move (19)
        if joint is not None and (joint.chart.velocity or not joint.is_dense):
            joint.note_motion(to_s(interval.end_ns - interval.start_ns))
        x, out = self.flat(), self._room_for_motion()
        status = core.advance(x, velocities, interval, self.motion_noise.figures, out)
        x.A[...] = out.A
        if joint is not None:
            shares = np.array([out.of_turning, out.noise - out.of_turning])
            self.motion_noise.factors.move(None if status == step.AT_REST else shares)
        return out

    def slip(self, A: FloatArray, covariance: FloatArray) -> Advanced:
        """Let the robot be at Â = ``A`` (4, 4): :func:`.step.slip`."""
        if self.joint is not None:
            self.joint.note_motion(0.0)
        x, out = self.flat(), self._room_for_motion()
        step.slip(x, A, covariance, out)
        x.A[...] = out.A
        self.motion_noise.factors.move(None)
        return out

    def led_to(
        self, velocities: Iterable[Velocities], intervals: Iterable[Interval]
    ) -> tuple[FloatArray, FloatArray]:
        """Return Â (s, 4, 4) and covariances (s, 6, 6) of ε after motions, none of which is made.

        Each is along other velocities. Zero on axes that are not estimated, and without errors.
        """
        known, p = np.zeros((self._robot, self._robot)), self.axes.p
        if self.joint is not None:
            known = self.joint.of_robot
        x, out = self._alone(self.observer.A), self._room_for_motion()
        A, covariances = [], []
        for each, interval in zip(velocities, intervals, strict=True):
            x.P[...] = known
            core.advance(x, each, interval, self.motion_noise.figures, out)
            A.append(out.A.copy())
            covariances.append(x.P[:p, :p].copy())
        return np.array(A), self.axes.full_pose_covariance(np.array(covariances))

    def effect(self, A: FloatArray, velocities: Velocities, interval: Interval) -> Advanced:
        """Return the effect of a motion from Â = ``A`` (4, 4), which is not made."""
        out = self._room_for_motion()
        core.advance(self._alone(A), velocities, interval, self.motion_noise.figures, out)
        return out

    def _alone(self, A: FloatArray) -> FilterState:
        """Return a robot at ``A`` without landmarks and without errors as plain arrays."""
        none, size, calibration = np.empty((0, 3)), self._robot, self.calibration
        return FilterState(
            A=A,
            y_ref=none,
            a=none,
            P=np.zeros((size, size)),
            size=size,
            first=size,
            stride=0,
            is_planar=self.axes.is_planar,
            rates=calibration.rates,
            estimated=calibration.velocity_places,
            drift=calibration.drift_covariance,
            u=None,
        )

    def _room_for_motion(self) -> Advanced:
        p, c = self.axes.p, self.calibration.count
        return Advanced(
            A=np.empty((4, 4)),
            noise=np.empty((p, p)),
            of_turning=np.empty((p, p)),
            sensitivity=np.empty((p, c)),
            at_end=np.empty(6),
            variances=np.empty(6),
        )

    @abstractmethod
    def observe(
        self, seen: Seen, figures: PointFigures, limits: Limits, is_judged: bool
    ) -> Observed | None:
        """Move the state by the innovation (28)–(31) of landmarks ``rows`` that are seen.

        Return what that did, and how far off they were if ``is_judged``. None, with nothing
        changed, where most are rejected and that may be refused.
        """

    def know_calibration(  # noqa: B027 (constant gains estimate none)
        self, r: FloatArray, H: FloatArray, R: FloatArray
    ) -> None:
        """Move the state by how far a calibration is off: r = H c̃ + noise, R (q, q)."""

    def activate(self, rows: IntArray) -> None:  # noqa: B027 (most gains treat all alike)
        """See to it that landmarks (m,) are at hand that are going to be observed."""

    def residuals(
        self,
        rows: IntArray,
        points: FloatArray,
        covariances: FloatArray,
        dt_s: FloatArray,
        repeated: FloatArray,
        D: FloatArray | None = None,
    ) -> Residuals:
        """Return what landmarks ``rows`` (m,) say against X̂ (29).

        ``dt_s`` (m,) is the time since each was last seen, and ``repeated`` (m,) the factor by
        which the covariances grow, as errors last.
        """
        self.activate(rows)
        observer = self.observer
        e, r = observer.errors(rows, points)
        turned = observer.turned(covariances)
        return Residuals(rows, e, r, observer.a[rows], turned, dt_s, repeated, D)

    # Landmarks and sensors

    def add(
        self, points: FloatArray, covariances: FloatArray, D: FloatArray | None = None
    ) -> None:
        """Append landmarks seen for the first time."""
        self.observer.add_landmarks(points)

    def add_known(self, known: KnownLandmarks) -> None:
        """Append landmarks that a map knows, reference frame; their errors may be correlated."""
        self.observer.add_reference_landmarks(known.points)

    def relocate(
        self,
        rows: IntArray,
        points: FloatArray,
        covariances: FloatArray,
        D: FloatArray | None = None,
    ) -> None:
        """Take landmarks for new ones, seen for the first time."""
        self.observer.relocate_landmarks(rows, points)

    def remove(self, rows: IntArray) -> None:
        """Forget the landmarks at ``rows``; those behind move up."""
        self.observer.remove_landmarks(rows)

    def merge(self, rows: IntArray, copies: IntArray, most: float) -> float:
        """Take landmarks ``copies`` (m,) for ``rows`` (m,) if they fit, and forget the copies.

        Return the normalised square of how far they are apart, per axis; they fit up to ``most``.
        """
        return math.inf  # for all that is known

    def fix_landmarks(self, known: KnownLandmarks) -> None:
        """Take all landmarks for exact and at rest where a map has them; never move them."""
        self.observer.fix_landmarks(known.points)

    def calibrate(self, of: str | int) -> None:
        """Let the calibration of another frame's sensor be part of the state: see Calibration."""
        self.calibration.add(of)

    # The frame

    def set_pose(self, pose: FloatArray, covariance: FloatArray) -> None:
        """Put the robot at Â = ``pose`` (4, 4), ε of ``covariance`` (6, 6) independent of all."""
        self.observer.set_pose(pose)

    @abstractmethod
    def anchor(self, rows: IntArray, r: FloatArray, covariances: FloatArray) -> None:
        """Move the whole estimate to where m of its landmarks are known to be.

        ``r`` (m, 3) is estimated minus known, reference frame; covariances are of the known ones.
        """

    def enter_map(self, rows: IntArray, known: KnownLandmarks) -> None:
        """Move the estimate to where a map has landmarks ``rows`` (m,), and append its others.

        ``known`` (m + …) are these m in the reference frame, then the others. Where no joint
        covariance is known the map's errors are taken to be independent.
        """
        m = len(rows)
        of_rows, others = (known.select(part) for part in np.split(np.arange(len(known)), [m]))
        r = self.observer.points[rows] - of_rows.points
        self.anchor(rows, r, of_rows.covariances)
        self.observer.set_reference(self.observer.points)
        self.add_known(others)

    # The errors, by any gains

    @property
    def calibration_variances(self) -> FloatArray:
        """(c,) variances of the calibration's estimates."""
        return np.empty(0)

    @property
    def takes_all(self) -> bool:
        """Whether an observation changes the covariances of all landmarks, however many."""
        return False

    def joint_covariance(self, rows: IntArray) -> FloatArray | None:
        """Return the covariance (p + m k, p + m k) of ε and ã_i of m landmarks, if it is known."""
        return None

    def landmark_covariance(self, rows: IntArray, tags: IntArray) -> FloatArray | None:
        """Return that (m k + t q) of ã_i of ``rows`` (m,) and ω_i of ``tags`` (t,), if known."""
        return None

    def innovation_covariance(self, residuals: Residuals) -> FloatArray:
        """Return the joint covariance (m k, m k) of residuals; (0, 0) where none is known."""
        return np.empty((0, 0))

    def distances(self, residuals: Residuals) -> FloatArray:
        """Return the Mahalanobis distance (m,) of each residual; zero if no noise is known."""
        return np.zeros(len(residuals.r))


def room_for(seen: Seen, size: int, is_judged: bool) -> Observed:
    """Return room for the effect of an observation on a state of N = ``size`` errors."""
    m = len(seen.rows)
    return Observed(
        A=np.empty((4, 4)),
        points=np.empty((m, 3)),
        r=np.empty((m, 3)),
        weights=np.empty(m),
        origins=np.empty((m, 3)),
        lines_of_sight=np.empty((m, 3)),
        covariances=np.empty((0 if seen.covariances is None else m, 3, 3)),
        repeated=np.empty(m),
        moved=np.empty(size),
        judged=np.zeros(3 * m + 1 if is_judged else 0),
    )
