"""The paper's simulation through the estimator, and how fast its Lyapunov function decreases."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimates import Update
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.evaluation.metrics import Decay, fit_decay
from slam_observer_ros.evaluation.trajectory import PoseTruth, Trajectory
from slam_observer_ros.observer.continuous_time import lyapunov
from slam_observer_ros.runs.sampling import PoseSamples
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.simulation import SimulatedEvent, Simulation

LYAPUNOV_FLOOR = 1e-40
"""What log10 L is taken of where every residual is exactly zero, so that it stays finite."""

ROUNDING_MARGIN = 1e6
"""How far above the level of rounding L must be for the slope to be fitted to it."""


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedRun:
    """What came of a simulated run.

    ``lyapunov`` (k,) is L (34) before each correction; ``times_s`` (k,) are since the start. The
    ``decay`` is that of :func:`.fit_decay`. The poses ``estimate`` and ``truth`` have the
    same p stamps, and so have ``landmark_tracks`` (p, n, 3) of the estimate, in its world, metres;
    they are NaN before the first sighting.
    """

    times_s: FloatArray
    lyapunov: FloatArray
    decay: Decay | None
    estimate: Trajectory
    truth: Trajectory
    landmark_tracks: FloatArray

    @property
    def log10_lyapunov(self) -> FloatArray:
        """(k,) log10 L, of :data:`LYAPUNOV_FLOOR` where L is smaller than that."""
        return np.log10(np.maximum(self.lyapunov, LYAPUNOV_FLOOR))


def run_simulation(
    simulation: Simulation, events: Iterable[SimulatedEvent], settings: Settings
) -> SimulatedRun:
    """Run events, as a simulation delivers them, through an estimator with these settings."""
    run = _RunningSimulation(simulation, settings)
    for event in events:
        if not isinstance(event, PoseTruth):
            run.estimator.add(event)
    run.estimator.flush()
    return run.result()


class _RunningSimulation:
    """Keeps L of every update and, at most 20 times a second, the configuration."""

    def __init__(self, simulation: Simulation, settings: Settings) -> None:
        self.estimator = Estimator(settings, on_update=self._on_update)
        self._simulation = simulation
        self._lyapunov: dict[int, float] = {}
        self._samples = PoseSamples()
        self._landmark_tracks: list[FloatArray] = []

    def _on_update(self, update: Update) -> None:
        if len(update.ids):
            self._lyapunov[update.stamp_ns] = update.lyapunov
        stamps_ns = np.array([update.stamp_ns])
        if not self._samples.due(stamps_ns):
            return
        self._samples.add(stamps_ns, update.pose[None])
        points = np.full((len(self._simulation.landmark_ids), 3), np.nan)
        points[self.estimator.landmark_ids] = self.estimator.world_points
        self._landmark_tracks.append(points)

    def result(self) -> SimulatedRun:
        estimate = self._samples.trajectory
        times_s = to_s(np.array(list(self._lyapunov)) - self._simulation.start_ns)
        levels = np.array(list(self._lyapunov.values()))
        return SimulatedRun(
            times_s,
            levels,
            fit_decay(times_s, levels, ROUNDING_MARGIN * self._rounding()),
            estimate,
            Trajectory(estimate.stamps_ns, self._simulation.pose(estimate.stamps_ns)),
            np.array(self._landmark_tracks),
        )

    def _rounding(self) -> float:
        """Return L of residuals that are the rounding of the landmarks' coordinates."""
        rounding = self.estimator.world_points * np.finfo(np.float64).eps
        return lyapunov(self.estimator.settings.gain_k, rounding)
