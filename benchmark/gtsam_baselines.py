"""GTSAM's iSAM2 and its batch optimisation, fed with what the observer gets.

One pose an observation. Odometry between two observations is one ``BetweenFactor`` whose
covariance comes from the velocities in between; each point seen is a ``BearingRangeFactor`` whose
standard deviations are by the observer's noise model along and across the line of sight,
under Huber's loss with the observer's threshold. ``Pose2``/``Point2`` in ``two_d_mode``, otherwise
``Pose3``/``Point3``. There is no state for the velocity's scale or bias.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

from baseline_noise import BaselineNoise
import gtsam
import numpy as np
from odometry import Event, Odometry

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.settings.estimator_settings import Settings

FIRST_POSE_DEVIATION = 1e-4
"""The first pose is the map's frame: known to this, rad and m."""

LEAST_VARIANCE = 1e-8
"""Of a motion, rad² and m²: from what is known better, as of a robot that stands, Cholesky's
factorisation loses so many digits that GTSAM gives up."""

RELINEARISE_THRESHOLD = 0.01
"""Change (rad, m) from which iSAM2 linearises a variable again; a tenth of GTSAM's default."""


class IndeterminateError(Exception):
    """GTSAM gave up: its linear system became singular."""


class Factors(Protocol):
    """What differs between the plane and space."""

    def pose(self, matrix: FloatArray) -> Any:
        """Return GTSAM's pose of a matrix (4, 4)."""

    def prior(self) -> Any:
        """Return the factor that holds pose 0."""

    def between(self, key: int, motion: FloatArray, covariance: FloatArray) -> Any:
        """Return the odometry from pose ``key`` − 1 to pose ``key``."""

    def observation(
        self, key: int, landmark: int, point: FloatArray, covariance: FloatArray
    ) -> Any:
        """Return the factor of a landmark seen at ``point`` (3,) from pose ``key``."""

    def guess(self, pose: Any, point: FloatArray) -> FloatArray:
        """Return where a landmark is that is seen at ``point`` (3,), world."""

    def matrix(self, pose: Any) -> FloatArray:
        """Return a GTSAM pose as a (4, 4) array."""

    def pose_of(self, values: Any, key: int) -> Any:
        """Return GTSAM's pose ``key``."""

    def point_of(self, values: Any, landmark: int) -> FloatArray:
        """Return a landmark (3,), world."""


class PlanarFactors:
    """``Pose2`` and ``Point2``."""

    def __init__(self, huber_threshold: float) -> None:
        self._huber_threshold = huber_threshold

    def pose(self, matrix: FloatArray) -> gtsam.Pose2:
        """Return the ``Pose2`` of a matrix (4, 4)."""
        return gtsam.Pose2(matrix[0, 3], matrix[1, 3], np.arctan2(matrix[1, 0], matrix[0, 0]))

    def prior(self) -> gtsam.PriorFactorPose2:
        """Hold pose 0 at the identity."""
        noise = gtsam.noiseModel.Isotropic.Sigma(3, FIRST_POSE_DEVIATION)
        return gtsam.PriorFactorPose2(0, gtsam.Pose2(), noise)

    def between(
        self, key: int, motion: FloatArray, covariance: FloatArray
    ) -> gtsam.BetweenFactorPose2:
        """Link pose ``key`` to the one before it; ``Pose2``'s order is x, y, θ."""
        axes = np.ix_([3, 4, 2], [3, 4, 2])
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance[axes])
        return gtsam.BetweenFactorPose2(key - 1, key, self.pose(motion), noise)

    def observation(
        self, key: int, landmark: int, point: FloatArray, covariance: FloatArray
    ) -> gtsam.BearingRangeFactor2D:
        """Link pose ``key`` to a landmark."""
        range_m, along, across = _along_and_across(point, covariance)
        noise = _huber(np.array([across / range_m, along]), self._huber_threshold)
        bearing = gtsam.Rot2(np.arctan2(point[1], point[0]))
        return gtsam.BearingRangeFactor2D(key, landmark, bearing, range_m, noise)

    def guess(self, pose: gtsam.Pose2, point: FloatArray) -> FloatArray:
        """Return where a landmark is (2,) that is seen at ``point``."""
        return np.asarray(pose.transformFrom(point[:2]))

    def matrix(self, pose: gtsam.Pose2) -> FloatArray:
        """Return a GTSAM pose as a (4, 4) array."""
        matrix = np.eye(4)
        matrix[:2, :2] = pose.rotation().matrix()
        matrix[:2, 3] = pose.translation()
        return matrix

    def pose_of(self, values: gtsam.Values, key: int) -> gtsam.Pose2:
        """Return pose ``key``."""
        return values.atPose2(key)

    def point_of(self, values: gtsam.Values, landmark: int) -> FloatArray:
        """Return a landmark (3,), world."""
        return np.append(values.atPoint2(landmark), 0.0)


class SpatialFactors:
    """``Pose3`` and ``Point3``; tangent vectors of ``Pose3`` are (Ω, v) as here."""

    def __init__(self, huber_threshold: float) -> None:
        self._huber_threshold = huber_threshold

    def pose(self, matrix: FloatArray) -> gtsam.Pose3:
        """Return the ``Pose3`` of a matrix (4, 4)."""
        return gtsam.Pose3(matrix)

    def prior(self) -> gtsam.PriorFactorPose3:
        """Hold pose 0 at the identity."""
        noise = gtsam.noiseModel.Isotropic.Sigma(6, FIRST_POSE_DEVIATION)
        return gtsam.PriorFactorPose3(0, gtsam.Pose3(), noise)

    def between(
        self, key: int, motion: FloatArray, covariance: FloatArray
    ) -> gtsam.BetweenFactorPose3:
        """Link pose ``key`` to the one before it."""
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        return gtsam.BetweenFactorPose3(key - 1, key, self.pose(motion), noise)

    def observation(
        self, key: int, landmark: int, point: FloatArray, covariance: FloatArray
    ) -> gtsam.BearingRangeFactor3D:
        """Link pose ``key`` to a landmark."""
        range_m, along, across = _along_and_across(point, covariance)
        deviations = np.array([across / range_m, across / range_m, along])
        noise = _huber(deviations, self._huber_threshold)
        return gtsam.BearingRangeFactor3D(key, landmark, gtsam.Unit3(point), range_m, noise)

    def guess(self, pose: gtsam.Pose3, point: FloatArray) -> FloatArray:
        """Return where a landmark is (3,) that is seen at ``point``."""
        return np.asarray(pose.transformFrom(point))

    def matrix(self, pose: gtsam.Pose3) -> FloatArray:
        """Return a GTSAM pose as a (4, 4) array."""
        return np.asarray(pose.matrix())

    def pose_of(self, values: gtsam.Values, key: int) -> gtsam.Pose3:
        """Return pose ``key``."""
        return values.atPose3(key)

    def point_of(self, values: gtsam.Values, landmark: int) -> FloatArray:
        """Return a landmark (3,), world."""
        return np.asarray(values.atPoint3(landmark))


@dataclass(frozen=True, slots=True)
class Frame:
    """What an observation adds to the graph.

    Attributes
    ----------
    key : int
        Of its pose.
    motion : Any
        GTSAM's pose of it in the frame before.
    factors : NonlinearFactorGraph
        Odometry (or the prior) and what was seen.
    landmarks : list of int
        (m,) keys of the landmarks seen.

    """

    key: int
    motion: Any
    factors: gtsam.NonlinearFactorGraph
    landmarks: list[int]


class FrameBuilder:
    """Makes factors of events.

    Parameters
    ----------
    settings : Settings
        Noise figures, Huber threshold and ``two_d_mode``.

    """

    def __init__(self, settings: Settings) -> None:
        kind = PlanarFactors if settings.two_d_mode else SpatialFactors
        self.kind: Factors = kind(settings.huber_threshold)
        self._odometry = Odometry(settings)
        self._noise = BaselineNoise(settings)
        self._count = 0

    def move(self, event: VelocityEvent) -> None:
        """Take in a velocity."""
        self._odometry.add(event)

    def corrected(self, event: ObservationEvent) -> ObservationEvent:
        """Return an observation as the settings state its sensor."""
        return self._noise.corrected(event)

    def see(self, event: ObservationEvent) -> Frame:
        """Return the frame of a corrected observation."""
        key = self._count
        self._count += 1
        motion, covariance = self._odometry.motion_to(event.stamp_ns)
        factors = gtsam.NonlinearFactorGraph()
        if key == 0:
            motion = np.eye(4)
            factors.add(self.kind.prior())
        else:
            covariance = covariance + LEAST_VARIANCE * np.eye(6)
            factors.add(self.kind.between(key, motion, covariance))
        landmarks = [gtsam.symbol('l', landmark_id) for landmark_id in event.ids.tolist()]
        own, larger = self._noise.add(event)
        covariances = own * larger[:, None, None]
        for landmark, point, noise in zip(landmarks, event.points, covariances, strict=True):
            factors.add(self.kind.observation(key, landmark, point, noise))
        return Frame(key, self.kind.pose(motion), factors, landmarks)


class Isam2:
    """iSAM2, updated and read out in full after each observation.

    Parameters
    ----------
    settings : Settings
        Noise figures, Huber threshold and ``two_d_mode``.
    parameters : ISAM2Params
        iSAM2's own settings.

    Attributes
    ----------
    values : Values
        Latest estimate of all poses and landmarks.
    landmark_keys : list of int
        Keys of the known landmarks.

    """

    def __init__(self, settings: Settings, parameters: gtsam.ISAM2Params) -> None:
        self._builder = FrameBuilder(settings)
        self._isam = gtsam.ISAM2(parameters)
        self._pose = self._builder.kind.pose(np.eye(4))
        self.landmark_keys: list[int] = []
        self._known: set[int] = set()
        self.values = gtsam.Values()

    @property
    def pose(self) -> FloatArray:
        """(4, 4) pose at the last observation, body to world."""
        return self._builder.kind.matrix(self._pose)

    @property
    def landmark_ids(self) -> IntArray:
        """(n,) ids of the known landmarks."""
        return np.array([gtsam.symbolIndex(key) for key in self.landmark_keys], dtype=np.int64)

    @property
    def world_points(self) -> FloatArray:
        """(n, 3) estimated landmarks, metres, world."""
        point_of = self._builder.kind.point_of
        return np.array([point_of(self.values, key) for key in self.landmark_keys])

    def add(self, event: Event) -> None:
        """Take in an event; stamps must not decrease.

        Raises
        ------
        IndeterminateError
            If GTSAM's linear system became singular.

        """
        if isinstance(event, VelocityEvent):
            self._builder.move(event)
            return
        event = self._builder.corrected(event)
        frame = self._builder.see(event)
        guess = self._pose.compose(frame.motion)
        new = gtsam.Values()
        new.insert(frame.key, guess)
        for landmark, point in zip(frame.landmarks, event.points, strict=True):
            if landmark not in self._known:
                self._known.add(landmark)
                self.landmark_keys.append(landmark)
                new.insert(landmark, self._builder.kind.guess(guess, point))
        try:
            self._isam.update(frame.factors, new)
        except RuntimeError as error:
            raise IndeterminateError(f'at observation {frame.key}') from error
        self.values = self._isam.calculateEstimate()
        self._pose = self._builder.kind.pose_of(self.values, frame.key)


def accurate_isam2(settings: Settings) -> Isam2:
    """Return iSAM2 that linearises again after every observation, from a small change on."""
    parameters = gtsam.ISAM2Params()
    parameters.relinearizeSkip = 1
    parameters.setRelinearizeThreshold(RELINEARISE_THRESHOLD)
    return Isam2(settings, parameters)


def default_isam2(settings: Settings) -> Isam2:
    """Return iSAM2 with GTSAM's default parameters."""
    return Isam2(settings, gtsam.ISAM2Params())


def qr_isam2(settings: Settings) -> Isam2:
    """Return the same with QR in place of Cholesky: little slower, but good for long chains."""
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization('QR')
    return Isam2(settings, parameters)


def optimise_batch(
    events: Iterable[Event], settings: Settings, start: Isam2
) -> tuple[FloatArray, FloatArray]:
    """Optimise everything afterwards by Levenberg–Marquardt, from iSAM2's last estimate.

    Returns
    -------
    poses : FloatArray
        (s, 4, 4) pose at each observation.
    points : FloatArray
        (n, 3) landmarks, as ``start`` orders them.

    """
    builder = FrameBuilder(settings)
    graph = gtsam.NonlinearFactorGraph()
    keys = []
    for event in events:
        if isinstance(event, VelocityEvent):
            builder.move(event)
        else:
            frame = builder.see(builder.corrected(event))
            graph.push_back(frame.factors)
            keys.append(frame.key)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-9)
    values = gtsam.LevenbergMarquardtOptimizer(graph, start.values, parameters).optimize()
    kind = builder.kind
    poses = np.array([kind.matrix(kind.pose_of(values, key)) for key in keys])
    return poses, np.array([kind.point_of(values, key) for key in start.landmark_keys])


def _along_and_across(point: FloatArray, covariance: FloatArray) -> tuple[float, float, float]:
    """Return the range and the standard deviations along and across the line of sight, metres."""
    range_m = float(np.linalg.norm(point))
    sight = point / range_m
    along = float(sight @ covariance @ sight)
    across = 0.5 * (float(np.trace(covariance)) - along)
    return range_m, along**0.5, across**0.5


def _huber(deviations: FloatArray, threshold: float) -> gtsam.noiseModel.Base:
    noise = gtsam.noiseModel.Diagonal.Sigmas(deviations)
    if threshold == 0.0:
        return noise
    loss = gtsam.noiseModel.mEstimator.Huber.Create(threshold)
    return gtsam.noiseModel.Robust.Create(loss, noise)
