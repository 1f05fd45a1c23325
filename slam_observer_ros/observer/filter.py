"""What all filters have in common: the state X̂ on SLAM_n(3), and what is known of its errors.

Both live and change together. What a filter does not override is right for one that knows no
noise. Covariances are those of errors in the reference frame, m² and rad²; None where a filter
knows none.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.axes import axes_of
from slam_observer_ros.observer.observer import Observer
from slam_observer_ros.observer.residuals import Residuals
from slam_observer_ros.observer.riccati.joint_covariance import JointCovariance
from slam_observer_ros.sensor_models.calibration import Calibration
from slam_observer_ros.sensor_models.motion import Motion
from slam_observer_ros.settings.estimator_settings import Settings

OF_CONSTANT_GAINS = ('gain_l', 'step_mode', 'max_innovation_time')
"""Settings without effect on other filters; ``gain_k`` is in the Lyapunov value of all."""


class Filter:
    """X̂ and what is known of its errors; a subclass sets the gains of the innovation.

    Parameters
    ----------
    settings : Settings
        The settings in force.
    reference_pose : FloatArray
        (4, 4) P°, body to world.

    Attributes
    ----------
    observer : Observer
        X̂ and its reference ξ°.
    calibration : Calibration
        Scale, bias and delay of the velocity, as far as they are known.
    axes : EstimatedAxes
        What of the pose and of points is estimated.
    joint : JointCovariance or None
        The covariance of the errors of pose and landmarks together, where it is kept.
    has_joint_covariance : bool
        Whether it is, so that observations can be judged by it, as association does.
    ignores : tuple of str
        Settings without effect on the filter.

    """

    joint: JointCovariance | None = None
    has_joint_covariance: ClassVar[bool] = False
    ignores: ClassVar[tuple[str, ...]] = ()

    def __init__(self, settings: Settings, reference_pose: FloatArray) -> None:
        self._settings = settings
        self.axes = axes_of(settings.two_d_mode)
        self.observer = Observer(reference_pose)
        self.calibration = Calibration(settings, self.axes)

    # The step (27)-(31)

    def propagate(self, motion: Motion) -> None:
        """Move pose and landmarks along a motion (27), and account for its noise."""
        self.observer.propagate(motion.path)
        self.observer.move_landmarks(motion.duration_s)

    def residuals(
        self, rows: IntArray, points: FloatArray, covariances: FloatArray, dt_s: FloatArray
    ) -> Residuals:
        """Return what landmarks ``rows`` (m,) seen at ``points`` (m, 3) say against X̂ (29).

        Points and their ``covariances`` (m, 3, 3) are in the body frame, m and m²; ``dt_s`` (m,)
        are the seconds since each was seen before. :meth:`expected_points` has been asked for
        them: a filter that postpones moves of landmarks moves them there.
        """
        observer = self.observer
        e, r = observer.errors(rows, points)
        return Residuals(rows, e, r, observer.a[rows], observer.turned(covariances), dt_s)

    def correct(self, residuals: Residuals) -> FloatArray:
        """Move the state by the innovation (28)–(31); return the weights (m,), 0 for rejected."""
        raise NotImplementedError

    # Landmarks

    def add(self, points: FloatArray, covariances: FloatArray) -> None:
        """Append landmarks seen for the first time at ``points`` (m, 3), body frame."""
        self.observer.add_landmarks(points)

    def add_known(self, y_ref: FloatArray, covariances: FloatArray) -> None:
        """Append landmarks that a map has at ``y_ref`` (m, 3), reference frame."""
        self.observer.add_reference_landmarks(y_ref)

    def relocate(self, rows: IntArray, points: FloatArray, covariances: FloatArray) -> None:
        """Take landmarks for new ones, seen for the first time at ``points``, body frame."""
        self.observer.relocate_landmarks(rows, points)

    def remove(self, rows: IntArray) -> None:
        """Forget the landmarks at ``rows``; those behind move up."""
        self.observer.remove_landmarks(rows)

    def fix_landmarks(self, y_ref: FloatArray, covariances: FloatArray) -> None:
        """Take all landmarks for exact and at rest at ``y_ref`` (n, 3), and never move them.

        ``covariances`` (n, 3, 3) are what the map says of them, which is only passed on.
        """
        self.observer.fix_landmarks(y_ref)

    def expected_points(self, rows: IntArray) -> FloatArray:
        """Return where landmarks should be seen (m, 3), metres, body frame; −1 for a new one."""
        return self.observer.body_points(rows)

    # The frame

    def set_pose(self, pose: FloatArray, covariance: FloatArray) -> None:
        """Put the robot at Â = ``pose`` (4, 4), ε of ``covariance`` (6, 6) independent of all."""
        self.observer.A = pose

    def anchor(self, rows: IntArray, r: FloatArray, covariances: FloatArray) -> None:
        """Move the whole estimate to where m of its landmarks are known to be.

        ``r`` (m, 3) are estimated minus known positions, metres, reference frame; ``covariances``
        (m, 3, 3) those of the known positions, m².
        """
        raise NotImplementedError

    # What is known of the errors

    @property
    def world_points(self) -> FloatArray:
        """(n, 3) estimated landmarks, metres, world."""
        return se3.transform(self.observer.reference_pose, self.points)

    @property
    def points(self) -> FloatArray:
        """(n, 3) the same in the reference frame."""
        return self.observer.points

    @property
    def calibration_variances(self) -> FloatArray:
        """(c,) variances of what is estimated of the calibration."""
        return np.empty(0)

    def pose_covariance(self, motion: Motion | None = None) -> FloatArray | None:
        """Return the covariance (6, 6) of ε in Â = exp(ε) A; after a motion that is yet to be."""
        return None

    def landmark_covariances(self, duration_s: float = 0.0) -> FloatArray | None:
        """Return those (n, 3, 3) of ã_i, when landmarks have moved on for ``duration_s``."""
        return None

    def joint_covariance(self, rows: IntArray) -> FloatArray | None:
        """Return the covariance (p + m k, p + m k) of ε and ã_i of m landmarks."""
        return None

    def configuration_covariance(self, rows: IntArray) -> FloatArray | None:
        """Return the covariance (m k, m k) of where m landmarks are seen from the robot, m².

        Joint, along the axes of the body that are estimated. The choice of the world's frame has
        no part in it.
        """
        P, axes = self.joint_covariance(rows), self.axes
        if P is None:
            return None
        m, k, p = len(rows), axes.point, axes.p
        C = axes.output_matrix(self.points[rows]).reshape(-1, p)
        CP = C @ P[:p] - P[p:]
        blocks = (CP[:, :p] @ C.T - CP[:, p:]).reshape(m, k, m, k).swapaxes(1, 2)
        R = self.observer.A[:k, :k]
        seen: FloatArray = (R.T @ blocks @ R).swapaxes(1, 2).reshape(m * k, m * k)
        return seen

    def distances(self, residuals: Residuals) -> FloatArray:
        """Return the Mahalanobis distance (m,) of each residual; zero if no noise is known."""
        return np.zeros(len(residuals.r))

    def predicted(self, residuals: Residuals) -> tuple[FloatArray, FloatArray]:
        """Return what a joint covariance predicts of m residuals, but for the points' noise.

        Their covariances (p, m k) with ε, and their own, (m k, m k).
        """
        raise NotImplementedError
