"""Calibration as part of the state: of the velocity, by axis, and of each sensor of landmarks.

V_true(t) = (1 + s) ∘ V(t − τ) + b. The delay τ is how much later than its stamp a velocity shows
in what is observed: a command takes a while to be obeyed, and an image a while to be stamped. A
sensor's part, ψ, d and s of :mod:`slam_observer_ros.geometry.sensor_mounting`, begins with the
first observation from its frame.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace
import math

import numpy as np

from slam_observer_ros.common.stamps import to_ns
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.estimates import CalibrationEstimate, DELAY_NAME
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.axes import EstimatedAxes
from slam_observer_ros.sensor_models.held_velocities import HeldUntil, HeldVelocities
from slam_observer_ros.settings.estimator_settings import MAX_DELAY_S, Settings

NAMES = (
    *(f'{part}_scale_{axis}' for part in ('angular', 'linear') for axis in 'xyz'),
    *(f'{part}_bias_{axis}' for part in ('angular', 'linear') for axis in 'xyz'),
    DELAY_NAME,
)
"""Names of six scales, six biases and the delay τ."""

DELAY = NAMES.index(DELAY_NAME)

MIN_DELAY_S = -0.2
"""Below zero as an odometry's velocity, averaged over the time before its stamp, shows earlier.
How the robot moves so much later is not known yet when it is needed: without a limit the
estimate, which can't make up for it, would stray ever further.
"""

UNITS = ('',) * 6 + ('rad/s',) * 3 + ('m/s',) * 3 + ('s',)

SENSOR_NAMES = (
    *(f'sensor_rotation_{axis}' for axis in 'xyz'),
    *(f'sensor_translation_{axis}' for axis in 'xyz'),
    'range_scale',
)
"""Names of ψ, d and e^s."""

SENSOR_UNITS = ('rad',) * 3 + ('m',) * 3 + ('',)

SCALE = SENSOR_NAMES.index('range_scale')


class SensorCalibration:
    """ψ, d and s of the sensor of one frame, and which of these seven are ``estimated`` (c_s,).

    ``number`` counts the sensors. At the start the ``values`` (7,) are as stated, and the
    estimates have ``variances`` (c_s,).
    """

    def __init__(
        self,
        frame: str,
        number: int,
        stated: FloatArray,
        estimated: IntArray,
        variances: FloatArray,
    ) -> None:
        self.frame, self.number = frame, number
        self.estimated, self.variances = estimated, variances
        self._stated, self.values = stated, stated.copy()

    def shift(self, change: FloatArray) -> None:
        """Add ``change`` (c_s,) to the estimates."""
        values: FloatArray = self.values.copy()
        values[self.estimated] += change
        self.values = values

    def estimates(self, variances: FloatArray, stated: FloatArray) -> list[CalibrationEstimate]:
        """Return the estimates with ``variances`` (c_s,), and standard deviations at the start."""
        suffix = f'/{self.frame}' if self.frame else ''
        found = []
        for i, variance, error in zip(self.estimated, variances, stated, strict=True):
            value, nominal, factor = self.values[i], self._stated[i], 1.0
            if i == SCALE:  # s is its logarithm
                value, nominal = math.exp(value), math.exp(nominal)
                factor = value
            found.append(
                CalibrationEstimate(
                    SENSOR_NAMES[i] + suffix,
                    float(value),
                    float(factor * np.sqrt(variance)),
                    SENSOR_UNITS[i],
                    nominal=float(nominal),
                    stated=float(factor * error),
                )
            )
        return found


class Calibration:
    """Estimates of those c entries whose uncertainty is not 0: of s, b and τ, then of sensors.

    ``initial_variances`` (c,) grow by ``drift_covariance`` (c, c) a second, if one ``drifts``;
    ``delay_error_ns`` is the standard deviation of τ at the start, 0 where it is not estimated.
    ``sensors`` are those seen so far, by their frames; ``corrects_points`` says whether what they
    show is not taken as it comes.
    """

    def __init__(self, settings: Settings, axes: EstimatedAxes) -> None:
        self.axes, self._settings = axes, settings
        scale = np.array([*settings.angular_scale_stddev, *settings.linear_scale_stddev])
        bias = np.array([*settings.angular_bias_stddev, *settings.linear_bias_stddev])
        errors = np.concatenate([scale, bias, [settings.velocity_delay_stddev]])
        pose = np.arange(6)[axes.pose]
        possible = np.concatenate([pose, 6 + pose, [DELAY]])
        self._estimated: IntArray = possible[errors[possible] > 0.0]
        self._scales = int(np.sum(self._estimated < 6))
        self._calibrated = self._estimated[self._estimated < DELAY] % 6
        self._nominal = stated_of_velocity(settings)
        self._all: FloatArray = self._nominal.copy()
        self._values: FloatArray | None = None  # as asked for since the last change
        # τ; where it is negative the latest velocity is held for longer.
        self.delay_ns = to_ns(settings.velocity_delay)
        self.sensors: dict[str, SensorCalibration] = {}
        stated, deviations = _of_a_sensor(settings)
        of_sensor = np.append(pose, SCALE)
        self._of_sensor: IntArray = of_sensor[deviations[of_sensor] > 0.0]
        self._stated, self._sensor_variances = stated, deviations[self._of_sensor] ** 2
        self.corrects_points = bool(
            settings.range_is_depth or stated.any() or len(self._of_sensor)
        )
        self.count = self.of_velocity = len(self._estimated)  # c, and how many are no sensor's
        self.delay_error_ns = to_ns(settings.velocity_delay_stddev)
        self._set_variances(errors[self._estimated] ** 2)

    def copy(self) -> Calibration:
        """Return an independent copy."""
        other = copy(self)
        other._all = self._all.copy()
        other.sensors = {frame: copy(sensor) for frame, sensor in self.sensors.items()}
        return other

    def _set_variances(self, variances: FloatArray) -> None:
        self.initial_variances = variances
        self.drift_covariance = np.diag(variances * self._settings.calibration_drift**2)
        self.drifts = bool(self.drift_covariance.any())

    def add_sensor(self, frame: str) -> SensorCalibration:
        """Append what is estimated of the sensor of a new frame."""
        number, variances = len(self.sensors), self._sensor_variances
        sensor = SensorCalibration(frame, number, self._stated, self._of_sensor, variances)
        self.sensors[frame], self._values = sensor, None
        self.count += len(sensor.estimated)
        self._set_variances(np.append(self.initial_variances, sensor.variances))
        return sensor

    @property
    def values(self) -> FloatArray:
        """(c,) estimates: scale factors 1 + s, biases b, the delay τ in seconds; then sensors'."""
        if self._values is None:
            of_sensors = [part.values[part.estimated] for part in self.sensors.values()]
            self._values = np.concatenate([self._all[self._estimated], *of_sensors])
            self._values.setflags(write=False)
        return self._values

    @property
    def calibrates_sensors(self) -> bool:
        """Whether some of the c entries are those of sensors."""
        return self.count > self.of_velocity

    def columns(self, sensor: SensorCalibration) -> slice:
        """Return which of the c entries are those of a sensor."""
        before = [other for other in self.sensors.values() if other.number < sensor.number]
        first = self.of_velocity + sum(len(other.estimated) for other in before)
        return slice(first, first + len(sensor.estimated))

    def sensor_columns(self) -> tuple[FloatArray, IntArray]:
        """Return ψ, d and s of all sensors (s, 7), and which of the c entries they are, or −1."""
        columns = np.full((len(self.sensors), 7), -1)
        for sensor in self.sensors.values():
            entries = np.arange(self.count)[self.columns(sensor)]
            columns[sensor.number, sensor.estimated] = entries
        values = [sensor.values for sensor in self.sensors.values()]
        return np.array(values).reshape(-1, 7), columns

    def estimates(self, variances: FloatArray) -> list[CalibrationEstimate]:
        """Return the estimates with ``variances`` (c,), what the filter knows of them."""
        stated = np.full(self.count, np.inf) if self.drifts else np.sqrt(self.initial_variances)
        of_velocity = [
            CalibrationEstimate(
                NAMES[i],
                float(self._all[i]),
                float(np.sqrt(variance)),
                UNITS[i],
                nominal=float(self._nominal[i]),
                stated=float(error),
            )
            for i, variance, error in zip(self._estimated, variances, stated, strict=False)
        ]
        return of_velocity + [
            estimate
            for sensor in self.sensors.values()
            for estimate in sensor.estimates(
                variances[self.columns(sensor)], stated[self.columns(sensor)]
            )
        ]

    def apply(self, body_velocities: FloatArray) -> FloatArray:
        """Return velocities (…, 6) as (1 + s) ∘ V + b; exact zeros stay so."""
        # Wheels that stand turn no robot, however unlike, and no gyroscope gives zero on all axes.
        biases = _moves(body_velocities)[..., None] * self._all[6:DELAY]
        return body_velocities * self._all[:6] + biases

    def apply_to_covariance(
        self, covariance: FloatArray, body_velocity: FloatArray, variances: FloatArray
    ) -> FloatArray:
        """Return the covariance (6, 6) of a calibrated velocity from that of the velocity (6,).

        ``variances`` (c,) are what the filter knows of the estimates.
        """
        scales = self._all[:6]
        applied = scales[:, None] * covariance * scales
        if self.of_velocity:
            of_all = np.zeros(len(NAMES))
            of_all[self._estimated] = variances[: self.of_velocity]
            of_velocity = of_all[:6] * body_velocity**2 + of_all[6:DELAY] * _moves(body_velocity)
            applied.ravel()[::7] += of_velocity
        return applied

    def sensitivity(
        self,
        Ad: FloatArray,
        measured_velocities: FloatArray,
        dt_s: FloatArray,
        at_ends: FloatArray | None,
    ) -> FloatArray:
        """Return (p, c), how the pose error grows with the errors of s, b and τ over a motion.

        From ε' = Ad_Â (V ∘ s̃ + b̃), and from a delay taken too long by τ̃, so that velocities
        were taken from an interval that begins and ends τ̃ earlier. ``Ad`` (k + 1, p, 6) holds
        the estimated rows of Ad_Â; the others are those of :class:`.Motion`.
        """
        if not self.count:
            return np.empty((Ad.shape[1], 0))
        shares = se3.at_poses(self._rates(measured_velocities) * dt_s[:, None])
        of_rates = Ad.take(self._calibrated, axis=2) * shares[:, None, :]
        F = np.zeros((Ad.shape[1], self.count))
        F[:, : len(self._calibrated)] = of_rates.sum(axis=0)
        if self.delay_error_ns and at_ends is not None:
            first, last = self.apply(at_ends)
            F[:, self.of_velocity - 1] = Ad[0].dot(first) - Ad[-1].dot(last)
        return F

    def sensitivity_until(
        self,
        Ad: FloatArray,
        held: HeldUntil,
        Ad_at_ends: FloatArray,
        at_ends: FloatArray | None,
    ) -> FloatArray:
        """Return :meth:`sensitivity` until each of s instants (s, p, c).

        ``Ad`` (k + 1, p, 6) is along the whole pieces, ``Ad_at_ends`` (s, p, 6) at the instants.
        """
        counts, rates = held.counts, len(self._calibrated)
        of_rates = Ad[:, :, self._calibrated]
        shares = self._shares(held.whole)
        until = se3.summed_until((of_rates[:-1] + of_rates[1:]) * shares)[counts]
        last = of_rates[counts] + Ad_at_ends[:, :, self._calibrated]
        F = np.zeros((len(counts), Ad.shape[1], self.count))
        F[:, :, :rates] = until + last * self._shares(held.last)
        if self.delay_error_ns and at_ends is not None:
            starts, ends = self.apply(at_ends)
            F[:, :, self.of_velocity - 1] = (
                starts @ Ad[0].T - (Ad_at_ends @ ends[:, :, None])[:, :, 0]
            )
        return F

    def _shares(self, held: HeldVelocities) -> FloatArray:
        """Return (k, 1, …) half of how far each scale and bias moves the robot in a piece."""
        rates = self._rates(held.body_velocities)
        shares: FloatArray = (0.5 * rates * held.dt_s[:, None])[:, None, :]
        return shares

    def _rates(self, measured_velocities: FloatArray) -> FloatArray:
        """Return (k, …) how fast each scale and bias moves the robot per unit of its error."""
        rates: FloatArray = measured_velocities.take(self._calibrated, axis=1)
        rates[:, self._scales :] = _moves(measured_velocities)[:, None]
        return rates

    def initial_covariance(self) -> FloatArray:
        """Return that of (ε, c̃) at the start, (p + c, p + c): the pose is the reference."""
        return np.diag(np.append(np.zeros(self.axes.p), self.initial_variances))

    def shift(self, change: FloatArray) -> None:
        """Add ``change`` (c,) to the estimates."""
        self._values = None
        self._all[self._estimated] += change[: self.of_velocity]
        for sensor in self.sensors.values():
            sensor.shift(change[self.columns(sensor)])
        least_s = min(MIN_DELAY_S, self._nominal[DELAY])
        self._all[DELAY] = min(max(self._all[DELAY], least_s), MAX_DELAY_S)
        self.delay_ns = to_ns(float(self._all[DELAY]))


def stated_of_velocity(settings: Settings) -> FloatArray:
    """Return what the settings state of the velocity (13,): factors 1 + s, biases b and τ."""
    return np.array(
        [
            *settings.angular_scale,
            *settings.linear_scale,
            *settings.angular_bias,
            *settings.linear_bias,
            settings.velocity_delay,
        ]
    )


def _of_a_sensor(settings: Settings) -> tuple[FloatArray, FloatArray]:
    """Return ψ, d and s (7,) of a sensor as stated, and their standard deviations (7,)."""
    deviations = [
        *settings.sensor_rotation_stddev,
        *settings.sensor_translation_stddev,
        settings.range_scale_stddev / settings.range_scale,
    ]
    return np.append(np.zeros(6), math.log(settings.range_scale)), np.array(deviations)


def without_calibration(settings: Settings) -> Settings:
    """Return settings that estimate nothing of the calibration, as stated as it may be."""
    zero = (0.0, 0.0, 0.0)
    return replace(
        without_sensor_calibration(settings),
        angular_scale_stddev=zero,
        linear_scale_stddev=zero,
        angular_bias_stddev=zero,
        linear_bias_stddev=zero,
        velocity_delay_stddev=0.0,
    )


def without_sensor_calibration(settings: Settings) -> Settings:
    """Return settings that take sensors to be mounted, and to err, just as stated."""
    zero = (0.0, 0.0, 0.0)
    return replace(
        settings,
        sensor_rotation_stddev=zero,
        sensor_translation_stddev=zero,
        range_scale_stddev=0.0,
    )


def _moves(body_velocities: FloatArray) -> BoolArray:
    """Return whether velocities (…, 6) are not exactly zero (…)."""
    return np.asarray(body_velocities.any(axis=-1))
