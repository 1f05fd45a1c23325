"""A run of an estimator in which anything that is allowed may happen, and much that is not."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields, replace
import logging

import numpy as np

from slam_observer_ros.common.errors import SlamObserverError
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import (
    AngularVelocityEvent,
    ObservationEvent,
    UNKNOWN_ID,
    VelocityBlock,
    VelocityEvent,
)
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.matrices import are_covariances, diagonal_blocks
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.parameter_table import Parameter, table, Value
from slam_observer_ros.tracking.matching import flipped

ROWS = table(Settings)

HUGE = (1e6, 1e9, 1e12, 1e155, 1e300, 1.7e308)


def any_value(rng: np.random.Generator, row: Parameter) -> Value:
    """A value of a parameter's whole range: its ends, its default, any order of magnitude."""
    if isinstance(row.default, bool):
        return bool(rng.integers(2))
    if row.choices:
        return str(rng.choice(row.choices))

    def number() -> float:
        kind = rng.integers(4)
        if kind < 2:
            return (row.minimum, row.maximum)[kind]
        low = max(row.minimum, 1e-12 * row.maximum)
        return float(np.clip(low * (row.maximum / low) ** rng.random(), row.minimum, row.maximum))

    if isinstance(row.default, tuple):
        return as_list(row, [number() for _ in row.default])
    return int(number()) if isinstance(row.default, int) else number()


def as_list(row: Parameter, numbers: list[float]) -> Value:
    """Numbers as a parameter takes them: of a pose, the last three are angles."""
    if len(numbers) == 6:
        numbers[3:] = np.clip(numbers[3:], -6.28, 6.28).tolist()
    return tuple(numbers)


def any_settings(rng: np.random.Generator, share: float, live_only: bool = False) -> Settings:
    """Settings of which a share has any value at all."""
    changed = {
        row.name: any_value(rng, row)
        for row in ROWS
        if rng.random() < share and not (live_only and row.read_only)
    }
    return Settings(**changed)


class AnyRun:
    """An estimator, a world of tags and points, and calls of all kinds."""

    def __init__(self, rng: np.random.Generator, settings: Settings) -> None:
        self.rng, self.estimator = (
            rng,
            Estimator(settings, judges_innovations=bool(rng.integers(2))),
        )
        self._stamp_ns, self._pose = 10**18, np.eye(4)
        n = int(rng.integers(1, 12))
        self._points = rng.uniform(-8.0, 8.0, (n, 3)) * [1.0, 1.0, 0.3]
        self._turns = so3.exp(rng.normal(scale=2.0, size=(n, 3)))
        self._calls: list[tuple[float, Callable[[], object]]] = [
            (10.0, self._velocity),
            (12.0, self._observation),
            (4.0, self._velocities),
            (2.0, self._angular_velocity),
            (1.0, self._changed_settings),
            (0.3, self._given_pose),
            (0.3, self._loaded_map),
            (0.2, self._own_map),
            (0.2, lambda: self.estimator.forget(int(rng.integers(n)))),
            (0.1, self.estimator.reset),
            (0.1, lambda: self.estimator.handle_clock_jump(None)),
            (0.2, self._smoothed),
            (0.3, self.estimator.flush),
        ]

    def run(self, calls: int) -> None:
        """Make so many calls, and hold after each that the estimate is one."""
        weights = np.array([weight for weight, _ in self._calls])
        for index in self.rng.choice(len(weights), calls, p=weights / weights.sum()):
            self._calls[index][1]()
            self._check()

    def _check(self) -> None:
        estimator = self.estimator
        pose, covariance = estimator.pose, estimator.pose_covariance
        assert np.isfinite(pose).all()
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6)
        for array in (covariance, estimator.landmark_covariances):
            if array is not None:
                assert np.isfinite(array).all()
                assert are_covariances(array).all()
        assert np.isfinite(estimator.world_points).all()
        assert np.isfinite(estimator.body_velocity).all()
        assert np.isfinite(estimator.lyapunov)

    def _next_stamp(self) -> int:
        kind = self.rng.random()
        if kind < 0.02:  # late, very late, ahead, after a gap
            return self._stamp_ns - int(self.rng.choice([10**7, 10**9, 10**11]))
        if kind < 0.03:
            return self._stamp_ns + int(self.rng.choice([10**10, 10**12, 2**62]))
        self._stamp_ns += int(
            self.rng.choice([0, 1, 10**7, 10**8, 3 * 10**9], p=[0.1, 0.1, 0.4, 0.35, 0.05])
        )
        return self._stamp_ns

    def _body_velocity(self) -> FloatArray:
        V = self.rng.normal(size=6) * [0.1, 0.1, 0.4, 1.0, 0.1, 0.1]
        if self.rng.random() < 0.05:
            V *= self.rng.choice([0.0, 30.0, 1e300, np.inf, np.nan])
        return V

    def _covariances(self, *shape: int) -> FloatArray:
        """Covariances (…, d, d): of any scale, with zeros, unknown, a few of them wrong."""
        rng, d = self.rng, shape[-1]
        roots = rng.normal(size=(*shape, d)) * 10.0 ** rng.uniform(-8.0, 4.0, (*shape[:-1], 1, d))
        matrices: FloatArray = roots @ roots.swapaxes(-1, -2)
        kind = rng.integers(8)
        if kind == 0:
            matrices[..., 0, :] = matrices[..., :, 0] = 0.0
        elif kind == 1:
            matrices[..., 0, 0] = rng.choice(HUGE)
        elif kind == 2:
            matrices[:] = np.eye(d) * rng.choice([0.0, 1e-12, 0.01, 1.0, 1e9, 1.7e308])
        elif kind == 3:
            i, j = rng.integers(d, size=2)
            matrices[..., i, j] = rng.choice([-1.0, -1e-9, *HUGE, np.nan])
        return matrices

    def _velocity(self) -> None:
        V, stated = self._body_velocity(), self.rng.random() < 0.4
        covariance = self._covariances(6) if stated else None
        is_mean = bool(self.rng.random() < 0.1)
        self.estimator.add(VelocityEvent(self._next_stamp(), V, covariance, is_mean=is_mean))
        if np.abs(V).max() < 10.0:
            self._pose = self._pose @ se3.exp(0.05 * V)

    def _velocities(self) -> None:
        k = int(self.rng.integers(1, 40))
        stamps_ns = np.sort(self._stamp_ns + self.rng.integers(0, 10**9, size=k))
        V = self.rng.normal(scale=0.2, size=(k, 6))
        if self.rng.random() < 0.1:
            V[self.rng.integers(k)] = self._body_velocity()
        covariances = self._covariances(k, 6) if self.rng.random() < 0.4 else None
        self.estimator.add_velocities(VelocityBlock(stamps_ns, V, covariances))
        self._stamp_ns = int(stamps_ns[-1])

    def _angular_velocity(self) -> None:
        covariance = self._covariances(3) if self.rng.random() < 0.4 else None
        angular_velocity = self._body_velocity()[:3]
        event = AngularVelocityEvent(self._next_stamp(), angular_velocity, covariance)
        self.estimator.add(event)

    def _ids(self, rows: IntArray) -> IntArray:
        ids = rows.copy()
        kind = self.rng.random()
        if kind < 0.15:
            ids[:] = UNKNOWN_ID
        elif kind < 0.3:  # some unknown, repeated, wrong, reserved
            others = [UNKNOWN_ID, 0, 3, 10_000_005, 2**32 - 2]
            ids[self.rng.random(len(ids)) < 0.3] = self.rng.choice(others)
        return ids

    def _observation(self) -> None:
        rng = self.rng
        rows = np.flatnonzero(rng.random(len(self._points)) < 0.6)
        m, back = len(rows), se3.inverse(self._pose)
        points = se3.transform(back, self._points[rows]) + rng.normal(scale=0.03, size=(m, 3))
        if m and rng.random() < 0.1:
            points[rng.integers(m)] *= rng.choice([0.0, -1.0, 1e-9, 1e3, 1e5, 1e300, np.nan])
        Z = back[:3, :3] @ self._turns[rows] @ so3.exp(rng.normal(scale=0.03, size=(m, 3)))
        are_flipped, unset = rng.random((2, m)) < 0.15
        Z[are_flipped] = flipped(Z[are_flipped], points[are_flipped])
        Z[unset] = rng.choice([0.0, 1.0004])
        if rng.random() < 0.05:
            Z = Z * rng.choice([1.0004, 1.1, -1.0, np.nan])
        some = rng.random(5) < [0.3, 0.1, 0.2, 0.6, 0.3]
        event = ObservationEvent(
            self._next_stamp(),
            self._ids(rows),
            points,
            self._covariances(m, 3) if some[0] else None,
            rng.normal(scale=0.2, size=(m, 3)) if some[1] else None,
            rng.normal(scale=0.2, size=(m, 3)) if some[2] else None,
            orientations=Z if some[3] else None,
            orientation_covariances=self._covariances(m, 3) if some[4] else None,
        )
        self.estimator.add(event)

    def _changed_settings(self) -> None:
        live = any_settings(self.rng, 0.3, live_only=True)
        names = [row.name for row in ROWS if not row.read_only]
        changed = {name: getattr(live, name) for name in names}
        self.estimator.change_settings(replace(self.estimator.settings, **changed))

    def _given_pose(self) -> None:
        scale = self.rng.choice([1.0, 1.0004, 1.1])
        pose = se3.pose(scale * self._pose[:3, :3], self._pose[:3, 3] * self.rng.choice([1, 1e6]))
        with suppress(SlamObserverError):
            covariance = self._covariances(6) if self.rng.random() < 0.7 else None
            self.estimator.set_pose(pose, covariance)

    def _loaded_map(self) -> None:
        rng, n = self.rng, len(self._points)
        tags = rng.random(n) < 0.6
        R = self._turns * tags[:, None, None]
        joint = self._covariances(3 * (n + int(tags.sum())))
        known = LandmarkMap(
            np.arange(n),
            self._points * rng.choice([1.0, 1.0, 1.0, 1e3, 1e9]),
            diagonal_blocks(joint[: 3 * n, : 3 * n].copy(), 3),
            rng.integers(0, 3, size=n),
            'map',
            R if tags.any() else None,
            np.full(n, rng.choice([0.0, 0.1, 1e12])) if tags.any() else None,
            joint,
        )
        if rng.random() < 0.5:
            known = replace(known, joint_covariance=None)
        pose = self._pose if rng.random() < 0.5 else None
        with suppress(SlamObserverError):
            covariance = self._covariances(6) if pose is not None else None
            self.estimator.load_map(known, pose, covariance)

    def _own_map(self) -> None:
        with suppress(SlamObserverError):
            known = self.estimator.landmark_map
            for field in fields(known):
                array = getattr(known, field.name)
                assert not isinstance(array, np.ndarray) or np.isfinite(array).all()
            self.estimator.load_map(known, self._pose if self.rng.random() < 0.5 else None)

    def _smoothed(self) -> None:
        with suppress(SlamObserverError):
            assert np.isfinite(self.estimator.smooth().poses).all()


def quietly(run: Callable[[], None]) -> None:
    """Make a run without its log."""
    logging.disable()
    try:
        run()
    finally:
        logging.disable(logging.NOTSET)
