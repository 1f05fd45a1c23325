"""Places an estimate in the frame of a map that is known in advance.

Where the start is unknown the robot maps in a frame of its own at first. Once enough landmarks of
the known map are among its own, well enough spread, the whole estimate is moved into the known
frame and both maps become one. So it does not matter whether these landmarks are seen at once or
one after another, nor whether the map is known from the start or is loaded later.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.events import is_automatic
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.matrices import (
    block_diagonal,
    diagonal_blocks,
    transpose,
    with_variances_above,
)
from slam_observer_ros.known_map.landmark_map import LandmarkMap
from slam_observer_ros.known_map.map_alignment import find_transform
from slam_observer_ros.observer.gauge import gauge_information, JITTER_M2
from slam_observer_ros.observer.riccati.full_map import FullMapGains
from slam_observer_ros.state.state import Slam
from slam_observer_ros.state.step import Outcome

ROUNDING = 1e-14
"""Least variance that can be told from zero, as a share of the sum of all variances."""

NEWS = 0.1
"""Share of the observations that is new when the same landmarks are compared with a map again:
with many of them that takes long, and a single further observation seldom decides it.
"""

CONFIRMING_VOTES = 10
"""Observations that confirm a place that was told."""


def start_in_map(slam: Slam, known: LandmarkMap, pose_covariance: FloatArray | None) -> None:
    """Take a map into an estimate that has none yet, at a pose that is given in the map's frame.

    Parameters
    ----------
    slam : Slam
        At its start.
    known : LandmarkMap
        The map.
    pose_covariance : FloatArray or None
        (6, 6) covariance of rotation vector and position along the map's axes, rad² and m²;
        None for an exact pose.

    """
    slam.set_pose(slam.observer.pose, pose_covariance)
    _complete(slam, known)


def enter_map(slam: Slam, known: LandmarkMap) -> bool:
    """Move an estimate into the frame of a map, if enough of its landmarks have been seen.

    Landmarks that both have are merged. Those that contradict the others are taken as the map has
    them, and those that only the estimate has are kept where mapping goes on.

    Returns
    -------
    bool
        Whether the estimate is now in the map's frame.

    """
    slam.gains.recall(slam.observer, np.arange(len(slam.landmarks)))
    rows = slam.landmarks.rows_of(known.ids)
    shared = np.flatnonzero((rows >= 0) & ~is_automatic(known.ids))
    found = _find_frame(slam, rows[shared], known.select(shared))
    if found is None:
        return False
    slam.observer.reference_pose, agree = found
    merged = shared[agree]
    _merge(slam, rows[merged], known.select(merged))
    if slam.settings.localization_mode == 'off':
        slam.remove(rows[shared[~agree]])
    else:
        slam.remove(np.setdiff1d(np.arange(len(slam.landmarks)), rows[merged]))
    _renumber(slam, known)
    _complete(slam, known)
    return True


def is_lost(slam: Slam) -> bool:
    """Return whether a place in a map has been wrong for some time, or the robot was carried.

    All landmarks seen of late were rejected then, and as many as would do to find the place again
    were rejected so often that elsewhere they would be taken to have moved.
    """
    often = slam.settings.max_rejections
    moved = np.sum(slam.landmarks.rejections >= often)
    needed = slam.axes.point
    return bool(not slam.is_mapping and slam.rejected_in_a_row >= often and moved >= needed)


class PlaceSearch:
    """When a map is worth comparing with what was seen: it takes long, and seldom tells more."""

    def __init__(self) -> None:
        self._observations = self._compared_at = self._shared = 0

    def tell(self, shared: int) -> bool:
        """Count an observation; return whether to compare, now that ``shared`` landmarks are."""
        self._observations += 1
        if shared == self._shared and self._observations < (1.0 + NEWS) * self._compared_at:
            return False
        self._shared, self._compared_at = shared, self._observations
        return True


class PoseTrial:
    """A place in a map that someone has told, on trial until landmarks of the map confirm it.

    With a wrong one the map's landmarks would be rejected, and where mapping goes on be taken to
    have moved, all of them. Observations vote: against it, if more of the map's landmarks in them
    were rejected than believed. One alone may be garbled, and some landmarks have moved.

    Parameters
    ----------
    known : LandmarkMap
        The map.

    """

    def __init__(self, known: LandmarkMap) -> None:
        self._ids = known.ids
        self._for = self._against = 0

    def vote(self, outcome: Outcome, often: int) -> bool:
        """Count the vote of an observation; return whether ``often`` ones say it is wrong."""
        if self._for >= CONFIRMING_VOTES and self._for > self._against:
            return False
        rejected = int(np.isin(outcome.ids[outcome.rejected], self._ids).sum())
        believed = int(np.isin(outcome.ids, self._ids).sum()) - rejected
        self._for += int(believed > 0 and believed >= rejected)
        self._against += int(rejected > believed)
        return self._against >= often and self._against > self._for


def shape_covariances(slam: Slam) -> FloatArray | None:
    """Return covariances (n, 3, 3) of the landmarks in a frame that is their own, world axes, m².

    A map's frame starts where the robot did, and all landmarks share the error of how they lie to
    that pose. Who loads the map knows it by its landmarks alone: what remains is the error of
    its shape, P − G (Gᵀ P⁻¹ G)⁻¹ Gᵀ, with G as in :mod:`slam_observer_ros.observer.gauge`. None
    where the gains know no covariances.
    """
    n, axes, observer = len(slam.landmarks), slam.axes, slam.observer
    k, R = axes.point, observer.reference_pose[:3, :3]
    if not isinstance(slam.gains, FullMapGains) or n == 0:
        return slam.landmark_covariances
    joint = slam.gains.joint_covariance(np.arange(n))
    P = joint[axes.p :, axes.p :]
    G = axes.output_matrix(observer.y_ref - observer.y_ref.mean(axis=0)).reshape(n * k, -1)
    least_m2 = JITTER_M2 + ROUNDING * np.trace(P)
    information = gauge_information(G, with_variances_above(least_m2, P))
    G_each = G.reshape(n, k, -1)
    common = G_each @ np.linalg.pinv(information, hermitian=True) @ transpose(G_each)
    own = np.zeros((n, 3, 3))
    own[:, :k, :k] = diagonal_blocks(P, k) - common
    world: FloatArray = R @ own @ R.T
    return world


def _find_frame(
    slam: Slam, rows: IntArray, known: LandmarkMap
) -> tuple[FloatArray, BoolArray] | None:
    """Return P° (4, 4) in the frame of a map, of whose landmarks the estimate has ``rows``."""
    axes = slam.axes
    covariance = slam.gains.joint_covariance(rows)
    if covariance is None:
        covariance = _of_constant_gains(slam, rows)
    covariances = known.covariances_or(slam.settings.map_noise)
    points = slam.observer.points[rows]
    return find_transform(points, covariance, known.world_points, covariances, axes)


def _of_constant_gains(slam: Slam, rows: IntArray) -> FloatArray:
    """Return a covariance (p + m k, p + m k) of ε and m landmarks for gains that know none.

    The pose is exact; a landmark is as uncertain as it would be if it was seen from here once.
    """
    p, k = slam.axes.p, slam.axes.point
    noise = slam.observation_noise.at(slam.observer.body_points(rows))
    covariance = np.zeros((p + k * len(rows),) * 2)
    covariance[p:, p:] = block_diagonal(slam.observer.turned(noise)[:, :k, :k])
    return covariance


def _merge(slam: Slam, rows: IntArray, known: LandmarkMap) -> None:
    """Correct the estimate by what a map knows of the landmarks at ``rows``."""
    observer = slam.observer
    targets, covariances = _in_reference_frame(slam, known)
    r = observer.points[rows] - targets
    observer.correct(slam.gains.anchor(observer, rows, r, covariances))
    slam.gains.settle(observer)
    slam.landmarks.counts[rows] += _counts(known, slam)


def _counts(known: LandmarkMap, slam: Slam) -> IntArray:
    """Return how often landmarks of a map count as seen: a surveyed one is believed at once."""
    return np.asarray(np.maximum(known.counts, slam.settings.confirmations))


def _renumber(slam: Slam, known: LandmarkMap) -> None:
    """Give landmarks new numbers where the map's have the same, though no sensor gave these."""
    ids = slam.landmarks.ids
    own = np.flatnonzero(is_automatic(ids) & np.isin(ids, known.ids))
    taken = np.append(ids[is_automatic(ids)], known.ids[is_automatic(known.ids)])
    slam.landmarks.renumber(own, np.max(taken, initial=0) + 1 + np.arange(len(own)))


def _complete(slam: Slam, known: LandmarkMap) -> None:
    """Append what a map has beyond the estimate, now that both are in one frame."""
    observer, settings = slam.observer, slam.settings
    new = known.select(slam.landmarks.rows_of(known.ids) < 0)
    y_ref, covariances = _in_reference_frame(slam, new)
    observer.add_reference_landmarks(y_ref)
    observer.rebase(observer.points)
    slam.landmarks.add_known(new.ids, _counts(new, slam))
    slam.is_mapping = settings.localization_mode == 'off'
    if settings.localization_mode == 'fixed':
        _fix(slam, known)
    else:
        slam.gains.add_known_landmarks(covariances)
    slam.gains.restart(observer, 'the place in the loaded map was found')


def _fix(slam: Slam, known: LandmarkMap) -> None:
    """Put the landmarks exactly where the map has them, and leave them there."""
    order = np.argsort(known.ids)
    rows = order[np.searchsorted(known.ids, slam.landmarks.ids, sorter=order)]
    y_ref, covariances = _in_reference_frame(slam, known.select(rows))
    slam.observer.fix_landmarks(y_ref)
    slam.gains = slam.gains.with_fixed_landmarks(covariances)


def _in_reference_frame(slam: Slam, known: LandmarkMap) -> tuple[FloatArray, FloatArray]:
    """Return positions (m, 3) and covariances (m, 3, 3) of a map in the frame of P°."""
    back = se3.inverse(slam.observer.reference_pose)
    R = back[:3, :3]
    covariances: FloatArray = R @ known.covariances_or(slam.settings.map_noise) @ R.T
    return se3.transform(back, known.world_points), covariances
