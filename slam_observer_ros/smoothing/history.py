"""What a filter has seen since its prior, kept so that it can look back."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.axes import Axes
from slam_observer_ros.geometry.matrices import transpose
from slam_observer_ros.observer.filter import FrameObservation
from slam_observer_ros.sensor_models.observation_noise import ObservationNoise, repetition_factors
from slam_observer_ros.smoothing.gauss_newton import Frames, joined, no_frames
from slam_observer_ros.smoothing.prior import Prior


@dataclass(frozen=True, slots=True)
class _Frame:
    """An observation and the motion that led to it.

    Attributes
    ----------
    start, end : FloatArray
        (4, 4) poses before and after the motion.
    noise, sensitivity, calibration : FloatArray
        As :meth:`History.move` is given them, of the whole motion.
    seen : FrameObservation
        The observation.

    """

    start: FloatArray
    end: FloatArray
    noise: FloatArray
    sensitivity: FloatArray
    calibration: FloatArray
    seen: FrameObservation


class History:
    """Motions and observations, frame by frame.

    Parameters
    ----------
    axes : Axes
        Which axes are estimated.
    noise : ObservationNoise
        Noise of the observations.
    prior : Prior
        What was known before the first frame.
    since : str
        What happened then, in words.

    Attributes
    ----------
    prior, since : Prior, str
        The same.
    summary : Prior
        What was known after the first ``summarised`` frames; at first the prior.
    summarised : int
        How many frames these are.
    stamps_ns : list of int
        Stamps of the frames, nanoseconds.
    poses : list of FloatArray
        Current estimates (4, 4) of the prior's pose and of each frame's.

    """

    def __init__(self, axes: Axes, noise: ObservationNoise, prior: Prior, since: str) -> None:
        self._axes, self._observation_noise = axes, noise
        self.prior = self.summary = prior
        self.summarised = 0
        self.since = since
        self.stamps_ns: list[int] = []
        self.poses: list[FloatArray] = [prior.pose]
        self._calibration = prior.calibration
        self._start: FloatArray | None = None
        self._end = prior.pose
        self._motion_noise, self._sensitivity = self._at_rest()
        # Frames as arrays: those that are summarised, in pieces, and those that are not.
        self._none = no_frames(axes.p, len(prior.calibration), axes.point)
        self._summarised: list[Frames] = []
        self._latest = self._none
        self._new: list[_Frame] = []

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
        self._motion_noise = self._motion_noise + noise
        self._sensitivity = self._sensitivity + sensitivity
        self._calibration = calibration

    def see(self, seen: FrameObservation, pose: FloatArray) -> None:
        """Close a frame: the observation ``seen``, made at ``pose`` (4, 4)."""
        self.stamps_ns.append(seen.stamp_ns)
        self.poses.append(pose)
        start = self._end if self._start is None else self._start
        self._new.append(
            _Frame(
                start, self._end, self._motion_noise, self._sensitivity, self._calibration, seen
            )
        )
        self._start = None
        self._motion_noise, self._sensitivity = self._at_rest()

    def summarise(self, known: Prior) -> None:
        """Take ``known`` for all that the frames up to now tell."""
        self._summarised.append(self._gathered())
        self._latest = self._none
        self.summary = known
        self.summarised = len(self.stamps_ns)

    def relocate_landmarks(self, rows: IntArray) -> None:
        """Forget all about the landmarks at ``rows`` but their latest observation."""
        last = len(self.stamps_ns) - 1

        def anew(frames: Frames) -> Frames:
            kept = frames.only((frames.frames == last) | ~np.isin(frames.landmarks, rows))
            is_first = np.isin(kept.landmarks, rows)
            return replace(kept, shares=np.where(is_first, 1.0, kept.shares))

        self._change(anew)
        self.prior = self.prior.with_unknown(self._axes, rows)
        self.summary = self.summary.with_unknown(self._axes, rows)

    def remove_landmarks(self, rows: IntArray) -> None:
        """Forget the landmarks at ``rows`` and all observations of them."""
        in_order = np.sort(rows)

        def without(frames: Frames) -> Frames:
            kept = frames.only(~np.isin(frames.landmarks, rows))
            return replace(
                kept, landmarks=kept.landmarks - np.searchsorted(in_order, kept.landmarks)
            )

        self._change(without)
        self.prior = self.prior.without(self._axes, rows)
        self.summary = self.summary.without(self._axes, rows)

    def frames(self) -> Frames:
        """Return all frames."""
        return joined([*self._summarised, self._gathered()])

    def latest_frames(self) -> Frames:
        """Return the frames that are not summarised, numbered anew."""
        latest = self._gathered()
        return replace(latest, frames=latest.frames - self.summarised)

    def _gathered(self) -> Frames:
        """Return the frames that are not summarised."""
        if self._new:
            first = self.summarised + len(self._latest.motions)
            self._latest = joined([self._latest, self._as_arrays(self._new, first)])
            self._new = []
        return self._latest

    def _change(self, change: Callable[[Frames], Frames]) -> None:
        """Change what was seen in the frames."""
        self._summarised = [change(frames) for frames in self._summarised]
        self._latest = change(self._gathered())

    def _as_arrays(self, frames: list[_Frame], first: int) -> Frames:
        """Return frames as arrays; ``first`` is the number of the first one."""
        pose, k, seen = self._axes.pose, self._axes.point, [frame.seen for frame in frames]
        back = se3.inverse(np.array([frame.end for frame in frames]))
        starts = np.array([frame.start for frame in frames])
        to_body = se3.adjoint(back)[:, pose, pose]
        noises = np.array([frame.noise for frame in frames])
        numbers = np.arange(first, first + len(frames))
        dt_s = np.concatenate([part.dt_s for part in seen])
        return Frames(
            motions=se3.inverse(back @ starts),
            motion_covariances=to_body @ noises @ transpose(to_body),
            sensitivities=to_body @ np.array([frame.sensitivity for frame in frames]),
            calibrations=np.array([frame.calibration for frame in frames]),
            frames=np.repeat(numbers, [len(part.rows) for part in seen]),
            landmarks=np.concatenate([part.rows for part in seen]),
            points=np.concatenate([part.points for part in seen]),
            information=np.linalg.inv(self._covariances(seen)[:, :k, :k]).astype(np.float64),
            shares=1.0 / repetition_factors(dt_s, self._observation_noise.error_time_s),
        )

    def _covariances(self, seen: list[FrameObservation]) -> FloatArray:
        """Return the covariances (M, 3, 3) of all points, body frame, m²."""
        covariances = self._observation_noise.at(
            np.concatenate([part.lines_of_sight for part in seen])
        )
        stated = [part.covariances for part in seen if part.covariances is not None]
        if stated:
            is_stated = [part.covariances is not None for part in seen]
            covariances[np.repeat(is_stated, [len(part.rows) for part in seen])] = np.concatenate(
                stated
            )
        return covariances

    def _at_rest(self) -> tuple[FloatArray, FloatArray]:
        """Return the covariance and the sensitivity of no motion."""
        d = self._axes.p
        return np.zeros((d, d)), np.zeros((d, len(self._calibration)))
