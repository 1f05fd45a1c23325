"""What a filter has seen since its prior, kept so that it can look back."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np

from slam_observer_ros.axes import Axes
from slam_observer_ros.gains.base import Seen
from slam_observer_ros.geometry import se3, so3
from slam_observer_ros.smoothing import Frames, Prior
from slam_observer_ros.types import BoolArray, FloatArray, IntArray

ANYWHERE_M = 1e3
"""Standard deviation of a prior that says nothing, metres."""


class History:
    """Motions and observations, frame by frame.

    Parameters
    ----------
    axes : Axes
        Which axes are estimated.
    prior : Prior
        What was known before the first frame.

    Attributes
    ----------
    stamps_ns : list of int
        Stamps of the frames, nanoseconds.
    poses : list of FloatArray
        Current estimates (4, 4) of the prior's pose and of each frame's.

    """

    def __init__(self, axes: Axes, prior: Prior) -> None:
        self._axes = axes
        self.prior = prior
        self.stamps_ns: list[int] = []
        self.poses: list[FloatArray] = [prior.pose]
        self._starts: list[FloatArray] = []
        self._ends: list[FloatArray] = []
        self._noises: list[FloatArray] = []
        self._sensitivities: list[FloatArray] = []
        self._calibrations: list[FloatArray] = []
        self._landmarks: list[IntArray] = []
        self._points: list[FloatArray] = []
        self._shifts: list[FloatArray] = []
        self._information: list[FloatArray] = []
        self._calibration = prior.calibration
        self._start: FloatArray | None = None
        self._end = prior.pose
        self._noise, self._sensitivity = self._at_rest()

    def __deepcopy__(self, memo: dict[int, object]) -> History:
        """Return a history that goes its own way from here: no array is ever changed in place."""
        other = copy(self)
        for name, value in vars(self).items():
            if isinstance(value, list):
                setattr(other, name, value.copy())
        return other

    def move(
        self, path: FloatArray, noise: FloatArray, sensitivity: FloatArray, calibration: FloatArray
    ) -> None:
        """Append a motion to the one that leads to the next frame.

        Parameters
        ----------
        path : FloatArray
            (k + 1, 4, 4) poses along it.
        noise, sensitivity : FloatArray
            (d, d) and (d, c) covariance of its error ε, reference frame, and what the
            calibration's error adds to ε.
        calibration : FloatArray
            (c,) calibration with which it was computed.

        """
        if self._start is None:
            self._start = path[0].copy()
        self._end = path[-1].copy()  # not a view, which would keep all of the path
        self._noise = self._noise + noise
        self._sensitivity = self._sensitivity + sensitivity
        self._calibration = calibration

    def see(self, seen: Seen, pose: FloatArray, shifts: FloatArray) -> None:
        """Close a frame: the observation ``seen``, made at ``pose`` (4, 4).

        ``shifts`` (m, 3) is how far the landmarks had moved by themselves, metres.
        """
        k = self._axes.point
        self.stamps_ns.append(seen.stamp_ns)
        self.poses.append(pose)
        self._starts.append(self._end if self._start is None else self._start)
        self._ends.append(self._end)
        self._noises.append(self._noise)
        self._sensitivities.append(self._sensitivity)
        self._calibrations.append(self._calibration)
        self._landmarks.append(seen.indices)
        self._points.append(seen.points)
        self._shifts.append(shifts)
        information = np.linalg.inv(seen.covariances[:, :k, :k])
        self._information.append(np.asarray(information, dtype=np.float64))
        self._start = None
        self._noise, self._sensitivity = self._at_rest()

    def relocate_landmarks(self, indices: IntArray) -> None:
        """Forget all about the landmarks at ``indices`` but their latest observation."""
        for s in range(len(self._landmarks) - 1):
            kept = ~np.isin(self._landmarks[s], indices)
            if not kept.all():
                self._keep(s, kept)
        known = indices[indices < len(self.prior.points)]
        columns = self._prior_columns(known)
        covariance = self.prior.covariance.copy()
        covariance[columns] = covariance[:, columns] = 0.0
        covariance[columns, columns] = ANYWHERE_M**2
        self.prior = replace(self.prior, covariance=covariance)

    def remove_landmarks(self, indices: IntArray) -> None:
        """Forget the landmarks at ``indices`` and all observations of them."""
        for s, landmarks in enumerate(self._landmarks):
            self._keep(s, ~np.isin(landmarks, indices))
            rows = self._landmarks[s]
            self._landmarks[s] = rows - np.searchsorted(np.sort(indices), rows)
        known = indices[indices < len(self.prior.points)]
        columns = self._prior_columns(known)
        covariance = np.delete(np.delete(self.prior.covariance, columns, 0), columns, 1)
        points = np.delete(self.prior.points, known, axis=0)
        self.prior = replace(self.prior, points=points, covariance=covariance)

    def frames(self) -> Frames:
        """Return all frames as arrays."""
        S, pose, k = len(self.stamps_ns), self._axes.pose, self._axes.point
        d, c = len(pose), len(self._calibration)
        back = se3.inverse(np.reshape(self._ends, (S, 4, 4)))
        to_body = se3.adjoint(back)[:, pose][:, :, pose]
        counts = [len(landmarks) for landmarks in self._landmarks]
        none = np.empty(0, dtype=np.int64)
        return Frames(
            se3.inverse(back @ np.reshape(self._starts, (S, 4, 4))),
            to_body @ np.reshape(self._noises, (S, d, d)) @ so3.transpose(to_body),
            to_body @ np.reshape(self._sensitivities, (S, d, c)),
            np.reshape(self._calibrations, (S, c)),
            np.repeat(np.arange(S), counts),
            np.concatenate([none, *self._landmarks]),
            np.concatenate([np.empty((0, 3)), *self._points]),
            np.concatenate([np.empty((0, 3)), *self._shifts]),
            np.concatenate([np.empty((0, k, k)), *self._information]),
        )

    def _keep(self, s: int, kept: BoolArray) -> None:
        """Keep only some of the points of frame ``s``."""
        self._landmarks[s] = self._landmarks[s][kept]
        self._points[s] = self._points[s][kept]
        self._shifts[s] = self._shifts[s][kept]
        self._information[s] = self._information[s][kept]

    def _prior_columns(self, indices: IntArray) -> IntArray:
        k = self._axes.point
        first = len(self.prior.covariance) - k * len(self.prior.points)
        return (first + k * indices[:, None] + np.arange(k)).ravel()

    def _at_rest(self) -> tuple[FloatArray, FloatArray]:
        """Return the covariance and the sensitivity of no motion."""
        d = len(self._axes.pose)
        return np.zeros((d, d)), np.zeros((d, len(self._calibration)))
