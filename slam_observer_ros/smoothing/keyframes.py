"""Arrays for smoothing: keyframes, the motions between them, and estimates of all.

And which of the slips that a filter has believed in the whole history confirms.

A filter takes the robot for slipped by what it has seen until then, which what follows may
explain otherwise. A link that may be a slip has a thousand times the variance of one that is not,
so a false one lets a part of the map drift off. All links are therefore taken as odometry has
them at first, and nothing is gated: what speaks against a false slip would be. A link becomes a
slip where that pays: where it makes the error e of the motion likelier,

    eᵀ S⁻¹ e − eᵀ S_s⁻¹ e > ln (|S_s| / |S|)

with S the covariance that odometry states and S_s that with the slip.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.lie.matrices import definite_inverse
from slam_observer_ros.lie.sensor_mounting import joined_sensed, Sensed

EXACT_M = 1e-6  # standard deviation of a position that is said to be exact, metres


@dataclass(frozen=True, slots=True)
class SeenTurns:
    """Orientations of T tags among M observed points."""

    points: IntArray  # (T,) which of the points are tags
    Z: FloatArray  # (T, 3, 3) from the tag's own axes to the body's
    flipped: FloatArray  # (T, 3, 3) the other orientation that looks nearly the same
    information: FloatArray  # (T, q, q) inverse covariance of it, along the body's axes, 1/rad²

    def only(self, kept: BoolArray) -> SeenTurns:
        """Return the tags among some of the points (M,), numbered without the others."""
        turns = self.without(~kept)
        return replace(turns, points=(np.cumsum(kept) - 1)[turns.points])

    def without(self, forgotten: BoolArray) -> SeenTurns:
        """Return the tags without those among the ``forgotten`` points (M,)."""
        left = ~forgotten[self.points]
        return SeenTurns(*(getattr(self, field.name)[left] for field in fields(self)))


@dataclass(frozen=True, slots=True)
class Links:
    """S motions, each from one keyframe to the next, or from the prior's pose to the first."""

    motions: FloatArray  # (S, 4, 4) pose in the one before
    covariances: FloatArray  # (S, d, d) of each motion as a right perturbation
    sensitivities: FloatArray  # (S, d, c) derivative of each motion by the calibration, so too

    def replaced(self, rows: IntArray, others: Links) -> Links:
        """Return the links with others (r,) in place of those at ``rows`` (r,)."""
        if not len(rows):
            return self
        changed = Links(self.motions.copy(), self.covariances.copy(), self.sensitivities.copy())
        changed.motions[rows], changed.covariances[rows] = others.motions, others.covariances
        changed.sensitivities[rows] = others.sensitivities
        return changed

    def with_calibration(self, more: int) -> Links:
        """Return the links with so many more entries of a calibration, of no effect on them."""
        S, d, _ = self.sensitivities.shape
        sensitivities = np.concatenate([self.sensitivities, np.zeros((S, d, more))], axis=2)
        return replace(self, sensitivities=sensitivities)

    def only(self, kept: BoolArray) -> Links:
        """Return some of the links (S,)."""
        return Links(self.motions[kept], self.covariances[kept], self.sensitivities[kept])


@dataclass(frozen=True, slots=True)
class Keyframes:
    """S keyframes with M observed points since a prior."""

    links: Links  # as odometry has it
    slips: IntArray  # (s,) those links in which a filter took the robot for slipped …
    slipped: Links  # … and what it had in their place
    calibrations: FloatArray  # (S, c) with which each motion was computed
    drift_covariances: FloatArray  # (S, c, c) of what the calibration drifted by meanwhile
    keyframes: IntArray  # (M,) in which keyframe each point was observed
    landmarks: IntArray  # (M,) which landmark it is
    points: FloatArray  # (M, 3) where it was seen, metres, body frame
    information: FloatArray  # (M, k, k) inverse covariance of it, body frame, 1/m²
    # (M,) how much of it counts: less than 1 where a point before had partly the same error
    shares: FloatArray
    kinds: IntArray  # (M,) what is measured of it; the rest is completed at each iteration
    origins: FloatArray  # (M, 3) where it was measured from, metres, body frame
    turns: SeenTurns  # of the tags among them, where orientations are estimated
    sensed: Sensed | None = None  # (M,) as the sensors showed them, where these are calibrated

    def with_slips(self, are_slips: BoolArray | None = None) -> Keyframes:
        """Return the keyframes with some of the slips (s,) in place of the links, or with all."""
        if are_slips is None:
            are_slips = np.ones(len(self.slips), dtype=np.bool_)
        slipped = self.slipped.only(are_slips)
        return replace(self, links=self.links.replaced(self.slips[are_slips], slipped))

    def only(self, kept: BoolArray) -> Keyframes:
        """Return the keyframes with only some of the points (M,)."""
        own = {name: getattr(self, name)[kept] for name in _OF_SEEN}
        sensed = None if self.sensed is None else self.sensed.select(kept)
        return replace(self, **own, turns=self.turns.only(kept), sensed=sensed)

    def with_more(self, seen: Keyframes) -> Keyframes:
        """Return the same with more points seen in these keyframes."""
        every = joined([self, seen])
        order = np.argsort(every.keyframes, kind='stable')
        turns = replace(every.turns, points=np.argsort(order)[every.turns.points])
        own = {name: getattr(every, name)[order] for name in _OF_SEEN}
        sensed = None if every.sensed is None else every.sensed.select(order)
        return replace(every, **own, turns=turns, sensed=sensed)

    def with_calibration(self, values: FloatArray) -> Keyframes:
        """Return the same with more of a calibration (c,), which was of no effect before."""
        (S, c), more = self.calibrations.shape, len(values)
        drifts = np.zeros((S, c + more, c + more))
        drifts[:, :c, :c] = self.drift_covariances
        return replace(
            self,
            links=self.links.with_calibration(more),
            slipped=self.slipped.with_calibration(more),
            calibrations=np.hstack([self.calibrations, np.tile(values, (S, 1))]),
            drift_covariances=drifts,
        )


@dataclass(frozen=True, slots=True)
class Solution:
    """Smoothed estimates."""

    poses: FloatArray  # (S + 1, 4, 4) of the prior, then of each keyframe
    calibrations: FloatArray  # (S + 1, c); all the same unless it drifts
    points: FloatArray  # (n, 3) landmarks, metres
    orientations: FloatArray  # (n, 3, 3) how they are turned, zero where that is not known


def joined(parts: list[Keyframes]) -> Keyframes:
    """Return the keyframes of one or more parts, one after the other."""
    own = [field.name for field in fields(Keyframes) if field.name not in _OF_PARTS]
    together = {name: np.concatenate([getattr(part, name) for part in parts]) for name in own}
    sensed = [part.sensed for part in parts if part.sensed is not None]
    return replace(
        parts[0],
        **together,
        links=_joined_links([part.links for part in parts]),
        slipped=_joined_links([part.slipped for part in parts]),
        turns=joined_turns([part.turns for part in parts], [len(part.points) for part in parts]),
        sensed=joined_sensed(sensed) if sensed else None,
    )


_OF_PARTS = 'links', 'slipped', 'turns', 'sensed'
_OF_SEEN = 'keyframes', 'landmarks', 'points', 'information', 'shares', 'kinds', 'origins'


def _joined_links(parts: list[Links]) -> Links:
    names = [field.name for field in fields(Links)]
    return Links(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def no_turns(q: int) -> SeenTurns:
    """Return no tags; q axes of a turn are estimated."""
    no_rotations = np.empty((0, 3, 3))
    none = np.empty(0, dtype=np.int64)
    return SeenTurns(none, no_rotations, no_rotations, np.empty((0, q, q)))


def no_keyframes(d: int, c: int, k: int, q: int) -> Keyframes:
    """Return no keyframes; d, c and k as in :class:`.Smoother`, q of a turn."""
    none = np.empty(0, dtype=np.int64)
    no_links = Links(np.empty((0, 4, 4)), np.empty((0, d, d)), np.empty((0, d, c)))
    return Keyframes(
        links=no_links,
        slips=none,
        slipped=no_links,
        calibrations=np.empty((0, c)),
        drift_covariances=np.empty((0, c, c)),
        keyframes=none,
        landmarks=none,
        points=np.empty((0, 3)),
        information=np.empty((0, k, k)),
        shares=np.empty(0),
        kinds=none,
        origins=np.empty((0, 3)),
        turns=no_turns(q),
    )


def joined_turns(parts: list[SeenTurns], counts: list[int]) -> SeenTurns:
    """Return the tags of several parts, one after the other; ``counts`` are of their points."""
    before = np.cumsum([0, *counts[:-1]])
    return SeenTurns(
        np.concatenate([part.points + first for part, first in zip(parts, before, strict=True)]),
        np.concatenate([part.Z for part in parts]),
        np.concatenate([part.flipped for part in parts]),
        np.concatenate([part.information for part in parts]),
    )


ROUNDS = 10  # of asking which slips pay; the answer hardly changes after the third


def confirmed_slips(
    solve: Callable[[Keyframes, Solution], Solution],
    motion_errors: Callable[[Keyframes, Solution], FloatArray],
    keyframes: Keyframes,
    start: Solution,
) -> tuple[BoolArray, Solution]:
    """Return which of the keyframes' slips (s,) pay, and a solution with these, not gated.

    ``solve`` smooths keyframes from a start, not gated, and raises LinAlgError as
    :meth:`.Smoother.smooth` does; ``motion_errors`` are the errors of links in a solution.
    """
    are_slips = np.zeros(len(keyframes.slips), dtype=np.bool_)
    solution = start
    stated = inverse(keyframes.links.covariances[keyframes.slips])
    slipped = inverse(keyframes.slipped.covariances)
    price = np.linalg.slogdet(stated)[1] - np.linalg.slogdet(slipped)[1]
    for _ in range(ROUNDS):
        solution = solve(keyframes.with_slips(are_slips), solution)
        errors = motion_errors(keyframes, solution)[keyframes.slips]
        paid = np.einsum('si,sij,sj->s', errors, stated - slipped, errors)
        pay = np.asarray(paid > price)
        if np.array_equal(pay, are_slips):
            break
        are_slips = pay
    return are_slips, solution


def inverse(covariances: FloatArray) -> FloatArray:
    """Return inverses of covariances (…, d, d); an exact position counts as known to EXACT_M."""
    known = covariances + EXACT_M**2 * np.eye(covariances.shape[-1])
    if known.ndim == 2:
        return definite_inverse(known)
    return np.asarray(np.linalg.inv(known), dtype=np.float64)
