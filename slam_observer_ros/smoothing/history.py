"""Motions and observations of a filter since its prior, kept to be relinearised."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.events import POINT
from slam_observer_ros.filter.arrays import SeenOrientations
from slam_observer_ros.filter.flat_arrays import Advanced
from slam_observer_ros.lie import se3
from slam_observer_ros.lie.axes import EstimatedAxes
from slam_observer_ros.lie.matrices import transpose
from slam_observer_ros.lie.sensor_mounting import joined_sensed, Sensed
from slam_observer_ros.models.calibration import Calibration
from slam_observer_ros.models.observation_noise import ObservationNoise
from slam_observer_ros.smoothing.keyframes import (
    joined,
    joined_turns,
    Keyframes,
    Links,
    no_keyframes,
    no_turns,
    SeenTurns,
)
from slam_observer_ros.smoothing.prior import Prior

_Motion: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]


class Keyframe(NamedTuple):
    """The m points of one observation after the correction, with new landmarks among them."""

    stamp_ns: int
    rows: IntArray  # (m,) which landmarks were seen
    points: FloatArray  # (m, 3) where they were seen, metres, body frame
    # (m, 3) from the sensor to where they should be, or to the points if that is not sure, metres
    lines_of_sight: FloatArray
    covariances: FloatArray | None  # (m, 3, 3) of the points, m²; None for the noise model's
    repeated: FloatArray  # (m,) by what factor the covariances grow, as errors last
    # (m,) how their tags are turned, zero for none; None if that is not estimated
    orientations: SeenOrientations | None = None
    sensed: Sensed | None = None  # (m,) as the sensor showed them, where it is calibrated
    kinds: IntArray | None = None  # (m,) what is measured of them; None for all of it
    origins: FloatArray | None = None  # (m, 3) where from; None for the base
    marks: Sequence[int] = ()  # (m,) of the observations, where they are of several

    def select(self, kept: BoolArray) -> Keyframe:
        """Return the points that ``kept`` (m,) picks; ``orientations`` are of these already."""
        return self._replace(
            rows=self.rows[kept],
            points=self.points[kept],
            lines_of_sight=self.lines_of_sight[kept],
            covariances=None if self.covariances is None else self.covariances[kept],
            repeated=self.repeated[kept],
            sensed=None if self.sensed is None else self.sensed.select(kept),
            kinds=None if self.kinds is None else self.kinds[kept],
            origins=None if self.origins is None else self.origins[kept],
        )


class _Link(NamedTuple):
    """The motion that led to a keyframe: the sum of those given to History.move."""

    start: FloatArray
    end: FloatArray
    noise: FloatArray
    sensitivity: FloatArray
    drift: FloatArray
    calibration: FloatArray
    # The pose (4, 4) after it, and noise (p, p), if the robot was taken for slipped
    slip: tuple[FloatArray, FloatArray] | None


class History:
    """Motions and observations since a prior, before which there was ``since``, in words."""

    def __init__(
        self, axes: EstimatedAxes, noise: ObservationNoise, prior: Prior, since: str
    ) -> None:
        self._axes, self._observation_noise = axes, noise
        # What was known at first, and after the first ``summarised`` keyframes.
        self.prior = self.summary = prior
        self.summarised = 0
        self.since = since
        self.stamps_ns: list[int] = []  # of the keyframes
        self.poses: list[FloatArray] = [prior.pose]  # then the keyframes' estimates
        self.calibrations = [prior.calibration]  # likewise
        self._calibration = prior.calibration
        self._start: FloatArray | None = None
        self._end = prior.pose
        self._slip: tuple[FloatArray, FloatArray] | None = None
        # Noise, sensitivity and drift of the motion since the last keyframe; None if at rest.
        self._motion: _Motion | None = None
        # Keyframes as arrays: the summarised ones, in pieces, and the others.
        self._none = no_keyframes(axes.p, len(prior.calibration), axes.point, axes.turn)
        self._summarised: list[Keyframes] = []
        self._latest = self._none
        self._new: list[Keyframe] = []
        self._new_links: list[_Link] = []  # to each of these
        # Keyframes in which landmarks were seen that are not known yet, by numbers given to them.
        self._marked: list[tuple[int, int]] = []

    def copy(self) -> History:
        """Return an independent history: no array is ever changed in place."""
        other = copy(self)
        for name, value in vars(self).items():
            if isinstance(value, list):
                setattr(other, name, value.copy())
        return other

    def move(
        self, start: FloatArray, motion: Advanced, drift: FloatArray, calibration: Calibration
    ) -> None:
        """Append a motion from a pose (4, 4), with ``drift`` (c, c), until the next keyframe."""
        if self._start is None:
            self._start = start.copy()
        self._end = motion.A
        more = motion.noise, motion.sensitivity, drift
        if self._motion is None:
            self._motion = more
        else:
            noise, sensitivity, drift_before = self._motion
            self._motion = noise + more[0], sensitivity + more[1], drift_before + drift
        self._calibration = calibration.values

    def slip(self, start: FloatArray, motion: Advanced) -> None:
        """Note a slip from a pose (4, 4); it comes last before the next keyframe."""
        if self._start is None:
            self._start = self._end = start.copy()
        self._slip = motion.A, motion.noise

    def add(self, keyframe: Keyframe, pose: FloatArray, calibration: FloatArray) -> None:
        """Append a keyframe seen from ``pose`` (4, 4); ``calibration`` (c,) is as known then."""
        self.stamps_ns.append(keyframe.stamp_ns)
        self.poses.append(pose)
        self.calibrations.append(calibration)
        start = self._end if self._start is None else self._start
        motion = self._motion or self._at_rest()
        self._new.append(keyframe)
        self._new_links.append(_Link(start, self._end, *motion, self._calibration, self._slip))
        self._start = self._slip = self._motion = None

    def mark(self, mark: int, stamp_ns: int, pose: FloatArray, calibration: FloatArray) -> None:
        """Append a keyframe in which landmarks were seen that may be known later."""
        self._marked.append((mark, len(self.stamps_ns)))
        none, nothing = np.empty(0, dtype=np.int64), np.empty((0, 3))
        keyframe = Keyframe(stamp_ns, none, nothing, nothing, None, np.empty(0))
        self.add(keyframe, pose, calibration)

    def marked(self, marks: Iterable[int]) -> list[int]:
        """Return the keyframes of marks, −1 where they are not there any more."""
        numbers = dict(self._marked)
        return [numbers.get(mark, -1) for mark in marks]

    @property
    def last_mark(self) -> int:
        """The last keyframe that is marked, −1 for none."""
        return self._marked[-1][1] if self._marked else -1

    def as_seen(self, seen: Keyframe, numbers: IntArray) -> Keyframes:
        """Return what was ``seen`` in several keyframes, as arrays."""
        return replace(self._as_arrays([seen], [], 0), keyframes=numbers)

    def attach(self, row: int, numbers: IntArray, seen: Keyframe) -> None:
        """Take what was ``seen`` in keyframes (m,) for all that was seen of a landmark."""
        more = self.as_seen(seen, numbers)
        self._change(lambda keyframes: keyframes.only(keyframes.landmarks != row))
        pieces, first = [*self._summarised, self._latest], 0
        for number, piece in enumerate(pieces):
            end = first + len(piece.calibrations)
            pieces[number] = piece.with_more(more.only((first <= numbers) & (numbers < end)))
            first = end
        *self._summarised, self._latest = pieces

    @property
    def drift(self) -> FloatArray:
        """By how much the covariance (c, c) of the calibration has grown since the prior."""
        parts = [part.drift_covariances for part in [*self._summarised, self._gathered()]]
        grown: FloatArray = np.sum(np.concatenate(parts), axis=0)
        return grown + (self._motion or self._at_rest())[2]

    def know_calibration(self, information: FloatArray, vector: FloatArray) -> None:
        """Note what is known of the calibration besides: :attr:`.Prior.besides`."""
        self.prior = self.prior.knowing(information, vector)
        self.summary = self.summary.knowing(information, vector)

    def add_calibration(self, values: FloatArray, variances: FloatArray) -> None:
        """Append entries (c,) of a calibration that are estimated from now on."""
        self._summarised = [part.with_calibration(values) for part in self._summarised]
        self._latest = self._gathered().with_calibration(values)
        self._none = self._none.with_calibration(values)
        self.prior = self.prior.with_calibration(self._axes, values, variances)
        self.summary = self.summary.with_calibration(self._axes, values, variances)
        self.calibrations = [np.append(known, values) for known in self.calibrations]
        self._calibration = np.append(self._calibration, values)
        if self._motion is not None:
            noise, sensitivity, drift = self._motion
            more = 0, len(values)
            self._motion = noise, np.pad(sensitivity, ((0, 0), more)), np.pad(drift, more)

    def summarise(self, known: Prior) -> None:
        """Let ``known`` stand for all that the keyframes up to now say."""
        self._summarised.append(self._gathered())
        self._latest = self._none
        self.summary = known
        self.summarised = len(self.stamps_ns)

    def relocate(self, rows: IntArray) -> None:
        """Forget all about the landmarks at ``rows`` but their latest observation."""
        last = len(self.stamps_ns) - 1

        def seen_for_the_first_time(keyframes: Keyframes) -> Keyframes:
            kept = keyframes.only(
                (keyframes.keyframes == last) | ~np.isin(keyframes.landmarks, rows)
            )
            is_first = np.isin(kept.landmarks, rows)
            return replace(kept, shares=np.where(is_first, 1.0, kept.shares))

        self._change(seen_for_the_first_time)
        self.prior = self.prior.with_unknown(self._axes, rows)
        self.summary = self.summary.with_unknown(self._axes, rows)

    def forget_orientations(self, rows: IntArray) -> None:
        """Forget how the tags of the landmarks at ``rows`` were turned."""

        def without(keyframes: Keyframes) -> Keyframes:
            forgotten = np.isin(keyframes.landmarks, rows)
            return replace(keyframes, turns=keyframes.turns.without(forgotten))

        self._change(without)
        self.prior = self.prior.with_unknown_turns(self._axes, rows)
        self.summary = self.summary.with_unknown_turns(self._axes, rows)

    def remove(self, rows: IntArray) -> None:
        """Forget the landmarks at ``rows`` and all observations of them."""
        if not len(rows):
            return
        in_order = np.sort(rows)

        def without(keyframes: Keyframes) -> Keyframes:
            if not np.any(keyframes.landmarks >= in_order[0]):  # from before it was added
                return keyframes
            kept = keyframes.only(~np.isin(keyframes.landmarks, rows))
            return replace(
                kept, landmarks=kept.landmarks - np.searchsorted(in_order, kept.landmarks)
            )

        self._change(without)
        self.prior = self.prior.without(self._axes, rows)
        self.summary = self.summary.without(self._axes, rows)

    def merge(self, rows: IntArray, copies: IntArray) -> None:
        """Take what was seen of landmarks ``copies`` (m,) for what was seen of ``rows`` (m,)."""

        def renamed(keyframes: Keyframes) -> Keyframes:
            landmarks = keyframes.landmarks.copy()
            for row, copy_ in zip(rows.tolist(), copies.tolist(), strict=True):
                landmarks[landmarks == copy_] = row
            return replace(keyframes, landmarks=landmarks)

        self._change(renamed)
        self.remove(copies)

    def keyframes(self) -> Keyframes:
        """Return all keyframes."""
        return joined([*self._summarised, self._gathered()])

    def latest_keyframes(self) -> Keyframes:
        """Return the keyframes that are not summarised, numbered from zero, with all slips."""
        latest = self._gathered()
        return replace(
            latest,
            keyframes=latest.keyframes - self.summarised,
            slips=latest.slips - self.summarised,
        ).with_slips()

    def _gathered(self) -> Keyframes:
        """Return the keyframes that are not summarised."""
        if self._new:
            first = self.summarised + len(self._latest.calibrations)
            latest = self._as_arrays(self._new, self._new_links, first)
            self._latest = joined([self._latest, latest])
            self._new, self._new_links = [], []
        return self._latest

    def _change(self, change: Callable[[Keyframes], Keyframes]) -> None:
        """Change what was seen in the keyframes."""
        self._summarised = [change(keyframes) for keyframes in self._summarised]
        self._latest = change(self._gathered())

    def _as_arrays(self, seen: list[Keyframe], links: list[_Link], first: int) -> Keyframes:
        """Return keyframes as arrays; ``first`` is the number of the first one."""
        slips = [number for number, link in enumerate(links, first) if link.slip is not None]
        slipped = [
            link._replace(end=link.slip[0], noise=link.noise + link.slip[1])
            for link in links
            if link.slip is not None
        ]
        k, c = self._axes.point, len(self._calibration)
        numbers = np.arange(first, first + len(seen))
        kinds, origins, turns = [], [], []
        for part in seen:
            kinds.append(np.full(len(part.rows), POINT) if part.kinds is None else part.kinds)
            origins.append(np.zeros_like(part.points) if part.origins is None else part.origins)
            tags = no_turns(self._axes.turn)
            if (found := part.orientations) is not None:
                covariances = self._axes.turn_covariances(found.covariances)
                information = np.linalg.inv(covariances).astype(np.float64)
                tags = SeenTurns(np.arange(len(found.rows)), found.Z, found.flipped, information)
                tags = tags.without(np.logical_not(found.Z.any(axis=(1, 2))))
            turns.append(tags)
        sensed = [part.sensed for part in seen if part.sensed is not None]
        return Keyframes(
            links=self._in_frames_of_ends(links),
            slips=np.array(slips, dtype=np.int64),
            slipped=self._in_frames_of_ends(slipped),
            calibrations=np.array([link.calibration for link in links]).reshape(len(links), c),
            drift_covariances=np.array([link.drift for link in links]).reshape(len(links), c, c),
            keyframes=np.repeat(numbers, [len(part.rows) for part in seen]),
            landmarks=np.concatenate([part.rows for part in seen]),
            points=np.concatenate([part.points for part in seen]),
            information=np.linalg.inv(self._covariances(seen)[:, :k, :k]).astype(np.float64),
            shares=1.0 / np.concatenate([part.repeated for part in seen]),
            kinds=np.concatenate(kinds),
            origins=np.concatenate(origins),
            turns=joined_turns(turns, [len(part.rows) for part in seen]),
            sensed=joined_sensed(sensed) if sensed else None,
        )

    def _in_frames_of_ends(self, links: list[_Link]) -> Links:
        """Return motions as arrays, each in the frame of the pose that it led to."""
        if not links:
            return self._none.links
        pose, back = self._axes.pose, se3.inverse(np.array([link.end for link in links]))
        starts, noises = [link.start for link in links], [link.noise for link in links]
        to_body = se3.adjoint(back)[:, pose, pose]
        return Links(
            motions=se3.inverse(back @ np.array(starts)),
            covariances=to_body @ np.array(noises) @ transpose(to_body),
            sensitivities=to_body @ np.array([link.sensitivity for link in links]),
        )

    def _covariances(self, seen: list[Keyframe]) -> FloatArray:
        """Return the covariances (M, 3, 3) of all points, body frame, m²."""
        stated = [part.covariances for part in seen if part.covariances is not None]
        if len(stated) == len(seen):
            return np.concatenate(stated)
        lines_of_sight = np.concatenate([part.lines_of_sight for part in seen])
        covariances = self._observation_noise.at(lines_of_sight)
        if stated:
            counts = [len(part.rows) for part in seen]
            are_stated = np.repeat([part.covariances is not None for part in seen], counts)
            covariances[are_stated] = np.concatenate(stated)
        return covariances

    def _at_rest(self) -> _Motion:
        """Return the covariance, the sensitivity and the drift of no motion."""
        d, c = self._axes.p, len(self._calibration)
        return np.zeros((d, d)), np.zeros((d, c)), np.zeros((c, c))
