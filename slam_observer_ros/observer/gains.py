"""What all gains have in common: how X̂ on SLAM_n(3) is advanced, corrected and extended.

What a subclass does not override is right for gains that know no noise. What others know of their
errors is :mod:`.errors`. Landmarks are given by rows (m,), points (m, 3) in the body frame,
metres, with covariances (m, 3, 3), m².
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from copy import copy
import math
from typing import ClassVar, TYPE_CHECKING

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry.axes import axes_of
from slam_observer_ros.observer.errors import Errors
from slam_observer_ros.observer.known_landmarks import KnownLandmarks
from slam_observer_ros.observer.observer import Observer
from slam_observer_ros.observer.residuals import Residuals, SeenPoints
from slam_observer_ros.sensor_models.calibration import Calibration, without_calibration
from slam_observer_ros.sensor_models.motion import Motion
from slam_observer_ros.sensor_models.motion_noise import MotionNoise
from slam_observer_ros.settings.estimator_settings import Settings

if TYPE_CHECKING:
    from typing_extensions import Self

    from slam_observer_ros.observer.riccati.orientation_gains import OrientationGains

OF_CONSTANT_GAINS = ('gain_l', 'step_mode', 'max_innovation_time')
"""Settings without effect on other gains; ``gain_k`` is in the Lyapunov value of all."""


OF_JOINT_COVARIANCES = (
    'motion_noise_factor',
    'sensor_rotation_stddev',
    'sensor_translation_stddev',
    'range_scale_stddev',
)
"""Settings of what only a joint covariance can estimate."""


class Gains(ABC):
    """What moves an ``observer``'s X̂, which starts at ``reference_pose`` P° (4, 4)."""

    ignores: ClassVar[tuple[str, ...]] = ()  # settings without effect
    errors: Errors | None = None  # what is known of those of pose and landmarks together

    def __init__(self, settings: Settings, reference_pose: FloatArray) -> None:
        self._settings = settings
        self.axes = axes_of(settings.two_d_mode)  # what of pose and points is estimated
        calibration = Calibration(self.estimated(settings), self.axes)
        self.observer = Observer(reference_pose, calibration)
        self.motion_noise = MotionNoise(settings)

    @staticmethod
    def estimated(settings: Settings) -> Settings:
        """Return the settings with as much of a calibration as is estimated."""
        return without_calibration(settings)

    def copy(self) -> Self:
        """Return an independent copy."""
        other = copy(self)
        other.observer = self.observer.copy()
        other.motion_noise = self.motion_noise.copy()
        return other

    @property
    def tags(self) -> OrientationGains | None:
        """What moves it by orientations of tags; None where only their positions are used."""
        return None

    # The step (27)-(31)

    def advance(self, motion: Motion) -> None:
        """Move pose and landmarks along a motion (27), and account for its noise."""
        self.observer.propagate(motion.path)
        self.observer.move_landmarks(motion.duration_s)

    def prepare(self, rows: IntArray) -> None:  # noqa: B027 (most gains postpone nothing)
        """Bring landmarks (m,) up to date that are going to be observed; −1 for a new one."""

    def residuals(self, rows: IntArray, seen: SeenPoints, dt_s: FloatArray) -> Residuals:
        """Return what landmarks ``rows`` (m,) say against X̂ (29).

        ``dt_s`` (m,) is the time since each was last seen.
        """
        observer = self.observer
        e, r = observer.errors(rows, seen.points)
        R = observer.turned(seen.covariances)
        return Residuals(rows, e, r, observer.a[rows], R, dt_s, seen.D)

    @abstractmethod
    def observe(self, residuals: Residuals) -> FloatArray:
        """Move the state by the innovation (28)–(31); return the weights (m,), 0 for rejected."""

    # Landmarks and sensors

    def add(self, seen: SeenPoints) -> None:
        """Append landmarks seen for the first time."""
        self.observer.add_landmarks(seen.points)

    def add_known(self, known: KnownLandmarks) -> None:
        """Append landmarks that a map knows, reference frame; their errors may be correlated."""
        self.observer.add_reference_landmarks(known.points)

    def relocate(self, rows: IntArray, seen: SeenPoints) -> None:
        """Take landmarks for new ones, seen for the first time."""
        self.observer.relocate_landmarks(rows, seen.points)

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

    def add_sensor(self, frame: str) -> None:
        """Let the calibration of the sensor of another frame be part of the state."""
        self.observer.calibration.add_sensor(frame)

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

    # What is known of the errors by any gains

    @property
    def calibration_variances(self) -> FloatArray:
        """(c,) variances of what is estimated of the calibration."""
        return np.empty(0)

    def joint_covariance(self, rows: IntArray) -> FloatArray | None:
        """Return the covariance (p + m k, p + m k) of ε and ã_i of m landmarks, if it is known."""
        return None

    def distances(self, residuals: Residuals) -> FloatArray:
        """Return the Mahalanobis distance (m,) of each residual; zero if no noise is known."""
        return np.zeros(len(residuals.r))
