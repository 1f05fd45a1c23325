"""What all gain designs have in common, and what they are given."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from slam_observer_ros.common.errors import ParameterError
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.geometry.axes import Axes
from slam_observer_ros.observer.observer import Correction, Observer
from slam_observer_ros.sensor_models.calibration import Calibration
from slam_observer_ros.sensor_models.motion import Motion
from slam_observer_ros.settings.estimator_settings import Settings

OF_CONSTANT_GAINS = ('gain_l', 'step_mode', 'max_innovation_time')
"""Settings without effect on other designs; ``gain_k`` is in the Lyapunov value of all."""


@dataclass(frozen=True, slots=True)
class Residuals:
    """What an observation of m known landmarks says against the state.

    Attributes
    ----------
    rows : IntArray
        (m,) which landmarks are seen.
    e : FloatArray
        (m, 3) errors (29), metres, reference frame.
    r : FloatArray
        (m, 3) residuals e_i − y_i°, metres.
    a : FloatArray
        (m, 3) â_i, metres.
    covariances : FloatArray
        (m, 3, 3) covariances of the points seen, rotated into the reference frame, m².
    dt_s : FloatArray
        (m,) seconds since each of them was seen before, in this run; else infinite.

    """

    rows: IntArray
    e: FloatArray
    r: FloatArray
    a: FloatArray
    covariances: FloatArray
    dt_s: FloatArray

    def on(self, axes: Axes) -> tuple[FloatArray, FloatArray]:
        """Return r (m, k), metres, and the covariances (m, k, k), m², on estimated axes."""
        k = axes.point
        return self.r[:, :k], self.covariances[:, :k, :k]

    def select(self, mask: BoolArray) -> Residuals:
        """Return the part of it that ``mask`` (m,) picks."""
        if mask.all():
            return self
        return replace(
            self,
            rows=self.rows[mask],
            e=self.e[mask],
            r=self.r[mask],
            a=self.a[mask],
            covariances=self.covariances[mask],
            dt_s=self.dt_s[mask],
        )


@dataclass(frozen=True, slots=True)
class FrameObservation:
    """All m landmarks of one observation, after the correction and with the new ones.

    Attributes
    ----------
    stamp_ns : int
        Stamp of the observation, nanoseconds.
    rows : IntArray
        (m,) which landmarks were seen.
    points : FloatArray
        (m, 3) where, metres, body frame.
    lines_of_sight : FloatArray
        (m, 3) from the sensor to where they should have been, or, where that is not sure, to where
        they were seen, metres, body frame.
    covariances : FloatArray or None
        (m, 3, 3) covariance of the points, body frame, m²; None where the noise model has it.
    dt_s : FloatArray
        (m,) seconds since each of them was seen before; infinite if it was not.

    """

    stamp_ns: int
    rows: IntArray
    points: FloatArray
    lines_of_sight: FloatArray
    covariances: FloatArray | None
    dt_s: FloatArray


@dataclass(frozen=True, slots=True)
class InHindsight:
    """Estimates from all that was seen before and after.

    Attributes
    ----------
    stamps_ns : IntArray
        (s,) stamps of the observations, nanoseconds.
    poses : FloatArray
        (s, 4, 4) Â at these stamps.
    points : FloatArray
        (n, 3) y_i° + â_i, metres, reference frame.
    since : str
        What has happened before the first of them, in words.

    """

    stamps_ns: IntArray
    poses: FloatArray
    points: FloatArray
    since: str


class GainDesign:
    """Strategy that turns residuals into a correction: the innovation over a step of time.

    What a design does not override is right for one that knows no noise and has no memory.
    Covariances are those of the errors in the reference frame; None where a design knows none.

    Attributes
    ----------
    calibration : Calibration
        Scale, bias and delay of the velocity, as far as they are known.
    ignores : tuple of str
        Settings without effect on the design; a warning names those that were changed.

    """

    calibration: Calibration
    ignores: ClassVar[tuple[str, ...]] = ()

    def correct(self, residuals: Residuals) -> tuple[Correction, FloatArray]:
        """Return the correction and the weights (m,) of the points seen, 0 for a rejected one."""
        raise NotImplementedError

    def change_settings(self, settings: Settings) -> None:
        """Use the settings that may change while running."""
        raise NotImplementedError

    def anchor(
        self, observer: Observer, rows: IntArray, r: FloatArray, covariances: FloatArray
    ) -> Correction:
        """Return the correction that brings the whole estimate to where known landmarks are.

        Parameters
        ----------
        observer : Observer
            The estimate.
        rows : IntArray
            (m,) which of its landmarks are known.
        r : FloatArray
            (m, 3) estimated minus known positions, metres, reference frame.
        covariances : FloatArray
            (m, 3, 3) covariances of the known positions, m².

        """
        raise NotImplementedError

    def predict(self, observer: Observer, motion: Motion) -> None:
        """Account for the noise of a motion that has brought ``observer`` to where it is."""

    def add_landmarks(self, y_ref: FloatArray, covariances: FloatArray) -> None:
        """Account for landmarks (m, 3) whose first observation has ``covariances`` (m, 3, 3)."""

    def relocate_landmarks(
        self, rows: IntArray, y_ref: FloatArray, covariances: FloatArray
    ) -> None:
        """Take landmarks (m,) for new ones at ``y_ref`` (m, 3), seen for the first time."""

    def add_known_landmarks(self, covariances: FloatArray) -> None:
        """Account for landmarks from a map with ``covariances`` (m, 3, 3), reference frame, m²."""

    def with_fixed_landmarks(self, covariances: FloatArray) -> GainDesign:
        """Return gains that know what these do, and never move a landmark again.

        ``covariances`` (n, 3, 3), reference frame, m², are what a map says of all landmarks, new
        ones among them. These gains are not used any more.
        """
        raise NotImplementedError

    def remove_landmarks(self, rows: IntArray) -> None:
        """Forget the landmarks at ``rows``; those behind move up."""

    def set_pose_error_covariance(self, covariance: FloatArray) -> None:
        """Take ``covariance`` (6, 6) for that of ε, independent of all else."""

    def recall(self, observer: Observer, rows: IntArray) -> None:
        """Move landmarks that are about to be used, where the design had put that off.

        ``rows`` (m,) are −1 where one is new.
        """

    def postponed_shifts(self) -> FloatArray:
        """Return how far landmarks have yet to be moved, (n, 3), metres; (1, 3) if it is zero."""
        return np.zeros((1, 3))

    def distances(self, residuals: Residuals) -> FloatArray:
        """Return the Mahalanobis distance (m,) of each residual; zero if no noise is known."""
        return np.zeros(len(residuals.r))

    def settle(self, observer: Observer) -> None:
        """Move the reference to the estimate after a correction, where the design needs that."""

    @property
    def looks_back(self) -> bool:
        """Whether the design looks back at what was seen."""
        return False

    def look_back(self, observer: Observer, seen: FrameObservation, in_doubt: bool) -> None:
        """Note what was seen, and look back if it is time; only for those that do at all.

        The observer's reference is moved then. ``in_doubt`` asks for it now, as a landmark seems
        to have moved.
        """

    def smooth(self, observer: Observer) -> InHindsight:
        """Return the estimates in hindsight.

        Raises
        ------
        ParameterError
            If the design keeps no history.
        SmoothingError
            If the observations don't determine the whole trajectory.

        """
        raise ParameterError("smoothing needs 'gains: riccati' and a 'hindsight_interval'")

    def restart(self, observer: Observer, since: str) -> None:
        """Forget the past: what is known now is all that is known when looking back.

        ``since`` is what has happened, in words, for whoever asks why hindsight begins here.
        """

    @property
    def calibration_variances(self) -> FloatArray:
        """(c,) variances of what is estimated of the calibration."""
        return np.empty(0)

    @property
    def pose_error_covariance(self) -> FloatArray | None:
        """(6, 6) covariance of the error ε of Â = exp(ε) A, (Ω, v) order; None if unknown."""
        return None

    def pose_error_covariance_after(self, motion: Motion) -> FloatArray | None:
        """Return what the same (6, 6) will be after a motion that is yet to be predicted."""
        return None

    @property
    def landmark_error_covariances(self) -> FloatArray | None:
        """(n, 3, 3) covariances of the errors ã_i, reference frame, m²; None if unknown."""
        return None

    def landmark_error_covariances_after(
        self, observer: Observer, duration_s: float
    ) -> FloatArray | None:
        """Return what the same will be when landmarks that move have moved on."""
        return self.landmark_error_covariances

    def joint_covariance(self, rows: IntArray) -> FloatArray | None:
        """Return the covariance (p + m k, p + m k) of ε and m landmarks; None if unknown."""
        return None
