"""What all filters have in common: the state X̂ on SLAM_n(3), and what is known of its errors.

Both live and change together. What a filter does not override is right for one that knows no
noise. Covariances are those of errors in the reference frame, m² and rad²; None where a filter
knows none. Landmarks are given by rows (m,), points (m, 3) in the body frame, metres, with
covariances (m, 3, 3), m².
"""

from __future__ import annotations

from copy import copy
import math
from typing import ClassVar, TYPE_CHECKING

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.axes import axes_of
from slam_observer_ros.observer.configuration import turned_moment
from slam_observer_ros.observer.known_landmarks import KnownLandmarks
from slam_observer_ros.observer.observer import Observer
from slam_observer_ros.observer.orientations import SeenOrientations
from slam_observer_ros.observer.residuals import Residuals, SeenPoints
from slam_observer_ros.observer.riccati.joint_covariance import JointCovariance
from slam_observer_ros.sensor_models.calibration import Calibration, without_sensor_calibration
from slam_observer_ros.sensor_models.motion import Motion, Passage
from slam_observer_ros.sensor_models.motion_noise import MotionNoise
from slam_observer_ros.settings.estimator_settings import Settings

if TYPE_CHECKING:
    from typing_extensions import Self

OF_CONSTANT_GAINS = ('gain_l', 'step_mode', 'max_innovation_time')
"""Settings without effect on other filters; ``gain_k`` is in the Lyapunov value of all."""


OF_JOINT_COVARIANCES = (
    'motion_noise_factor',
    'sensor_rotation_stddev',
    'sensor_translation_stddev',
    'range_scale_stddev',
)
"""Settings of what only a joint covariance can estimate."""


class Filter:
    """X̂, starting at ``reference_pose`` P° (4, 4), and its errors; a subclass sets gains."""

    # The covariance of the errors of pose and landmarks together, where it is kept, and whether
    # it is: only by that can association judge observations.
    joint: JointCovariance | None = None
    has_joint_covariance: ClassVar[bool] = False
    ignores: ClassVar[tuple[str, ...]] = ()  # settings without effect on the filter
    # Whether orientations of tags are; else only their positions are used.
    estimates_orientations: bool = False

    def __init__(self, settings: Settings, reference_pose: FloatArray) -> None:
        self._settings = settings
        self.axes = axes_of(settings.two_d_mode)  # what of pose and points is estimated
        self.observer = Observer(reference_pose)  # X̂ and its reference ξ°
        self.orientations = self.observer.orientations  # of tags; none where not estimated
        self.is_exact = False  # the map: no landmark is moved
        estimated = settings if self.has_joint_covariance else without_sensor_calibration(settings)
        self.calibration = Calibration(estimated, self.axes)  # of velocities and sensors
        self.motion_noise = MotionNoise(settings)

    def copy(self) -> Self:
        """Return an independent copy."""
        other = copy(self)
        other.observer = self.observer.copy()
        other.orientations = other.observer.orientations
        other.calibration = self.calibration.copy()
        other.motion_noise = self.motion_noise.copy()
        return other

    # The step (27)-(31)

    def propagate(self, motion: Motion) -> None:
        """Move pose and landmarks along a motion (27), and account for its noise."""
        self.observer.propagate(motion.path)
        self.observer.move_landmarks(motion.duration_s)

    def residuals(self, rows: IntArray, seen: SeenPoints, dt_s: FloatArray) -> Residuals:
        """Return what landmarks ``rows`` (m,) say against X̂ (29).

        ``dt_s`` (m,) is the time since each was last seen.
        """
        # A filter that postpones moves of landmarks has made them for :meth:`expected_points`.
        observer = self.observer
        e, r = observer.errors(rows, seen.points)
        R = observer.turned(seen.covariances)
        return Residuals(rows, e, r, observer.a[rows], R, dt_s, seen.D)

    def correct(self, residuals: Residuals) -> FloatArray:
        """Move the state by the innovation (28)–(31); return the weights (m,), 0 for rejected."""
        raise NotImplementedError

    def learn_motion_noise(self, residuals: Residuals) -> None:
        """Let residuals show how noisy the motion was, if something else than them corrects it."""

    def correct_by_orientations(self, seen: SeenOrientations) -> tuple[FloatArray, BoolArray]:
        """Move the state by how tags are turned; return the weights (m,), and which are unclear.

        Of filters that estimate ``orientations``.
        """
        raise NotImplementedError

    def add_orientations(self, seen: SeenOrientations) -> None:
        """Take over orientations as they are seen, where none is known yet."""
        raise NotImplementedError

    def take_orientations(self, rows: IntArray, known: KnownLandmarks) -> None:
        """Take in what a map knows of the orientations of landmarks ``rows`` (m,), if it can."""

    def orientation_matrices(self, rows: IntArray) -> FloatArray:
        """Return orientations (m, 3, 3), reference frame, zero where none is known."""
        B: FloatArray = self.orientations.B[rows]
        return B

    def orientation_sigmas(self, rows: IntArray) -> FloatArray:
        """Return the standard deviations (m,) of orientations, rad."""
        raise NotImplementedError

    def add_sensor(self, frame: str) -> None:
        """Let the calibration of the sensor of another frame be part of the state."""
        self.calibration.add_sensor(frame)

    # Landmarks

    def add(self, seen: SeenPoints) -> None:
        """Append landmarks seen for the first time."""
        self.observer.add_landmarks(seen.points)

    def add_known(self, known: KnownLandmarks) -> None:
        """Append landmarks that a map knows, reference frame; their errors may be correlated."""
        self.observer.add_reference_landmarks(known.points)
        n = len(self.observer)
        self.take_orientations(np.arange(n - len(known), n), known)

    def relocate(self, rows: IntArray, seen: SeenPoints) -> None:
        """Take landmarks for new ones, seen for the first time."""
        self.observer.relocate_landmarks(rows, seen.points)

    def remove(self, rows: IntArray) -> None:
        """Forget the landmarks at ``rows``; those behind move up."""
        self.observer.remove_landmarks(rows)

    def fix_landmarks(self, y_ref: FloatArray, covariances: FloatArray) -> None:
        """Take all landmarks for exact and at rest at ``y_ref`` (n, 3), and never move them."""
        self.observer.fix_landmarks(y_ref)
        self.is_exact = True

    def expected_points(self, rows: IntArray) -> FloatArray:
        """Return where landmarks should be seen (m, 3), metres, body frame; −1 for a new one."""
        return self.observer.body_points(rows)

    def translations(self, rows: IntArray) -> FloatArray:
        """Return â_i (m, 3) of landmarks, metres."""
        a: FloatArray = self.observer.a[rows]
        return a

    # The frame

    def set_pose(self, pose: FloatArray, covariance: FloatArray) -> None:
        """Put the robot at Â = ``pose`` (4, 4), ε of ``covariance`` (6, 6) independent of all."""
        self.observer.set_pose(pose)

    def anchor(self, rows: IntArray, r: FloatArray, covariances: FloatArray) -> None:
        """Move the whole estimate to where m of its landmarks are known to be.

        ``r`` (m, 3) is estimated minus known, reference frame; covariances are of the known ones.
        """
        raise NotImplementedError

    def enter_map(self, rows: IntArray, known: KnownLandmarks) -> None:
        """Move the estimate to where a map has landmarks ``rows`` (m,), and append its others.

        ``known`` (m + …) are these m in the reference frame, then the others. Where the filter
        knows no joint covariance the map's errors are taken to be independent.
        """
        m = len(rows)
        of_rows, others = (known.select(part) for part in np.split(np.arange(len(known)), [m]))
        r = self.points[rows] - of_rows.points
        self.anchor(rows, r, of_rows.covariances)
        self.observer.set_reference(self.observer.points)
        self.add_known(others)
        self.take_orientations(rows, of_rows)

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

    def pose_covariance(self, motion: Motion | Passage | None = None) -> FloatArray | None:
        """Return the covariance (6, 6) of ε in Â = exp(ε) A, maybe after a motion yet to come.

        (s, 6, 6) at the s instants of a passage.
        """
        return None

    def landmark_covariances(self, duration_s: float = 0.0) -> FloatArray | None:
        """Return those (n, 3, 3) of ã_i, when landmarks have moved on for ``duration_s``."""
        return None

    def joint_covariance(self, rows: IntArray) -> FloatArray | None:
        """Return the covariance (p + m k, p + m k) of ε and ã_i of m landmarks."""
        return None

    def merge(self, rows: IntArray, copies: IntArray, most: float) -> float:
        """Take landmarks ``copies`` (m,) for ``rows`` (m,) if they fit: see :mod:`.riccati`.

        Gains that know no joint covariance merge nothing, and return infinity.
        """
        return math.inf

    def configuration_covariance(self, rows: IntArray) -> FloatArray | None:
        """Return the joint covariance (m k, m k) of landmarks as seen from the robot, m²."""
        P, axes = self.joint_covariance(rows), self.axes
        if P is None:
            return None
        # Along the axes of the body: the choice of the world's frame has no part in it.
        m, k, p = len(rows), axes.point, axes.p
        C = axes.output_matrix(self.points[rows]).reshape(-1, p)
        CP = C @ P[:p] - P[p:]
        seen_covariance = CP[:, :p] @ C.T - CP[:, p:]
        turns = slice(p - k)
        seen_covariance = turned_moment(seen_covariance, CP[:, turns], P[turns, turns])
        blocks = seen_covariance.reshape(m, k, m, k).swapaxes(1, 2)
        R = self.observer.A[:k, :k]
        seen: FloatArray = (R.T @ blocks @ R).swapaxes(1, 2).reshape(m * k, m * k)
        return seen

    def distances(self, residuals: Residuals) -> FloatArray:
        """Return the Mahalanobis distance (m,) of each residual; zero if no noise is known."""
        return np.zeros(len(residuals.r))

    def innovation_covariance(self, residuals: Residuals) -> FloatArray | None:
        """Return the joint covariance (m k, m k) of residuals, noise included; None if unknown."""
        return None

    def predicted(self, residuals: Residuals) -> tuple[FloatArray, FloatArray]:
        """Return what P predicts of m residuals: with ε (p, m k), and their own (m k, m k)."""
        raise NotImplementedError
