"""What a gain design is given and what it returns."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

from slam_observer_ros.gains.calibration import Calibration
from slam_observer_ros.gains.motion import Motion
from slam_observer_ros.observer import Correction, Observer
from slam_observer_ros.settings import Settings
from slam_observer_ros.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Innovation:
    """One observation of m known landmarks, as a gain design sees it.

    Attributes
    ----------
    indices : IntArray
        (m,) which landmarks are seen.
    e : FloatArray
        (m, 3) errors (29), metres, reference frame.
    r : FloatArray
        (m, 3) residuals e_i − y_i°, metres.
    a : FloatArray
        (m, 3) â_i, metres.
    covariances : FloatArray
        (m, 3, 3) covariance of the observations, rotated into the reference frame, m².
    dt_s : FloatArray
        (m,) seconds since each of them was seen before.

    """

    indices: IntArray
    e: FloatArray
    r: FloatArray
    a: FloatArray
    covariances: FloatArray
    dt_s: FloatArray

    def select(self, mask: BoolArray) -> Innovation:
        """Return the part of it that ``mask`` (m,) picks."""
        if mask.all():
            return self
        return replace(
            self,
            indices=self.indices[mask],
            e=self.e[mask],
            r=self.r[mask],
            a=self.a[mask],
            covariances=self.covariances[mask],
            dt_s=self.dt_s[mask],
        )


@dataclass(frozen=True, slots=True)
class Seen:
    """All m landmarks of one observation, after the innovation and with the new ones.

    Attributes
    ----------
    stamp_ns : int
        Stamp of the observation, nanoseconds.
    indices : IntArray
        (m,) which landmarks were seen.
    points : FloatArray
        (m, 3) where, metres, body frame.
    sights : FloatArray
        (m, 3) from the sensor to where they should have been, metres, body frame.
    covariances : FloatArray or None
        (m, 3, 3) covariance of the points, body frame, m²; None where the noise model has it.

    """

    stamp_ns: int
    indices: IntArray
    points: FloatArray
    sights: FloatArray
    covariances: FloatArray | None


class GainDesign(Protocol):
    """Strategy that turns residuals into the innovation (D, d_i).

    Covariances are those of the errors in the reference frame; None where a design knows none.
    """

    def change_settings(self, settings: Settings) -> None:
        """Use the settings that may change while running."""

    def predict(self, observer: Observer, motion: Motion) -> None:
        """Account for the noise of a motion that has brought ``observer`` to where it is."""

    def add_landmarks(self, y_ref: FloatArray, covariances: FloatArray) -> None:
        """Account for landmarks (m, 3) whose first observation has ``covariances`` (m, 3, 3)."""

    def relocate_landmarks(
        self, indices: IntArray, y_ref: FloatArray, covariances: FloatArray
    ) -> None:
        """Take landmarks (m,) for new ones at ``y_ref`` (m, 3), seen for the first time."""

    def add_known_landmarks(self, covariances: FloatArray) -> None:
        """Account for landmarks from a map with ``covariances`` (m, 3, 3), reference frame, m²."""

    def set_pose_covariance(self, covariance: FloatArray) -> None:
        """Take ``covariance`` (6, 6) for that of ε, independent of all else."""

    def joint_covariance(self, indices: IntArray) -> FloatArray | None:
        """Return the covariance (p + m k, p + m k) of ε and m landmarks; None if unknown."""

    def anchor(
        self, observer: Observer, indices: IntArray, r: FloatArray, covariances: FloatArray
    ) -> Correction:
        """Return the correction that brings the whole estimate to where known landmarks are.

        Parameters
        ----------
        observer : Observer
            The estimate.
        indices : IntArray
            (m,) which of its landmarks are known.
        r : FloatArray
            (m, 3) estimated minus known positions, metres, reference frame.
        covariances : FloatArray
            (m, 3, 3) covariances of the known positions, m².

        """

    def restart(self, observer: Observer, since: str) -> None:
        """Forget the past: what is known now is all that is known when looking back.

        ``since`` is what has happened, in words, for whoever asks why hindsight begins here.
        """

    def remove_landmarks(self, indices: IntArray) -> None:
        """Forget the landmarks at ``indices``."""

    @property
    def calibration(self) -> Calibration:
        """Scale, bias and delay of the velocity, as far as they are known."""

    @property
    def calibration_variances(self) -> FloatArray:
        """(c,) variances of what is estimated of the calibration."""

    def recall(self, observer: Observer, indices: IntArray) -> None:
        """Move landmarks (m,) that are about to be used, where the design had put that off."""

    def postponed_shifts(self) -> FloatArray:
        """Return how far landmarks have yet to be moved, (n, 3), metres; (1, 3) if it is zero."""

    def correct(self, innovation: Innovation) -> tuple[Correction, FloatArray]:
        """Return the correction and the weights (m,) of the observations, 0 for a rejected one."""

    def distances(self, innovation: Innovation) -> FloatArray:
        """Return the Mahalanobis distance (m,) of each residual; zero if no noise is known."""

    def settle(self, observer: Observer) -> None:
        """Move the reference to the estimate after a correction, where the design needs that."""

    @property
    def looks_back(self) -> bool:
        """Whether the design looks back at what was seen."""

    def look_back(self, observer: Observer, seen: Seen, in_doubt: bool) -> None:
        """Note what was seen; where the design looks back, move the observer's reference.

        ``in_doubt`` asks it to look back now, as a landmark seems to have moved.
        """

    @property
    def pose_covariance(self) -> FloatArray | None:
        """(6, 6) covariance of the error ε of Â = exp(ε) A, (Ω, v) order; None if unknown."""

    def pose_covariance_after(self, motion: Motion) -> FloatArray | None:
        """Return what the pose's covariance (6, 6) will be after a motion yet to be predicted."""

    @property
    def landmark_covariances(self) -> FloatArray | None:
        """(n, 3, 3) covariances of the landmarks, reference frame, m²; None if unknown."""
