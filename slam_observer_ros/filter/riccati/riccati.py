"""The Riccati filter: gains K = P Hᵀ (H P Hᵀ + R)⁻¹ from the covariance P of all errors.

The error E = X̂ X⁻¹ (proof of Theorem 5.1) does not move while the robot does. In the coordinates
of :mod:`.joint_covariance` the residual (33) is r_i = H_i x with the same H_i for any map,

    H_i = [ 0  I  0 … −I … 0 ],

with R̂ D_i besides at the calibration of the sensor that saw it (:mod:`.calibration`). The
choice of the world's frame, which no observation can determine, is exactly in its null space: the
covariance stays honest. This is the right-invariant EKF on SE_{n+1}(3), which acts on
X̂ ∈ SLAM_n(3) by X̂ ← exp(−K r) · X̂. An observation of m of n landmarks costs O(m n²),
in large maps less: :class:`.CompressedCovariance`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.filter import core, step
from slam_observer_ros.filter.arrays import UNKNOWN_RAD
from slam_observer_ros.filter.chart import Chart
from slam_observer_ros.filter.flat_arrays import Limits, Observed, Seen, Tuning
from slam_observer_ros.filter.gains import OF_CONSTANT_GAINS, room_for
from slam_observer_ros.filter.joint_covariance import JointCovariance
from slam_observer_ros.filter.known_landmarks import anchor, KnownLandmarks
from slam_observer_ros.filter.landmark_table import Landmarks
from slam_observer_ros.filter.observer import Observer
from slam_observer_ros.filter.riccati.active_landmarks import BlockSize
from slam_observer_ros.filter.riccati.covariances import CompressedCovariance, ExactMapCovariance
from slam_observer_ros.filter.riccati.orientation_gains import OrientationGains
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.matrices import block_diagonal, solve_symmetric
from slam_observer_ros.models.calibration import Calibration
from slam_observer_ros.models.motion_noise import MotionNoise
from slam_observer_ros.models.point_noise import PointFigures

if TYPE_CHECKING:
    from typing_extensions import Self

MERGER_ROUNDS = 4  # how often a merger is linearised; the last times it hardly changes

SAME_M = 0.01
"""Standard deviation of how far apart two landmarks may be that are one, metres: no two views of
a thing have quite the same centre.
"""


class RiccatiGains(OrientationGains):
    """Gains from the full covariance P, ``joint``, of pose, calibration and landmarks."""

    ignores = OF_CONSTANT_GAINS
    estimates_calibration = True
    block = BlockSize()  # of large maps

    def __init__(
        self,
        tuning: Tuning,
        observer: Observer,
        calibration: Calibration,
        motion_noise: MotionNoise,
    ) -> None:
        super().__init__(tuning, observer, calibration, motion_noise)
        # Beside its position a landmark's velocity is estimated, or the orientation of a tag at
        # rest; both are unknown at first.
        speed = tuning.landmark_velocity_stddev
        velocity = self.axes.point if speed else 0
        has_turns = tuning.use_tag_orientation and not speed
        axes = self.axes if has_turns else self.axes.of_points()
        unknown = [UNKNOWN_RAD] * axes.turn + [speed] * velocity
        joint = JointCovariance(
            Chart(axes, self.calibration.count, velocity),
            self.observer.covariance,
            self.calibration.initial_covariance(),
            np.array(unknown) ** 2,
        )
        self.joint = joint

    def copy(self) -> Self:
        """Return an independent copy."""
        other = super().copy()
        other.joint = self.joint.copy(other.observer)
        return other

    def observe(
        self, seen: Seen, figures: PointFigures, limits: Limits, is_judged: bool
    ) -> Observed | None:
        """Move the state, and P with it, by the innovation (28)–(31): :func:`.step.observe`."""
        observer, joint, factors = self.observer, self.joint, self.motion_noise.factors
        known, table = seen.rows >= 0, observer.landmarks
        rows = seen.rows[known]
        if not joint.is_dense:
            joint.activate(rows)
            places = np.full(len(known), -1)
            places[known] = joint.places(rows)
            seen = seen._replace(rows=places)
        x, learnt = self.flat(), factors.flat() if len(rows) else None
        columns = table.counts, table.rejections, table.last_seen_ns, table.seen_before_ns
        in_arrays = joint.active
        if observer.is_exact:
            in_arrays = slice(None)
        landmarks = Landmarks(*[column[in_arrays] for column in columns])
        out = room_for(seen, x.size, is_judged)
        if core.observe(x, landmarks, seen, figures, limits, learnt, out) == step.REJECTS:
            return None
        if len(rows):
            factors.take(learnt)
        if isinstance(in_arrays, np.ndarray):  # else they are views, changed in place
            observer.a[in_arrays] = x.a
            for column, changed in zip(columns, landmarks, strict=True):
                column[in_arrays] = changed
        before = x.A.copy()
        x.A[...] = out.A
        if not joint.is_dense:
            joint.follow(out.moved)
        self._move_others(out.moved, before)
        return out

    def know_calibration(self, r: FloatArray, H: FloatArray, R: FloatArray) -> None:
        """Move the state by how far a calibration is off: r = H c̃ + noise, R (q, q)."""
        joint, of_c = self.joint, slice(self.axes.p, self.joint.chart.robot)
        HP = H @ joint.P[of_c]
        self._move(-joint.update(HP, HP[:, of_c] @ H.T + R, r))

    def activate(self, rows: IntArray) -> None:
        """See to it that landmarks (m,) are in P."""
        self.joint.activate(rows)

    def calibrate(self, of: str | int) -> None:
        """Let the calibration of another frame's sensor be part of the state, and of P."""
        variances = self.calibration.add(of)
        if len(variances):
            self.joint = self.joint.dense()
            self.joint.add_calibration(variances)
            self._compress_if_large(0)

    def add(
        self, points: FloatArray, covariances: FloatArray, D: FloatArray | None = None
    ) -> None:
        """Append landmarks seen for the first time."""
        self._compress_if_large(len(points))
        super().add(points, covariances)
        self.motion_noise.factors.forget_motion()  # until now, which is none of theirs
        self.joint.add_seen(self.observer.turned(covariances), D)

    def add_known(self, known: KnownLandmarks) -> None:
        """Append landmarks whose errors are independent of all else, or only of all others."""
        if known.joint is None:
            self._compress_if_large(len(known))
            self.joint.add_known(known.points, known.covariances)
        else:
            self.joint = self.joint.dense()
            self.joint.add_correlated(known)
        super().add_known(known)
        n = len(self.observer)
        self.take_orientations(np.arange(n - len(known), n), known)
        self._compress_if_large(0)

    def relocate(
        self,
        rows: IntArray,
        points: FloatArray,
        covariances: FloatArray,
        D: FloatArray | None = None,
    ) -> None:
        """Take landmarks for new ones; what was known of them is forgotten."""
        self.joint.activate(rows)
        super().relocate(rows, points, covariances)
        self.joint.relocate(rows, self.observer.turned(covariances), D)

    def remove(self, rows: IntArray) -> None:
        """Forget the landmarks at ``rows``."""
        self.joint.remove(rows)
        super().remove(rows)

    def fix_landmarks(self, known: KnownLandmarks) -> None:
        """Take all landmarks for exact; P has pose and calibration from now on."""
        super().fix_landmarks(known)
        self.joint = ExactMapCovariance(self.joint, known.covariances)
        self.observer.postponed = None
        self.take_orientations(np.arange(len(known)), known)

    def set_pose(self, pose: FloatArray, covariance: FloatArray) -> None:
        """Put the robot at Â = ``pose``; its correlation with the map is forgotten."""
        super().set_pose(pose, covariance)
        self.motion_noise.factors.forget_motion()
        self.joint.set_pose(covariance[self.axes.pose, self.axes.pose], self.observer.points)

    def anchor(self, rows: IntArray, r: FloatArray, covariances: FloatArray) -> None:
        """Move the whole estimate, of unknown gauge γ, to where landmarks are known to be."""
        # A motion exp(γ) of everything changes x by G γ, and the positions of the known landmarks
        # by J γ.
        self.joint = joint = self.joint.dense()
        k = self.axes.point
        G = joint.chart.gauge(len(self.observer))
        J = joint.chart.moved(self.observer.points[rows]).reshape(-1, self.axes.p)
        # What P says of these positions, and the map's noise.
        HP, HPH = joint.project(joint.chart.still(self.observer.points[rows]), rows)  # of −ã_i
        R = block_diagonal(covariances[:, :k, :k])
        x, joint.P = anchor(joint.P, G, -HP.T, HPH + R, J, r[:, :k].ravel())
        self._move(-x)

    def enter_map(self, rows: IntArray, known: KnownLandmarks) -> None:
        """Move the estimate to where a map has landmarks ``rows`` (m,), and append its others.

        As far as the map's errors are correlated, seeing the m says where the others are, too.
        """
        if known.joint is None:
            super().enter_map(rows, known)
            self.take_orientations(rows, known.select(np.arange(len(rows))))
            return
        # The map beside the estimate, whose gauge γ does not move it, …
        n, m = len(self.observer), len(rows)
        own = self.observer.points[rows]
        self.add_known(known)
        self.joint = joint = self.joint.dense()
        added = n + np.arange(len(known))
        copies = added[:m]
        chart, size = joint.chart, len(self.observer)
        G = chart.gauge(size)
        G[chart.of_landmarks(added)] = 0.0
        G += chart.at_rest(size, added, known.points)
        # … and landmarks that both have are the same.
        H = chart.difference(size, rows, copies, own, known.points[:m])
        PH, r = joint.P @ H.T, (own - known.points[:m])[:, : self.axes.point].ravel()
        x, joint.P = anchor(joint.P, G, PH, H @ PH, H @ G, r)
        self._move(-x)
        self._merge_orientations(rows, copies)
        self.remove(copies)
        self.observer.set_reference(self.observer.points)
        self._compress_if_large(0)

    def merge(self, rows: IntArray, copies: IntArray, most: float) -> float:
        """Take landmarks ``copies`` (m,) for ``rows`` (m,) if they fit, and forget the copies.

        Return the normalised square of how far they are apart, per axis; they fit up to ``most``.
        """
        self.joint = joint = self.joint.dense()
        both, m = np.append(rows, copies), len(rows)
        x, square = np.zeros(len(joint.P)), np.inf
        # At the end of a loop the map may turn so far that it has to be linearised again.
        for _ in range(MERGER_ROUNDS):
            own, other = np.split(self._moved_points(both, -x), [m])
            H = joint.chart.difference(len(self.observer), rows, copies, own, other)
            HP, r = H @ joint.P, (own - other)[:, : self.axes.point].ravel() + H @ x
            S = HP @ H.T + SAME_M**2 * np.eye(len(r))
            weighted = solve_symmetric(S, r)
            x, square = HP.T @ weighted, float(r @ weighted) / len(r)
        if square <= most:
            joint.update(HP, S, r)
            self._move(-x)
            self.observer.landmarks.merge(rows, copies)
            self.remove(copies)
            self.observer.set_reference(self.observer.points)
        self._compress_if_large(0)
        return square

    def _moved_points(self, rows: IntArray, x: FloatArray) -> FloatArray:
        """Return where landmarks (m, 3) would be if the state was moved by exp(x)."""
        X = self.joint.chart.exp(x)
        return np.asarray(se3.rotate(X.A, self.observer.points[rows]) + X.a[rows])

    @property
    def calibration_variances(self) -> FloatArray:
        """(c,) variances of the calibration's estimates."""
        return self.joint.calibration_variances

    def _compress_if_large(self, added: int) -> None:
        """Go on with a covariance for many landmarks, unless they move or P has none of them."""
        # Tags count by their columns: relinearising ends there, too.
        count = (len(self.observer.y_ref) + added) * self.joint.chart.stride / self.axes.point
        is_large = count > self.block.dense
        may_move = self.joint.chart.velocity > 0 or self.observer.have_moved
        if self.joint.is_dense and is_large and not may_move:
            self.joint = CompressedCovariance(self.joint, self.observer, self.block)

    def _move(self, x: FloatArray) -> None:
        X, observer, moved = self.joint.chart.exp(x), self.observer, self.joint.active
        before = observer.A.copy()
        turned = se3.rotate(X.A, observer.y_ref[moved]) - observer.y_ref[moved]
        observer.correct(X.A, moved, X.a + turned)
        self._move_others(x, before)

    def _move_others(self, x: FloatArray, before: FloatArray) -> None:
        """Let calibration, orientations and velocities follow exp(x), Â moved from ``before``."""
        chart, axes, moved = self.joint.chart, self.axes, self.joint.active
        self.calibration.shift(x[axes.p : chart.robot])
        if chart.stride == axes.point:
            return
        of_landmarks = x[chart.first :].reshape(-1, chart.stride)
        if chart.turn:
            turns = axes.full_turns(of_landmarks[:, axes.point : axes.point + chart.turn])
            self.observer.orientations.turn(moved, so3.exp(turns))
        if chart.velocity:
            change = axes.full_points(of_landmarks[:, -chart.velocity :])
            D = self.observer.A @ se3.inverse(before)
            self.observer.correct_velocities(D, moved, change)
