"""The observer with its gains, its noise and its landmark table: one state that moves on."""

from __future__ import annotations

from collections import Counter

import numpy as np

from slam_observer_ros.association.landmark_index import LandmarkIndex
from slam_observer_ros.association.visibility import Surroundings
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import Smoothed
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.axes import axes_of
from slam_observer_ros.observer.designs import make_gains
from slam_observer_ros.observer.observer import Observer
from slam_observer_ros.sensor_models.integration import integrate
from slam_observer_ros.sensor_models.motion import Motion
from slam_observer_ros.sensor_models.motion_noise import MotionNoise
from slam_observer_ros.sensor_models.observation_noise import ObservationNoise
from slam_observer_ros.sensor_models.velocity_history import VelocityHistory
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.state import covariances
from slam_observer_ros.state.landmark_table import LandmarkTable
from slam_observer_ros.state.matching import MatchedObservation, MeasurementModel


class Slam:
    """Pose and map as of one instant.

    What an observation makes of it is in :mod:`slam_observer_ros.state.step`.

    Parameters
    ----------
    settings : Settings
        All settings.
    initial_pose : FloatArray
        (4, 4) pose at the start, body to world; also the reference P°.

    Attributes
    ----------
    observer : Observer
        State X̂ and reference ξ°.
    axes : Axes
        What of the pose and of points is estimated.
    gains : GainDesign
        What turns residuals into corrections.
    landmarks : LandmarkTable
        Ids and counts of the n known landmarks.
    is_mapping : bool
        Whether landmarks are added, and taken to have moved if they are rejected too often.
    motion_noise : MotionNoise
        Noise of velocities.
    observation_noise : ObservationNoise
        Noise of observed points.
    measurement_model : MeasurementModel
        Where landmarks should be seen.
    index : LandmarkIndex
        For landmarks near a point.
    surroundings : Surroundings
        What is in view of a sensor that gives no ids.
    counts : Counter
        How many landmarks were rejected, have moved, were forgotten and so on.
    rejected_in_a_row : int
        Observations since the last one of which a known landmark was not rejected.
    was_contradicted : bool
        Whether of the latest observation of known landmarks most were rejected.

    """

    def __init__(self, settings: Settings, initial_pose: FloatArray) -> None:
        self.settings = settings
        self.observer = Observer(initial_pose)
        self.axes = axes_of(settings.two_d_mode)
        self.gains = make_gains(settings)
        self.landmarks = LandmarkTable()
        self.is_mapping = True
        self.counts: Counter[str] = Counter()
        self.rejected_in_a_row = 0
        self.was_contradicted = False
        self.motion_noise = MotionNoise(settings)
        self.observation_noise = ObservationNoise(settings)
        self.measurement_model = MeasurementModel(
            self.observer, self.landmarks, self.observation_noise, settings
        )
        # Around the state's stamp, as the last motion had it; the next one begins with the same.
        self._end_velocity: FloatArray | None = None
        self.index = LandmarkIndex()
        self.surroundings = Surroundings(self.observer, self.landmarks, self.axes.point)

    @property
    def is_fixed(self) -> bool:
        """Whether the landmarks are those of a map that is exact, and at rest."""
        return not self.is_mapping and self.settings.localization_mode == 'fixed'

    @property
    def confirmed(self) -> IntArray:
        """Rows of the landmarks seen often enough to be in the map.

        One that was seen once or twice may still be an outlier, and one without an id may be a
        false point for longer; it helps to tell the pose, but nobody is told of it.
        """
        often = self.landmarks.counts >= self.settings.confirmations
        return np.flatnonzero(often & ~self.landmarks.tentative)

    @property
    def world_points(self) -> FloatArray:
        """(n, 3) estimated landmarks, metres, world."""
        observer = self.observer
        shifts = se3.rotate(observer.reference_pose, self.gains.postponed_shifts())
        return observer.world_points + shifts

    @property
    def landmark_covariances(self) -> FloatArray | None:
        """(n, 3, 3) covariances of the landmarks, world, m²; None where the gains know none."""
        return covariances.of_landmarks(self.observer, self.gains.landmark_error_covariances)

    def landmark_covariances_after(self, duration_s: float) -> FloatArray | None:
        """Return the same as they will be when landmarks that move have moved on."""
        after = self.gains.landmark_error_covariances_after(self.observer, duration_s)
        return covariances.of_landmarks(self.observer, after)

    def pose_after(
        self, velocities: VelocityHistory, start_ns: int, end_ns: int
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return what the pose will be at ``end_ns``, and how uncertain it will be.

        Returns
        -------
        pose : FloatArray
            (4, 4) body to world.
        covariance : FloatArray or None
            (6, 6) of its rotation vector and position, along the world's axes, rad² and m². None
            where the gains know none.

        """
        moved = self._motion(velocities, start_ns, end_ns)
        after = self.gains.pose_error_covariance_after(moved)
        A = moved.path[-1]
        return self.observer.reference_pose @ A, covariances.of_pose(self.observer, after, A)

    def set_pose(self, pose: FloatArray, covariance: FloatArray | None) -> None:
        """Move the robot and keep the map; what they have to do with each other is forgotten.

        Parameters
        ----------
        pose : FloatArray
            (4, 4) body to world.
        covariance : FloatArray or None
            (6, 6) as :meth:`pose_after` has it; None for an exact pose.

        """
        observer = self.observer
        if not len(self.landmarks):
            # Else ε would turn about an origin that may be kilometres away.
            observer.reference_pose = pose
        observer.A = se3.inverse(observer.reference_pose) @ pose
        self.was_contradicted = False
        given = np.zeros((6, 6)) if covariance is None else covariance
        self.gains.set_pose_error_covariance(covariances.of_pose_error(observer, given))
        self.gains.restart(observer, 'the pose was set')

    def restart_time(self) -> None:
        """Go on from here at any other time; what was seen before can't be looked back at."""
        self._end_velocity = None
        self.was_contradicted = False
        self.landmarks.restart_time()
        self.gains.restart(self.observer, 'the clock jumped')

    def change_settings(self, settings: Settings) -> None:
        """Use other values of the settings that may change, from now on."""
        self.settings = settings
        self.gains.change_settings(settings)

    def advance(self, velocities: VelocityHistory, start_ns: int, end_ns: int) -> None:
        """Move the state, which is that of ``start_ns``, on to ``end_ns``."""
        moved = self._motion(velocities, start_ns, end_ns)
        self.observer.propagate(moved.path)
        self.observer.move_landmarks(moved.duration_s)
        self.gains.predict(self.observer, moved)
        self._end_velocity = None if moved.at_ends is None else moved.at_ends[1]

    def _motion(self, velocities: VelocityHistory, start_ns: int, end_ns: int) -> Motion:
        return integrate(
            velocities,
            self.gains.calibration,
            self.motion_noise,
            self.observer.A,
            start_ns,
            end_ns,
            self._end_velocity,
        )

    @property
    def landmark_velocity_error(self) -> float:
        """How fast landmarks may move, m/s, where it is estimated; else 0, as sensors tell it."""
        is_ignored = 'landmark_velocity_error' in self.gains.ignores
        return 0.0 if self.is_fixed or is_ignored else self.settings.landmark_velocity_error

    def match(self, event: ObservationEvent) -> MatchedObservation:
        """Match an observation made at the state's instant with landmarks, before it is used.

        It moves landmarks whose gains had put that off.
        """
        m, rows = len(event.ids), self.landmarks.rows_of(event.ids)
        if not self.is_mapping:
            event, rows = self.mapped(event)
        self.gains.recall(self.observer, rows)
        return self.measurement_model.match(event, rows, m - len(event.ids))

    def mapped(self, event: ObservationEvent) -> tuple[ObservationEvent, IntArray]:
        """Return the part of an observation that is of known landmarks, and their rows."""
        rows = self.landmarks.rows_of(event.ids)
        return event.select(rows >= 0), rows[rows >= 0]

    def smooth(self) -> Smoothed:
        """Return trajectory and map in hindsight; see :meth:`.GainDesign.smooth`."""
        found, rows = self.gains.smooth(self.observer), self.confirmed
        P = self.observer.reference_pose
        return Smoothed(
            stamps_ns=found.stamps_ns,
            poses=P @ found.poses,
            world_points=se3.transform(P, found.points[rows]),
            ids=self.landmarks.ids[rows],
            since=found.since,
        )

    def remove(self, rows: IntArray) -> None:
        """Forget the landmarks at ``rows``."""
        self.observer.remove_landmarks(rows)
        self.gains.remove_landmarks(rows)
        self.landmarks.remove(rows)
