"""Whether the robot knows where it is: for /diagnostics, and for behaviour trees."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
import numpy as np
from rclpy.node import Node
from std_msgs.msg import Bool

from slam_observer_ros.common.findings import Finding, Level
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimates import Update
from slam_observer_ros.estimator.estimate import Estimate
from slam_observer_ros.nodes.guarded_node import ThrottledLog
from slam_observer_ros.nodes.ros_interface import LATCHED_QOS
from slam_observer_ros.runs.health import of_fit
from slam_observer_ros.runs.live_health import localisation
from slam_observer_ros.settings.node_settings import ObserverNodeSettings

RECENT = 300  # observations over which innovations are compared with the noise that is stated
MIN_DEGREES = 100  # of freedom, that it takes to say so; the factor is then known to 7 %
FOUND_AGAIN = 0.8  # of the error level: near it the robot would be lost and found all the time


class NoiseFit:
    """Compares the innovations of late with the noise that is stated."""

    def __init__(self) -> None:
        self._recent: deque[tuple[float, int]] = deque(maxlen=RECENT)

    def add(self, update: Update) -> None:
        """Count an observation, if the gains know what was to be expected of it."""
        innovation = update.innovation
        if innovation is not None and innovation.nis is not None:
            self._recent.append((innovation.nis, innovation.degrees_of_freedom))

    @property
    def factor(self) -> float | None:
        """How many times as large as stated innovations are; None while that is not known."""
        degrees = sum(each for _, each in self._recent)
        if degrees < MIN_DEGREES:
            return None
        return float(np.sqrt(sum(nis for nis, _ in self._recent) / degrees))

    @property
    def findings(self) -> list[Finding]:
        """What is wrong with the noise that is stated."""
        return of_fit(self.factor)

    def __str__(self) -> str:
        """Return the factor, and what is wrong with the noise by it."""
        if self.factor is None:
            return 'not known yet'
        return f'{self.factor:.2f}' + ''.join(f' ({each.what})' for each in self.findings)


class LocalisationStatus:
    """Judges the standard deviations of position and heading; publishes ``~/is_localised``."""

    def __init__(
        self, node: Node, settings: ObserverNodeSettings, estimator: Estimate, noise: NoiseFit
    ) -> None:
        self._node = node
        self._settings = settings
        self._estimator = estimator
        self._noise = noise
        self._log = ThrottledLog(node)
        self._is_localised: bool | None = None
        self._was_localised = False
        self._publisher = node.create_publisher(Bool, '~/is_localised', LATCHED_QOS)

    def publish(self) -> None:
        """Publish, and log, whether the robot is localised, if that has changed."""
        share = FOUND_AGAIN if self._is_localised is False else 1.0
        level, message = localisation(self._estimator, self._settings, self._deviations(), share)
        is_localised = level < Level.ERROR and self._estimator.stamp_ns is not None
        if is_localised == self._is_localised:
            return
        if self._is_localised:
            self._log.warning('lost', f'not localised any more: {message}')
        elif self._was_localised:
            self._log.info('found', 'localised again')
        self._is_localised = is_localised
        self._was_localised |= is_localised
        self._publisher.publish(Bool(data=is_localised))

    @property
    def findings(self) -> list[Finding]:
        """What is wrong with the noise that is stated."""
        return self._noise.findings

    def status(self, hardware_id: str, findings: Iterable[Finding]) -> DiagnosticStatus:
        """Return the status for /diagnostics, with those findings that nothing else explains."""
        deviations = self._deviations()
        level, message = localisation(self._estimator, self._settings, deviations)
        for finding in findings:
            if finding.level >= Level.WARNING:
                level = max(level, Level.WARNING)
                message = f'{message}; {finding.what}'
        known = ('unknown', 'unknown') if deviations is None else [f'{d:.3f}' for d in deviations]
        values = {
            'map': self._estimator.map_name or 'none',
            'position, standard deviation [m]': known[0],
            'heading, standard deviation [rad]': known[1],
            'innovations / stated noise': str(self._noise),
        }
        return DiagnosticStatus(
            level=bytes([level]),
            name=f'{self._node.get_fully_qualified_name().lstrip("/")}: localisation',
            hardware_id=hardware_id,
            message=message,
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )

    def _deviations(self) -> tuple[float, float] | None:
        """Return standard deviations of position, m, and heading, rad; None if not known."""
        if self._estimator.stamp_ns is None:
            return None
        covariance = self._estimator.pose_covariance
        return None if covariance is None else deviations(covariance)


def deviations(covariance: FloatArray) -> tuple[float, float]:
    """Return standard deviations of position, in its worst direction, m, and of heading, rad.

    ``covariance`` (6, 6) has rotation vector and position along the map's axes; both are
    infinite if it is not finite.
    """
    if not np.isfinite(covariance).all():
        return np.inf, np.inf
    position_m2 = float(np.linalg.eigvalsh(covariance[3:, 3:])[-1])
    return float(np.sqrt(max(position_m2, 0.0))), float(np.sqrt(max(covariance[2, 2], 0.0)))
